"""The colours of pictures: the model's colours, and marks that stand out from them.

Marks differ from cells in lightness, so that they are visible in grey and with any colour
blindness.
"""

from dataclasses import dataclass
from itertools import cycle, islice
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from emberwatch._native import MAX_VALUES
from emberwatch.model import Color, Description, color_from_hex

DARK: Final[Color] = (0x14, 0x14, 0x14)
"""Colour of marks on light cells."""

LIGHT: Final[Color] = (0xFF, 0xFF, 0xFF)
"""Colour of marks on dark cells."""

# The three colours of the wildfire model, then Okabe and Ito (2008) with brown instead of orange.
_COLORS = ("3B6EA5", "E3B23C", "C8371B", "009E73", "CC79A7", "56B4E9", "8C510A", "F0E442")
# As on the dashboard, robots are light, so that a dark edge makes each stand out from every cell.
_ROBOTS = ("5EE6C8", "FF9AD5", "B9F04A", "8FD0FF", "FFA64D", "C9A8FF", "F5F09A", "D9C2A0")
_GREYS = (0x30, 0x60, 0x98, 0xE2)  # candidates for unobserved cells
ROBOTS: Final[tuple[Color, ...]] = tuple(map(color_from_hex, _ROBOTS))
"""The colours of the robots of a team, repeated in turn."""
_APART = 3 * 60 * 60  # squared distance at which two colours can be distinguished


@dataclass(frozen=True, slots=True, kw_only=True)
class Palette:
    """The colours of states, observed values, unobserved cells and paths."""

    states: tuple[Color, ...]
    observations: tuple[Color, ...]
    unobserved: Color  # a grey that differs from all other colours
    path: Color  # over observed cells: dark or light, whichever has more contrast to them

    @classmethod
    def of(cls, source: Description | int, *, on_paper: bool = False) -> Self:
        """Makes a palette with a description's colours, or for a number of observed values.

        Without a description, eight colours are repeated in turn. `on_paper` prefers a light colour
        for unobserved cells, like the page around them.
        """
        if isinstance(source, Description):
            states, observations = source.state_colors, source.observation_colors
        else:
            # Enough colours for any number of states.
            states = tuple(map(color_from_hex, islice(cycle(_COLORS), MAX_VALUES)))
            observations = states[:source]
        lights = _luminances(np.array(observations))
        return cls(
            states=states,
            observations=observations,
            unobserved=_grey_unlike((*states, *observations), _GREYS[:: -1 if on_paper else 1]),
            path=DARK if lights.min() * lights.max() > _MIDDLE else LIGHT,
        )

    def paint_frame(self, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Returns the colours (H, W, 3) of a frame (H, W)."""
        colors = np.full((256, 3), self.unobserved, np.uint8)
        colors[: len(self.observations)] = self.observations
        return colors[frame]

    def paint_truth(self, truth: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Returns the colours (H, W, 3) of hidden states (H, W)."""
        return np.array(self.states, np.uint8)[truth]


def mark_on(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns dark or light for each colour, (..., 3): whichever has more contrast to it.

    Contrast ratio and luminance are defined in the Web Content Accessibility Guidelines 2.1.
    """
    is_light = _luminances(colors) ** 2 > _MIDDLE
    return np.where(is_light[..., np.newaxis], DARK, LIGHT).astype(np.uint8)


def _luminances(colors: NDArray[np.integer]) -> NDArray[np.float64]:
    return 0.05 + (colors / 255.0) ** 2.2 @ np.array([0.2126, 0.7152, 0.0722])


_MIDDLE = _luminances(np.array([DARK, LIGHT])).prod()


def _grey_unlike(colors: tuple[Color, ...], greys: tuple[int, ...]) -> Color:
    """Returns the first grey that is distinguishable from all colours, or the most distant one."""

    def nearest(grey: int) -> int:
        return min(sum((channel - grey) ** 2 for channel in color) for color in colors)

    grey = next((g for g in greys if nearest(g) >= _APART), max(greys, key=nearest))
    return grey, grey, grey
