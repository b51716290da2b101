"""Slopes of a raster of heights: cells and heights in metres, and what had to be assumed."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import invalid
from emberwatch.landscape.grid import check_even, check_square, check_unit
from emberwatch.landscape.ground import unit_of, vertical_unit
from emberwatch.landscape.layers import Layer
from emberwatch.landscape.lengths import METRES, NAMES, Side, unit_named
from emberwatch.landscape.terrain import gradient

_HEIGHTS: Final = (-1000.0, 10_000.0)  # metres: all land, and not -9999
_LIKE: Final = 0.02  # share by which --cell may differ from what a raster says
_FEET: Final = (0.3, 0.31)  # metres: all kinds of feet
_TURNED: Final = 5.0  # degrees from true north


class Slopes(NamedTuple):
    """The slope of each cell."""

    rise: NDArray[np.float64]
    """Metres per metre to the east and to the north, shape (2, H, W)."""
    notes: list[str]
    """In which units cells and heights were read, and why."""


def slopes(layer: Layer, *, cell: Side | None, height_unit: str | None, oblong: bool) -> Slopes:
    """The slopes of a raster; flags say what it does not."""
    (width, height), why = _sides(layer, cell, oblong=oblong)
    is_in_feet = _is_in_feet(layer, cell)
    metres, heights = _height_unit(layer, height_unit, is_in_feet=is_in_feet)
    values = layer.values * metres
    _check_heights(layer, values)
    rise = gradient(values, width, height)
    steepest = np.degrees(np.arctan(np.hypot(*rise).max()))
    notes = [
        f"cells of {width:.4g} x {height:.4g} metres{why}; steepest slope {steepest:.1f} degrees"
    ]
    return Slopes(rise, [*notes, *_turned(layer), heights])


def _sides(layer: Layer, cell: Side | None, *, oblong: bool) -> tuple[tuple[float, float], str]:
    """Width and height of a cell in metres, and what says so."""
    place, name = layer.place, layer.name
    if min(place.shape) < 2:
        got = f"{place.shape[0]} x {place.shape[1]}"
        raise invalid(name, "at least 2 x 2 cells, as slopes are between cells", got)
    if not oblong:
        check_square(place, name)
        check_even(place, name)
    ground = place.ground()
    if ground is None and cell is not None:
        return (cell.metres, cell.metres), ", as --cell says"
    if ground is None:
        check_unit(place, name, "say --cell METRES, or its projection (gdal_translate -a_srs)")
        return place.cell, ", as nothing says another unit (--cell does)"
    if cell is not None and abs(cell.metres / ground.height - 1) > _LIKE:
        side = f"{ground.height:.6g} metres, as {name} says, or no flag"
        raise invalid("--cell", side, f"{cell.metres:g}")
    return (ground.width, ground.height), " on the ground"


def _is_in_feet(layer: Layer, cell: Side | None) -> bool:
    """Whether cells are measured in feet, so that heights may be, too."""
    projection = layer.place.projection
    unit = None if projection is None else unit_of(projection)
    if unit is None:
        return cell is not None and cell.unit in ("ft", "us-ft")
    length, is_angle = unit
    return not is_angle and _FEET[0] < length < _FEET[1]


def _height_unit(layer: Layer, wanted: str | None, *, is_in_feet: bool) -> tuple[float, str]:
    """The length of a unit of height in metres, and a note of it."""
    words, projection = layer.clock.words.strip(), layer.place.projection
    known = unit_named(words)
    vertical = None if projection is None else vertical_unit(projection)
    if wanted is not None:
        instead = "" if known in (None, wanted) else f", not in {NAMES[known]}, as the raster says"
        return METRES[wanted], f"heights in {NAMES[wanted]}, as --height-unit says{instead}"
    if known is not None:
        return METRES[known], f"heights in {NAMES[known]}, as the raster says"
    if vertical is not None:
        return vertical[0], f"heights in units of {ascii(vertical[1])}, as the projection says"
    if words not in ("", "1"):
        expected = f"heights in one of {', '.join(METRES)}"
        raise invalid(layer.name, expected, f"'{words}'; say --height-unit")
    if is_in_feet:
        expected = "a unit of heights, as cells are in feet"
        raise invalid(layer.name, expected, "none; say --height-unit ft, us-ft or m")
    return 1.0, "heights taken as metres, as nothing says their unit; --height-unit ft changes that"


def _check_heights(layer: Layer, values: NDArray[np.float64]) -> None:
    missing = np.argwhere(np.isnan(values))
    if missing.size:
        row, column = missing[0].tolist()
        got = f"none in {len(missing)} cells, the first in row {row}, column {column}"
        remedy = "fill them (gdal_fillnodata), or take a part (gdal_translate -srcwin)"
        raise invalid(layer.name, "a height in each cell", f"{got}; {remedy}")
    wrong = values[(values < _HEIGHTS[0]) | (values > _HEIGHTS[1])]
    if wrong.size:
        expected = f"heights of {_HEIGHTS[0]:g} to {_HEIGHTS[1]:g} metres"
        remedy = "say --nodata if it means no value, --height-unit if it is not in metres"
        raise invalid(layer.name, expected, f"{wrong[0]:g}; {remedy}")


def _turned(layer: Layer) -> list[str]:
    """A note where the grid's north is not the Earth's."""
    ground = layer.place.ground()
    north = 0.0 if ground is None else (ground.north + 180) % 360 - 180
    if abs(north) <= _TURNED:
        return []
    side = "east" if north > 0 else "west"
    return [f"north is up here, which is {abs(north):.0f} degrees {side} of true north"]
