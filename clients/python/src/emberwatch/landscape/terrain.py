"""The spread of fire on land: slopes, the factors of slope and wind, the text of the model file.

Alexandridis, Vakalis, Siettos and Bafas (2008), "A cellular automata model for forest fire spread
prediction", Applied Mathematics and Computation 204, 191-201, doi 10.1016/j.amc.2008.06.046.
"""

import re
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import invalid
from emberwatch.landscape.grid import check_square
from emberwatch.landscape.layers import Layer, check_full
from emberwatch.landscape.world import quoted
from emberwatch.model import Model

UNITS: Final = {"m": 1.0, "ft": 0.3048, "us-ft": 1200 / 3937}
"""The length of each unit of heights in metres."""
_SPELLINGS: Final = {
    "meter": "m", "metre": "m", "foot": "ft", "feet": "ft", "us survey foot": "us-ft",
}  # fmt: skip
_HEIGHTS: Final = (-1000.0, 10_000.0)  # metres: all land, but not the no-data value -9999
_LIKE: Final = 0.02  # relative tolerance between --cell and the raster's own cell size
_A: Final = 0.078  # coefficient of slope, per degree
_C1, _C2 = 0.045, 0.131  # coefficients of wind, per m/s
#: Probabilities of spread from the neighbours on level ground without wind.
_NEAR: Final = "[[0.0295, 0.037, 0.0295], [0.037, 0.0, 0.037], [0.0295, 0.037, 0.0295]]"


def slopes(
    layer: Layer, *, cell: float | None, height_unit: str | None, oblong: bool
) -> tuple[NDArray[np.float64], list[str]]:
    """Returns the slope of each cell in metres per metre, to the east and north, shape (2, H, W).

    Flags supply units that the raster does not state; notes name the units.
    """
    width, height = _sides(layer, cell, oblong=oblong)
    unit, source = _height_unit(layer, height_unit)
    values = layer.values.astype(np.float64) * UNITS[unit]
    _check_heights(layer, values)
    southward, eastward = np.gradient(values, height, width)  # one-sided at the edges
    rise = np.stack([eastward, -southward])
    steepest = np.degrees(np.arctan(np.hypot(*rise).max()))
    size = f"cells of {width:.4g} x {height:.4g} metres; steepest slope {steepest:.1f} degrees"
    return rise, [size, f"heights in {unit} ({source})"]


def slope_and_wind(rise: NDArray[np.float64], speed: float, towards: float) -> NDArray[np.float64]:
    """Returns the factors of each neighbour's spread to each cell, shape (3, 3, H, W).

    `rise`: slopes, as from `slopes`. `speed`: wind speed in m/s. `towards`: the direction to which
    the wind blows, in degrees from the east towards the north. The centre is 1.
    """
    rows, columns = np.indices((3, 3)) - 1
    distance = np.hypot(rows, columns).clip(1.0)
    # Fire moves from the neighbour to the cell: from a neighbour below, it moves north.
    directions = np.stack([-columns, rows]) / distance
    slope = np.degrees(np.arctan(np.tensordot(directions, rise, (0, 0))))
    cosine = np.tensordot((np.cos(np.radians(towards)), np.sin(np.radians(towards))), directions, 1)
    wind = np.exp(speed * (_C1 + _C2 * (cosine - 1.0)))
    factors = np.exp(_A * slope) * wind[:, :, np.newaxis, np.newaxis]
    factors[1, 1] = 1.0
    return factors


def model_text(name: str, files: dict[str, str], maps: Sequence[str]) -> str:
    """Returns the text of `wildfire-burnout` without its wind, and with files of maps, by key."""
    keys = [f"{key} = {quoted(value)}\n" for key, value in {"name": name, **files}.items()]
    times = f"\ntimes = [{', '.join(map(quoted, maps))}]" if maps else ""
    _, states, rest = Model.named("wildfire-burnout").toml.partition("\nstates = [")
    rest = rest.replace(". Wind blows from the left.", " on level ground without wind.")
    before, near, after = re.split("(?m)^(near.burning = ).*", rest)
    return f"{''.join(keys)}{states}{before}{near}{_NEAR}{times}{after}"


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
