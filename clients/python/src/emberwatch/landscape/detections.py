"""Reader of detections by satellites: the CSV files of NASA's FIRMS.

A detection becomes a polygon, the footprint of the sensor: a rectangle whose sides are the columns
`scan` (east-west) and `track` (north-south) in km. These columns are described at
https://www.earthdata.nasa.gov/data/tools/firms/active-fire-data-attributes-modis-viirs
"""

from argparse import Namespace
from collections.abc import Generator
from pathlib import Path
from typing import Any, Final

import numpy as np

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.layers import Layer
from emberwatch.landscape.libraries import library
from emberwatch.landscape.perimeters import drawn, on_plane, seconds_of

#: The columns, and the ranges of their numbers.
_RANGES: Final = {
    "latitude": (-90, 90),
    "longitude": (-180, 180),
    "scan": (0.1, 10),
    "track": (0.1, 10),
}
_NEEDED: Final = (*_RANGES, "acq_date", "acq_time")


def read(file: Path, flags: Namespace) -> Generator[Layer]:
    """Yields the arrival times of the detections in a file."""
    geopandas, pandas = library("geopandas"), library("pandas")
    try:
        table = pandas.read_csv(file, dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise InvalidArgumentError(f"{file}: expected a CSV file, got: {error}") from None
    missing = [name for name in _NEEDED if name not in table]
    if missing or not len(table):
        got = f"no {', '.join(missing)}" if missing else "no rows"
        raise invalid(file, f"detections of FIRMS with {', '.join(_NEEDED)}", got)
    clock = table["acq_date"] + " " + table["acq_time"].str.replace(":", "").str.zfill(4)
    seconds = seconds_of(f"{file}, acq_date acq_time", clock, "%Y-%m-%d %H%M")
    latitude, longitude, scan, track = (_numbers(file, table, name) for name in _RANGES)
    points = geopandas.GeoSeries.from_xy(longitude, latitude, crs="EPSG:4326")
    points, east, north = on_plane(file, points), 500 * scan, 500 * track  # half the sides, metres
    x, y = points.x, points.y
    footprints = library("shapely").box(x - east, y - north, x + east, y + north)
    yield drawn(file, geopandas.GeoSeries(footprints, crs=points.crs), seconds, flags)


def _numbers(file: Path, table: Any, name: str) -> Any:
    """Returns a column of numbers."""
    numbers = library("pandas").to_numeric(table[name], errors="coerce").to_numpy()
    low, high = _RANGES[name]
    wrong = np.flatnonzero(~((numbers >= low) & (numbers <= high)))
    if wrong.size:
        got = f"'{table[name].iloc[wrong[0]]}' in row {wrong[0]}"
        raise invalid(f"{file}, {name}", f"{low:g} to {high:g} in each row", got)
    return numbers
