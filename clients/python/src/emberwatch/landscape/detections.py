"""Reader of detections by satellites: the CSV files of NASA's FIRMS.

A detection becomes a polygon, the footprint of the sensor: a rectangle whose sides are the columns
`scan` (east-west) and `track` (north-south) in km. These columns and the sides of pixels at nadir
are described at https://www.earthdata.nasa.gov/data/tools/firms/active-fire-data-attributes-modis-viirs
"""

from collections.abc import Generator
from pathlib import Path
from typing import Any, Final

import numpy as np

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.layers import Choice, Layer
from emberwatch.landscape.libraries import library
from emberwatch.landscape.perimeters import check_choice, drawn, on_plane, seconds_of
from emberwatch.landscape.schedule import SINCE_1970, Clock

_NEEDED: Final = ("latitude", "longitude", "acq_date", "acq_time")
_RANGES: Final = {"latitude": (-90, 90), "longitude": (-180, 180)}
_KILOMETRES: Final = (0.1, 10)  # range of the sides of pixels
_NADIR: Final = {"MODIS": "1", "VIIRS": "0.375"}  # sides of pixels, km


def read(file: Path, choice: Choice) -> Generator[Layer]:
    """Yields the arrival times of the detections in a file."""
    check_choice(file, choice)
    geopandas = library("geopandas", file)
    try:
        table = library("pandas", file).read_csv(file, dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise InvalidArgumentError(f"{file}: expected a CSV file, got: {error}") from None
    missing = [name for name in _NEEDED if name not in table]
    if missing or not len(table):
        got = f"no {', '.join(missing)}" if missing else "no rows"
        raise invalid(file, f"detections of FIRMS with {', '.join(_NEEDED)}", got)
    clock = table["acq_date"] + " " + table["acq_time"].str.replace(":", "").str.zfill(4)
    seconds = seconds_of(f"{file}, acq_date acq_time", clock, "%Y-%m-%d %H%M")
    longitude, latitude, scan, track = (
        _numbers(file, table, name) for name in ("longitude", "latitude", "scan", "track")
    )
    points = geopandas.GeoSeries.from_xy(longitude, latitude, crs="EPSG:4326")
    points, east, north = on_plane(file, points), 500 * scan, 500 * track  # half the sides, metres
    smallest = 2 * min(east.min(), north.min())
    if (choice.cell or 0.0) > smallest:
        raise invalid("--cell", f"at most {smallest:g}, as footprints in {file}", choice.cell)
    x, y = points.x, points.y
    footprints = library("shapely", file).box(x - east, y - north, x + east, y + north)
    shapes = geopandas.GeoSeries(footprints, crs=points.crs)
    yield drawn(file, shapes, seconds, choice, clock=Clock(SINCE_1970))


def _numbers(file: Path, table: Any, name: str) -> Any:
    """Returns a column of numbers. Without `scan` or `track`, pixels have their size at nadir."""
    words = table[name] if name in table else table.get("instrument")
    if words is None:
        raise invalid(file, "the columns scan and track, or instrument", "none of them")
    words = words if name in table else words.map(_NADIR)
    numbers = library("pandas", file).to_numeric(words, errors="coerce").to_numpy()
    low, high = _RANGES.get(name, _KILOMETRES)
    wrong = np.flatnonzero(~((numbers >= low) & (numbers <= high)))
    if wrong.size:
        got = f"'{words.iloc[wrong[0]]}' in row {wrong[0]}"
        raise invalid(f"{file}, {name}", f"{low:g} to {high:g} in each row", got)
    return numbers
