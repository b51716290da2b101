"""Slopes of a raster of heights, with notes on the units that were assumed."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import invalid
from emberwatch.landscape.grid import check_square
from emberwatch.landscape.layers import Layer, check_full
from emberwatch.landscape.terrain import gradient

UNITS: Final = {"m": 1.0, "ft": 0.3048, "us-ft": 1200 / 3937}
"""The length of each unit of heights in metres."""
_SPELLINGS: Final = {
    "meter": "m", "metre": "m", "foot": "ft", "feet": "ft", "us survey foot": "us-ft",
}  # fmt: skip
_HEIGHTS: Final = (-1000.0, 10_000.0)  # metres: all land, but not the no-data value -9999
_LIKE: Final = 0.02  # relative tolerance between --cell and the raster's own cell size


def slopes(
    layer: Layer, *, cell: float | None, height_unit: str | None, oblong: bool
) -> tuple[NDArray[np.float64], list[str]]:
    """Returns the slope of each cell, as `gradient` does, and notes on units.

    Flags supply units that the raster does not state.
    """
    width, height = _sides(layer, cell, oblong=oblong)
    unit, source = _height_unit(layer, height_unit)
    values = layer.values.astype(np.float64) * UNITS[unit]
    _check_heights(layer, values)
    rise = gradient(values, width, height)
    steepest = np.degrees(np.arctan(np.hypot(*rise).max()))
    size = f"cells of {width:.4g} x {height:.4g} metres; steepest slope {steepest:.1f} degrees"
    return rise, [size, f"heights in {unit} ({source})"]


def _sides(layer: Layer, cell: float | None, *, oblong: bool) -> tuple[float, float]:
    """Returns width and height of a cell in metres."""
    place, name = layer.place, layer.name
    if min(place.shape) < 2:
        got = f"{place.shape[0]} x {place.shape[1]}"
        raise invalid(name, "at least 2 x 2 cells, as a slope needs two neighbours", got)
    if not oblong:
        check_square(place, name)
    ground = place.ground()
    if ground is None and cell is None:
        remedy = "give --cell METRES, or set its projection (gdal_edit.py -a_srs)"
        raise invalid(name, "a projection, which gives the size of cells", f"none; {remedy}")
    if ground is None or cell is None:
        return ground or (cell or 1.0, cell or 1.0)
    if abs(cell / ground[1] - 1) > _LIKE:
        raise invalid("--cell", f"{ground[1]:.6g} metres, as in {name}, or no flag", f"{cell:g}")
    return ground


def _height_unit(layer: Layer, wanted: str | None) -> tuple[str, str]:
    """Returns the unit of heights, and the source from which it is known."""
    words = layer.unit.strip().lower().replace("_", " ")
    if wanted is not None:
        return wanted, "from --height-unit"
    if words in ("", "1"):
        return "m", "assumed, as the raster names no unit; --height-unit sets it"
    known = _SPELLINGS.get(words.removesuffix("s"), words)
    if known not in UNITS:
        expected = f"heights in one of {', '.join(UNITS)}"
        raise invalid(layer.name, expected, f"'{words}'; give --height-unit")
    return known, "from the raster"


def _check_heights(layer: Layer, values: NDArray[np.float64]) -> None:
    remedy = "fill them (gdal_fillnodata), or use a part (gdal_translate -srcwin)"
    check_full(layer, "a height in each cell", remedy)
    wrong = values[(values < _HEIGHTS[0]) | (values > _HEIGHTS[1])]
    if wrong.size:
        expected = f"heights of {_HEIGHTS[0]:g} to {_HEIGHTS[1]:g} metres"
        remedy = "give --nodata if it means no value, --height-unit if it is not in metres"
        raise invalid(layer.name, expected, f"{wrong[0]:g}; {remedy}")
