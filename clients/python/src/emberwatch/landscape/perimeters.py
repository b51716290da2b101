"""Reader of perimeters of a fire: polygons with times, in GeoJSON, GeoPackage or shapefiles.

`drawn` converts polygons to arrival times: a cell begins to burn at the time of the first polygon
that contains its centre.
"""

import math
import re
from collections.abc import Generator
from pathlib import Path
from typing import Any, Final

import numpy as np

from emberwatch.common.paths import utf8
from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.grid import Place
from emberwatch.landscape.ground import unit_cell
from emberwatch.landscape.layers import MOST_CELLS, Choice, Layer, choose_variable, window
from emberwatch.landscape.libraries import library
from emberwatch.landscape.schedule import SINCE_1970, Clock

_MARGIN: Final = 0.1  # unburnt land around the fire, as a share of its longer side
_DATE: Final = r"\d{4}([-/]?)(?:0[1-9]|1[0-2])\1[0-3]\d(?!\d)"
_ZONE: Final = re.compile(r":.*(?:Z|[+-]\d\d(?::?\d\d)?)$")


def read(file: Path, choice: Choice) -> Generator[Layer]:
    """Yields the arrival times of the perimeters in a file."""
    check_choice(file, choice)
    pyogrio, path = library("pyogrio", file), utf8("file", file.absolute())
    library("geopandas", file)
    try:
        names = [str(name) for name, kind in pyogrio.list_layers(path) if kind is not None]
        name = choose_variable(file, names, choice.variable)
        table = pyogrio.read_dataframe(path, layer=name, datetime_as_string=True)
    except InvalidArgumentError:
        raise
    except Exception as error:  # pyogrio and GDAL have no common base class
        raise InvalidArgumentError(f"{file}: expected perimeters, got: {error}") from None
    shapes, repaired = _polygons(file, table)
    times, clock, notes = _times(file, table.drop(columns=table.geometry.name), choice.time_column)
    yield drawn(file, shapes, times, choice, clock=clock, notes=(*repaired, *notes))


def check_choice(file: Path, choice: Choice) -> None:
    """Refuses flags with which polygons cannot be drawn."""
    if choice.cell is None:
        expected = "--kind arrival and --cell METRES, the side of the cells to draw polygons on"
        raise invalid(file, expected, "another --kind, or no --cell")


def seconds_of(subject: str, words: Any, form: str = "ISO8601") -> Any:
    """Parses a column to seconds since 1970; refuses other words, and empty ones, by their row."""
    pandas = library("pandas", subject)
    times = pandas.to_datetime(words, errors="coerce", format=form, utc=True)
    wrong = np.flatnonzero(times.isna())
    if wrong.size:
        got = f"'{words.iloc[wrong[0]]}' in row {wrong[0]}"
        raise invalid(subject, "times such as 2020-08-31T12:00:00Z in each row", got)
    return (times - pandas.Timestamp(0, tz="UTC")).dt.total_seconds().to_numpy()


def on_plane(file: Path, shapes: Any) -> Any:
    """Projects shapes in degrees to the zone of UTM in which they are."""
    if shapes.crs.is_projected:
        return shapes
    try:
        projected = shapes.to_crs(shapes.estimate_utm_crs())
        if np.isfinite(projected.total_bounds).all():
            return projected
    except RuntimeError:  # beyond all zones
        pass
    got = (
        f"coordinates from {shapes.total_bounds[:2].tolist()} to {shapes.total_bounds[2:].tolist()}"
    )
    remedy = "if these are not degrees, set the projection that they have (ogr2ogr -a_srs)"
    raise invalid(file, "degrees in a zone of UTM", f"{got}; {remedy}")


def drawn(file: Path, shapes: Any, times: Any, choice: Choice, **more: Any) -> Layer:
    """Draws polygons on a grid, the latest first, so that each cell keeps its first time."""
    west, south, east, north = shapes.total_bounds.tolist()
    ground = unit_cell(shapes.crs.to_wkt(), (west + east) / 2, (south + north) / 2)
    side = (choice.cell or 1.0) / (ground.height if ground else 1.0)
    margin = side + _MARGIN * max(east - west, north - south)
    left, top = side * math.floor((west - margin) / side), side * math.ceil((north + margin) / side)
    height, width = (math.ceil((far + margin) / side) for far in (top - south, east - left))
    if height * width > MOST_CELLS:
        got = f"{height} x {width}; use a larger --cell"
        raise invalid(file, f"perimeters on at most {MOST_CELLS} cells", got)
    order = np.argsort(-times, kind="stable")
    transform = library("rasterio", file).Affine(side, 0.0, left, 0.0, -side, top)
    arrival = library("rasterio.features", file).rasterize(
        zip(shapes.iloc[order], times[order], strict=True),
        out_shape=(height, width), fill=np.nan, transform=transform, dtype="float64",
    )  # fmt: skip
    if not (arrival == times.min()).any():
        got = "none in the first perimeters; use a smaller --cell"
        raise invalid(file, "centres of cells in perimeters", got)
    projection = shapes.crs.to_wkt()
    place = Place(shape=arrival.shape, corner=(left, top), cell=(side, side), projection=projection)
    values, cut = window(str(file), arrival, place, choice)
    return Layer(name=str(file), values=values, place=cut, **more)


def _polygons(file: Path, table: Any) -> tuple[Any, list[str]]:
    """Returns valid polygons on a plane, and a note on repaired ones."""
    shapes = getattr(table, "geometry", None)
    if shapes is None or not len(table):
        raise invalid(file, "polygons", "none")
    for row, one in enumerate(shapes):
        kind = "none" if one is None or one.is_empty else one.geom_type
        if kind not in ("Polygon", "MultiPolygon"):
            remedy = "; for detections, use the CSV file of FIRMS" if kind == "Point" else ""
            raise invalid(file, "a polygon in each row", f"{kind} in row {row}{remedy}")
    if shapes.crs is None:
        remedy = "set it (ogr2ogr -a_srs)"
        raise invalid(file, "a coordinate reference system", f"none; {remedy}")
    n_crossing = int((~shapes.is_valid).sum())
    notes = [f"repaired {n_crossing} polygons whose edges cross"] if n_crossing else []
    return on_plane(file, shapes.make_valid()), notes


def _times(file: Path, columns: Any, wanted: str | None) -> tuple[Any, Clock, list[str]]:
    """Returns the times of the rows, their clock, and notes on what was assumed."""
    known = ", ".join(map(str, columns)) or "none"
    if wanted is not None and wanted not in columns:
        raise invalid("--time-column", f"a column of {file} ({known})", f"'{wanted}'")
    words = {name: columns[name].astype(object).fillna("").astype(str) for name in columns}
    dated = [name for name, column in words.items() if column.str.match(_DATE).any()]
    if wanted is None and len(dated) != 1:
        has_choice = dated or any(columns[name].dtype.kind in "if" for name in columns)
        remedy = "choose with --time-column" if has_choice else "add one"
        got = f"{len(dated)} ({', '.join(map(str, dated)) or known}); {remedy}"
        raise invalid(file, "one column of times such as 2020-08-31T12:00:00Z", got)
    name = dated[0] if wanted is None else wanted
    if name not in dated and columns[name].dtype.kind in "if":
        return columns[name].to_numpy(np.float64), Clock(), []
    seconds = seconds_of(f"{file}, {name}", words[name])
    zoned = words[name].str.contains(_ZONE)
    if zoned.any() and not zoned.all():
        got = f"'{words[name][zoned].iloc[0]}' and '{words[name][~zoned].iloc[0]}'"
        raise invalid(f"{file}, {name}", "times that all have a zone, or none", got)
    notes = [f"times from the column {name}{'' if zoned.all() else ', which has no zone: UTC'}"]
    return seconds, Clock(SINCE_1970), notes
