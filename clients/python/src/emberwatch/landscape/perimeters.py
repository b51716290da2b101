"""Readers of perimeters of a fire (polygons with times) and of detections by satellites.

Both become polygons on a grid: a cell begins to burn at the time of the first polygon that contains
its centre. The polygon of a detection in NASA's FIRMS is the footprint of the sensor: a rectangle
whose sides are the columns `scan` (east-west) and `track` (north-south) in km.
https://www.earthdata.nasa.gov/data/tools/firms/active-fire-data-attributes-modis-viirs
"""

import math
from argparse import Namespace
from collections.abc import Generator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np

from emberwatch._native import MAX_SIDE
from emberwatch.common.paths import utf8
from emberwatch.errors import invalid
from emberwatch.landscape.grid import Place
from emberwatch.landscape.layers import SINCE_1970, Layer, choose_variable

_MARGIN: Final = 0.1  # unburnt land around the fire, as a share of its longer side
#: The columns of detections, and the ranges of their numbers.
_RANGES: Final = {
    "latitude": (-90, 90),
    "longitude": (-180, 180),
    "scan": (0.1, 10),
    "track": (0.1, 10),
}
_NEEDED: Final = (*_RANGES, "acq_date", "acq_time")
_DATE: Final = r"\d{4}([-/]?)(?:0[1-9]|1[0-2])\1[0-3]\d(?!\d)"


def read(file: Path, flags: Namespace) -> Generator[Layer]:
    """Yields the arrival times of the perimeters in a file."""
    pyogrio, path = import_module("pyogrio"), utf8("file", file.absolute())
    import_module("geopandas")
    names = [str(name) for name, kind in pyogrio.list_layers(path) if kind is not None]
    name = choose_variable(file, names, flags.variable)
    table = pyogrio.read_dataframe(path, layer=name, datetime_as_string=True)
    shapes = _polygons(file, table)
    times, unit, note = _times(file, table.drop(columns="geometry"), flags.time_column)
    yield replace(_drawn(file, _on_plane(file, shapes), times, flags), unit=unit, notes=(note,))


def read_detections(file: Path, flags: Namespace) -> Generator[Layer]:
    """Yields the arrival times of the detections in a file."""
    geopandas, pandas = import_module("geopandas"), import_module("pandas")
    table = pandas.read_csv(file, dtype=str, keep_default_na=False)
    missing = [name for name in _NEEDED if name not in table]
    if missing or not len(table):
        got = f"no {', '.join(missing)}" if missing else "no rows"
        raise invalid(file, f"detections of FIRMS with {', '.join(_NEEDED)}", got)
    clock = table["acq_date"] + " " + table["acq_time"].str.replace(":", "").str.zfill(4)
    seconds = _seconds_of(f"{file}, acq_date acq_time", clock, "%Y-%m-%d %H%M")
    latitude, longitude, scan, track = (_numbers(file, table, name) for name in _RANGES)
    points = geopandas.GeoSeries.from_xy(longitude, latitude, crs="EPSG:4326")
    points, east, north = _on_plane(file, points), 500 * scan, 500 * track  # half the sides, metres
    x, y = points.x, points.y
    footprints = import_module("shapely").box(x - east, y - north, x + east, y + north)
    yield _drawn(file, geopandas.GeoSeries(footprints, crs=points.crs), seconds, flags)


def _seconds_of(subject: str, words: Any, form: str = "ISO8601") -> Any:
    """Parses a column to seconds since 1970; refuses other words, and empty ones, by their row."""
    pandas = import_module("pandas")
    times = pandas.to_datetime(words, errors="coerce", format=form, utc=True)
    wrong = np.flatnonzero(times.isna())
    if wrong.size:
        got = f"'{words.iloc[wrong[0]]}' in row {wrong[0]}"
        raise invalid(subject, "times such as 2020-08-31T12:00:00Z in each row", got)
    return (times - pandas.Timestamp(0, tz="UTC")).dt.total_seconds().to_numpy()


def _on_plane(file: Path, shapes: Any) -> Any:
    """Projects shapes in degrees to the zone of UTM in which they are."""
    if shapes.crs.is_projected:
        return shapes
    try:
        projected = shapes.to_crs(shapes.estimate_utm_crs())
        if np.isfinite(projected.total_bounds).all():
            return projected
    except RuntimeError:  # beyond all zones
        pass
    got = f"coordinates of {shapes.total_bounds.tolist()}"
    remedy = "if these are not degrees, set the projection that they have (ogr2ogr -a_srs)"
    raise invalid(file, "degrees in a zone of UTM", f"{got}; {remedy}")


def _drawn(file: Path, shapes: Any, times: Any, flags: Namespace) -> Layer:
    """Draws polygons on a grid, the latest first, so that each cell keeps its first time."""
    if flags.kind != "arrival" or flags.cell is None:
        expected = "--kind arrival and --cell METRES, the side of the cells to draw polygons on"
        raise invalid(file, expected, "another --kind, or no --cell")
    west, south, east, north = shapes.total_bounds.tolist()
    center = (west + east) / 2, (south + north) / 2
    _, metres = Place(shape=(1, 1), corner=center, crs=shapes.crs).ground() or (1.0, 1.0)
    side = flags.cell / metres
    margin = side + _MARGIN * max(east - west, north - south)
    left, top = side * math.floor((west - margin) / side), side * math.ceil((north + margin) / side)
    height, width = (math.ceil((far + margin) / side) for far in (top - south, east - left))
    if max(height, width) > MAX_SIDE:
        got = f"{height} x {width}; use a larger --cell"
        raise invalid(file, f"perimeters on at most {MAX_SIDE} x {MAX_SIDE} cells", got)
    order = np.argsort(-times, kind="stable")
    arrival = import_module("rasterio.features").rasterize(
        zip(shapes.iloc[order], times[order], strict=True),
        out_shape=(height, width),
        fill=np.nan,
        transform=import_module("rasterio").Affine(side, 0.0, left, 0.0, -side, top),
        dtype="float64",
    )
    if not (arrival == times.min()).any():
        got = "none in the first perimeters; use a smaller --cell"
        raise invalid(file, "centres of cells in perimeters", got)
    place = Place(shape=arrival.shape, corner=(left, top), cell=(side, side), crs=shapes.crs)
    return Layer(name=str(file), values=arrival, place=place, unit=SINCE_1970)


def _polygons(file: Path, table: Any) -> Any:
    """Returns valid polygons, with crossing edges repaired."""
    shapes = getattr(table, "geometry", None)
    if shapes is None or not len(table):
        raise invalid(file, "polygons", "none")
    kinds = shapes.geom_type.fillna("none")
    wrong = np.flatnonzero(~kinds.isin(("Polygon", "MultiPolygon")))
    if wrong.size:
        got = f"{kinds.iloc[wrong[0]]} in row {wrong[0]}"
        raise invalid(file, "a polygon in each row", got)
    if shapes.crs is None:
        raise invalid(file, "a coordinate reference system", "none; set it (ogr2ogr -a_srs)")
    return shapes.make_valid()


def _times(file: Path, columns: Any, wanted: str | None) -> tuple[Any, str, str]:
    """Returns the times of the rows, their unit, and a note on the column."""
    known = ", ".join(map(str, columns)) or "none"
    if wanted is not None and wanted not in columns:
        raise invalid("--time-column", f"a column of {file} ({known})", f"'{wanted}'")
    words = {name: columns[name].astype(object).fillna("").astype(str) for name in columns}
    dated = [name for name, column in words.items() if column.str.match(_DATE).any()]
    if wanted is None and len(dated) != 1:
        got = f"{len(dated)} ({', '.join(dated) or known}); choose with --time-column"
        raise invalid(file, "one column of times such as 2020-08-31T12:00:00Z", got)
    name = wanted or dated[0]
    note = f"times from the column {name}"
    if name not in dated and columns[name].dtype.kind in "if":
        return columns[name].to_numpy(np.float64), "", note
    return _seconds_of(f"{file}, {name}", words[name]), SINCE_1970, note


def _numbers(file: Path, table: Any, name: str) -> Any:
    """Returns a column of numbers."""
    numbers = import_module("pandas").to_numeric(table[name], errors="coerce").to_numpy()
    low, high = _RANGES[name]
    wrong = np.flatnonzero(~((numbers >= low) & (numbers <= high)))
    if wrong.size:
        got = f"'{table[name].iloc[wrong[0]]}' in row {wrong[0]}"
        raise invalid(f"{file}, {name}", f"{low:g} to {high:g} in each row", got)
    return numbers
