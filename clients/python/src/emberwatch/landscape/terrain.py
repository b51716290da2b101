"""The spread of fire on land: the factors of slope and wind, and the text of the model file.

Alexandridis, Vakalis, Siettos and Bafas (2008), "A cellular automata model for forest fire spread
prediction", Applied Mathematics and Computation 204, 191-201, doi 10.1016/j.amc.2008.06.046.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.landscape.world import quoted

_A: Final = 0.078  # coefficient of slope, per degree
_C1, _C2 = 0.045, 0.131  # coefficients of wind, per m/s
_STATES: Final = """
states = [
    { name = "unburnt", color = "#2e8b57", initial = 0.99, observed_as = [0.98, 0.01, 0.01] },
    { name = "burning", color = "#c8371b", initial = 0.01, reward = 1.0, observed_as = [0.01, 0.98, 0.01] },
    { name = "burnt", color = "#4a4a4a", initial = 0.0, observed_as = [0.05, 0.01, 0.94] },
]
observations = [
    { name = "unburnt", color = "#2e8b57" },
    { name = "burning", color = "#c8371b" },
    { name = "burnt", color = "#4a4a4a" },
]

# Lightning, and the probability with which one burning neighbour ignites the cell on level ground without wind.
[[transitions]]
from = "unburnt"
to = "burning"
base = 0.000037
near.burning = [[0.0295, 0.037, 0.0295], [0.037, 0.0, 0.037], [0.0295, 0.037, 0.0295]]
"""  # noqa: E501
_BURNT: Final = """
# A cell burns for 25 steps on average.
[[transitions]]
from = "burning"
to = "burnt"
base = 0.04

# Regrowth takes 333 steps.
[[transitions]]
from = "burnt"
to = "unburnt"
base = 0.003
"""


def gradient(elevation: NDArray[np.float64], width: float, height: float) -> NDArray[np.float64]:
    """Returns the slope of each cell in metres per metre, to the east and north, shape (2, H, W).

    `elevation`: heights in metres, shape (H, W), the first row in the north. `width` and `height`:
    size of a cell on the ground in metres. Uses central differences, one-sided at the edges.
    """
    southward, eastward = np.gradient(elevation, height, width)
    return np.stack([eastward, -southward])


def slope_and_wind(rise: NDArray[np.float64], speed: float, towards: float) -> NDArray[np.float64]:
    """Returns the factors of each neighbour's spread to each cell, shape (3, 3, H, W).

    `rise`: slopes, as from `gradient`. `speed`: wind speed in m/s. `towards`: the direction to
    which the wind blows, in degrees from the east towards the north. The centre is 1.
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
    """Returns the text of a model file. `files`: the names of its files of maps, by key."""
    keys = [f"{key} = {quoted(value)}\n" for key, value in {"name": name, **files}.items()]
    times = f"times = [{', '.join(map(quoted, maps))}]\n" if maps else ""
    return "".join(keys) + _STATES + times + _BURNT
