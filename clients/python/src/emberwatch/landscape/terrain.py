"""Zones of land with similar slope and aspect, and the spread of fire over slopes and in wind.

Alexandridis, Vakalis, Siettos and Bafas (2008), "A cellular automata model for forest fire spread
prediction", Applied Mathematics and Computation 204, 191-201, doi 10.1016/j.amc.2008.06.046.
"""

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError
from emberwatch.landscape.compass import facing

MAX_ZONES: Final = 256
"""Maximum number of zones, because a zone map has one byte for each cell."""

_A: Final = 0.078  # coefficient of slope, per degree
_C1, _C2 = 0.045, 0.131  # coefficients of wind, per m/s
_WATER: Final = "#6d8594"  # colour of zones that never burn
_ASPECTS: Final = (
    "east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east"
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Zone:
    """A zone of land: cells that share their kernels."""

    name: str
    color: str
    rise: NDArray[np.float64]
    """Mean slope of its cells, metres per metre to the east and to the north, shape (2,)."""
    burns: bool = True


def gradient(elevation: NDArray[np.float64], width: float, height: float) -> NDArray[np.float64]:
    """Returns the slope of each cell in metres per metre, to the east and north, shape (2, H, W).

    `elevation`: heights in metres, shape (H, W), the first row in the north. `width` and `height`:
    size of a cell on the ground in metres. Uses central differences, one-sided at the edges.
    """
    southward, eastward = np.gradient(elevation, height, width)
    return np.stack([eastward, -southward])


def zones(
    rise: NDArray[np.float64] | None,
    values: NDArray[np.int64] | None,
    *,
    shape: tuple[int, int],
    step: float,
    unburnable: Sequence[int] = (),
) -> tuple[NDArray[np.uint8], list[Zone]]:
    """Groups cells into zones; returns the zone of each cell, shape (H, W), and the zones.

    `rise`: the slopes, as from `gradient`. Two cells are in the same zone if their slopes round to
    the same multiple of `step` degrees, and rise in the same direction, out of eight. `values`:
    shape (H, W); cells with different values are in different zones, and cells whose value is in
    `unburnable` never burn.
    """
    labels = np.zeros(shape, np.int64) if values is None else values
    slopes = np.zeros((2, *shape)) if rise is None else rise
    slopes = np.where(np.isin(labels, unburnable), 0.0, slopes)
    kinds, cells = _kinds(labels, slopes, step)
    counts = np.bincount(cells)
    if len(counts) > MAX_ZONES:
        raise InvalidArgumentError(
            f"zones: expected at most {MAX_ZONES}, got {len(counts)}; use a larger --slope-step, "
            "or fewer values of --zones"
        )
    means = [np.bincount(cells, one.ravel()) / counts for one in slopes]
    found = list[Zone]()
    for (value, steep, aspect), mean in zip(kinds.tolist(), np.array(means).T, strict=True):
        burns = value not in unburnable
        words = [f"zone {value}"] if values is not None else []
        if not burns:
            words.append("never burns")
        elif rise is not None:
            words.append(_slope_name(steep * step, aspect))
        color = _color(steep * step, aspect) if rise is not None else _of_value(value)
        name = ", ".join(words) or "everywhere"
        found.append(Zone(name=name, color=color if burns else _WATER, rise=mean, burns=burns))
    return cells.reshape(shape).astype(np.uint8), found


def factors(
    rise: NDArray[np.float64], speed: float, towards: float, size: tuple[int, ...]
) -> NDArray[np.float64]:
    """Returns the factors of slope and wind for the weights of burning neighbours, (KH, KW).

    `rise`: slope to the east and to the north, shape (2,). `speed`: wind speed in m/s. `towards`:
    the direction to which the wind blows, in degrees from the east towards the north. `size`: size
    of the kernel; the factor of its centre is 1.
    """
    rows, columns = np.indices(size) - np.reshape(size, (2, 1, 1)) // 2
    distance = np.hypot(rows, columns)
    # Fire moves from the neighbour to the cell: from a neighbour below, it moves north.
    directions = np.stack([-columns, rows]) / np.where(distance > 0, distance, 1.0)
    slope = np.degrees(np.arctan(np.tensordot(rise, directions, 1)))
    wind = np.cos(np.radians(towards)), np.sin(np.radians(towards))
    cosine = np.tensordot(wind, directions, 1)
    factor = np.exp(_A * slope) * np.exp(speed * (_C1 + _C2 * (cosine - 1.0)))
    return np.where(distance > 0, factor, 1.0)


def _kinds(
    labels: NDArray[np.int64], slopes: NDArray[np.float64], step: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns value, slope in steps and aspect of each zone, shape (Z, 3), and each cell's zone."""
    steps = np.rint(np.degrees(np.arctan(np.hypot(*slopes))) / step).astype(np.int64)
    aspects = np.rint(np.arctan2(slopes[1], slopes[0]) / (np.pi / 4)).astype(np.int64) % 8
    values, places = np.unique(labels, return_inverse=True)
    # Each cell's key is a single number, because NumPy takes about 30 times as long for rows of
    # three numbers.
    keys = (places.ravel(), steps.ravel(), np.where(steps > 0, aspects, 0).ravel())
    sizes = values.size, int(steps.max()) + 1, 8
    kinds, cells = np.unique(np.ravel_multi_index(keys, sizes), return_inverse=True)
    places, steps, aspects = np.unravel_index(kinds, sizes)
    return np.stack([values[places], steps, aspects], axis=1), cells


def _slope_name(degrees: float, aspect: int) -> str:
    if degrees == 0:
        return "flat"
    return f"{degrees:g} degrees up to the {_ASPECTS[aspect]}, aspect {facing(aspect)}"


def _color(degrees: float, aspect: int) -> str:
    """Returns a zone's colour. The aspect sets its hue; steeper zones are darker and less grey.

    All zone colours are muted, so that the colours of states stand out.
    """
    steep = min(degrees / 40, 1.0)
    return _hex(aspect / 8, 0.7 - 0.3 * steep, 0.1 + 0.25 * steep if degrees > 0 else 0.0)


def _of_value(value: int) -> str:
    """Returns a value's colour. Hues step by the golden ratio, so that close values differ."""
    return _hex(value * 0.618034 % 1.0, 0.6, 0.2)


def _hex(hue: float, lightness: float, saturation: float) -> str:
    shares = colorsys.hls_to_rgb(hue, lightness, saturation)
    return "#" + "".join(f"{round(255 * share):02x}" for share in shares)
