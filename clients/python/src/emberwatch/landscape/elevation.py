"""Slopes of a raster of heights, with notes on the units that were assumed."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import invalid
from emberwatch.landscape.grid import check_even, check_square, check_unit
from emberwatch.landscape.ground import unit_of, vertical_unit
from emberwatch.landscape.layers import Layer, check_full
from emberwatch.landscape.lengths import METRES, NAMES, Side, unit_named
from emberwatch.landscape.terrain import gradient

_HEIGHTS: Final = (-1000.0, 10_000.0)  # metres: all land, but not the no-data value -9999
_LIKE: Final = 0.02  # relative tolerance between --cell and the raster's own cell size
_FEET: Final = (0.3, 0.31)  # range of the lengths of all kinds of feet, metres
_TURNED: Final = 5.0  # angle to true north above which a note is made, degrees


def slopes(
    layer: Layer, *, cell: Side | None, height_unit: str | None, oblong: bool
) -> tuple[NDArray[np.float64], list[str]]:
    """Returns the slope of each cell, as `gradient` does, and notes on units.

    Flags supply units that the raster does not state.
    """
    (width, height), why = _sides(layer, cell, oblong=oblong)
    is_in_feet = _is_in_feet(layer, cell)
    metres, heights = _height_unit(layer, height_unit, is_in_feet=is_in_feet)
    values = layer.values.astype(np.float64) * metres
    _check_heights(layer, values)
    rise = gradient(values, width, height)
    steepest = np.degrees(np.arctan(np.hypot(*rise).max()))
    notes = [
        f"cells of {width:.4g} x {height:.4g} metres{why}; steepest slope {steepest:.1f} degrees"
    ]
    return rise, [*notes, *_turned(layer), heights]


def _sides(layer: Layer, cell: Side | None, *, oblong: bool) -> tuple[tuple[float, float], str]:
    """Returns width and height of a cell in metres, and a note on the source of these lengths."""
    place, name = layer.place, layer.name
    if min(place.shape) < 2:
        got = f"{place.shape[0]} x {place.shape[1]}"
        raise invalid(name, "at least 2 x 2 cells, as a slope needs two neighbours", got)
    if not oblong:
        check_square(place, name)
        check_even(place, name)
    ground = place.ground()
    if ground is None and cell is not None:
        return (cell.metres, cell.metres), ", from --cell"
    if ground is None:
        check_unit(place, name, "give --cell METRES, or set its projection (gdal_translate -a_srs)")
        return place.cell, ", as the raster names no other unit (--cell sets the size)"
    if cell is not None and abs(cell.metres / ground.height - 1) > _LIKE:
        side = f"{ground.height:.6g} metres, as in {name}, or no flag"
        raise invalid("--cell", side, f"{cell.metres:g}")
    return (ground.width, ground.height), " on the ground"


def _is_in_feet(layer: Layer, cell: Side | None) -> bool:
    """Returns whether cells are measured in feet, in which case heights may be, too."""
    projection = layer.place.projection
    unit = None if projection is None else unit_of(projection)
    if unit is None:
        return cell is not None and cell.unit in ("ft", "us-ft")
    length, is_angle = unit
    return not is_angle and _FEET[0] < length < _FEET[1]


def _height_unit(layer: Layer, wanted: str | None, *, is_in_feet: bool) -> tuple[float, str]:
    """Returns the length of a unit of height in metres, and a note on its source."""
    words, projection = layer.clock.words.strip(), layer.place.projection
    known = unit_named(words)
    vertical = None if projection is None else vertical_unit(projection)
    if wanted is not None:
        instead = "" if known in (None, wanted) else f" instead of the raster's {NAMES[known]}"
        return METRES[wanted], f"heights in {NAMES[wanted]} (from --height-unit{instead})"
    if known is not None:
        return METRES[known], f"heights in {NAMES[known]} (from the raster)"
    if vertical is not None:
        return vertical[0], f"heights in units of {ascii(vertical[1])} (from the projection)"
    if words not in ("", "1"):
        expected = f"heights in one of {', '.join(METRES)}"
        raise invalid(layer.name, expected, f"'{words}'; give --height-unit")
    if is_in_feet:
        expected = "a unit of heights, as cells are in feet"
        raise invalid(layer.name, expected, "none; give --height-unit ft, us-ft or m")
    return 1.0, "heights in metres (assumed, as the raster names no unit; --height-unit sets it)"


def _check_heights(layer: Layer, values: NDArray[np.float64]) -> None:
    remedy = "fill them (gdal_fillnodata), or use a part (gdal_translate -srcwin)"
    check_full(layer, "a height in each cell", remedy)
    wrong = values[(values < _HEIGHTS[0]) | (values > _HEIGHTS[1])]
    if wrong.size:
        expected = f"heights of {_HEIGHTS[0]:g} to {_HEIGHTS[1]:g} metres"
        remedy = "give --nodata if it means no value, --height-unit if it is not in metres"
        raise invalid(layer.name, expected, f"{wrong[0]:g}; {remedy}")


def _turned(layer: Layer) -> list[str]:
    """Returns a note if the grid's north differs from true north."""
    ground = layer.place.ground()
    north = 0.0 if ground is None else (ground.north + 180) % 360 - 180
    if abs(north) <= _TURNED:
        return []
    side = "east" if north > 0 else "west"
    return [f"the grid's north is {abs(north):.0f} degrees {side} of true north"]
