"""The constant parts of a world's picture: zones of land and no-fly cells.

Unobserved cells have the muted colour of their zone. Thin lines surround zones, unless there are
many. Hatches cover no-fly cells. A line surrounds the observed cells if robots see more than their
path. Each pixel of a line is dark on a light pixel, and light on a dark one.
"""

from dataclasses import dataclass, replace
from typing import Final, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from emberwatch.common.codes import UNOBSERVED
from emberwatch.model import Color, color_from_hex
from emberwatch.model.airspace import Airspace, Zones
from emberwatch.render.palette import mark_on_each

#: Maximum number of zones for which lines are drawn and legends list names; more lines would hide
#: the cells.
MOST_ZONES: Final = 8

_TINT = 0.4  # share of a zone's colour; states and observations have full colours and stay distinct
_LEAST_LINE_SCALE = 3  # minimum side of a cell in pixels, to show its colour next to a line
_LEAST_HATCH, _MOST_HATCH = 3, 10  # range of the distance between hatch lines, pixels

_Cell = TypeVar("_Cell", bound=np.generic)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scenery:
    """The zones and no-fly cells of a grid, and the range of the sensor. Empty by default."""

    sees_beyond: bool = False
    """Whether robots see cells beyond their path."""
    no_fly: NDArray[np.bool_] | None = None
    """True in the no-fly cells, shape (H, W); None if there are none."""
    zones: NDArray[np.uint8] | None = None
    """The zone of each cell, shape (H, W); None without zones."""
    zone_names: tuple[str, ...] = ()
    zone_colors: tuple[Color, ...] = ()

    @classmethod
    def of(cls, air: Airspace, land: Zones | None) -> Self:
        """Makes the scenery of an airspace and the zones of its land."""
        common = cls(sees_beyond=air.radius > 0, no_fly=air.no_fly)
        if land is None:
            return common
        colors = tuple(map(color_from_hex, land.colors))
        return replace(common, zones=land.map, zone_names=land.names, zone_colors=colors)

    def tints(self, unobserved: Color) -> tuple[Color, ...]:
        """Returns the colour of unobserved cells for each zone."""
        colors = np.array(self.zone_colors).reshape(-1, 3) * _TINT
        mixed = np.rint(colors + np.array(unobserved) * (1 - _TINT)).astype(int)
        return tuple((red, green, blue) for red, green, blue in mixed.tolist())

    def tint(
        self, colors: NDArray[np.uint8], frame: NDArray[np.uint8], unobserved: Color
    ) -> NDArray[np.uint8]:
        """Returns the colours (H, W, 3) of a frame, with zone colours in unobserved cells."""
        if self.zones is None:
            return colors
        tints = np.array(self.tints(unobserved), np.uint8)[self.zones]
        return np.where((frame == UNOBSERVED)[:, :, None], tints, colors)

    def draw(self, image: NDArray[np.uint8], frame: NDArray[np.uint8], scale: int) -> None:
        """Draws all lines over a picture; `scale`: side of a cell in pixels."""
        rows, cols = np.ogrid[: image.shape[0], : image.shape[1]]
        lines = np.zeros(image.shape[:2], np.bool_)
        if self.no_fly is not None:
            period = min(max(scale, _LEAST_HATCH), _MOST_HATCH)
            hatch = np.remainder(rows + cols, period) < max(1, period // 4)
            lines |= _enlarge(self.no_fly, scale) & hatch
        if self.zones is not None and len(self.zone_names) <= MOST_ZONES:
            lines |= _last_pixels(self.zones, scale) & (np.remainder(rows + cols, 2) == 0)
        if self.sees_beyond:
            lines |= _around(frame != UNOBSERVED, scale)
        image[lines] = mark_on_each(image[lines])


def _last_pixels(zones: NDArray[np.uint8], scale: int) -> NDArray[np.bool_]:
    """Returns the mask of the pixels that border on another zone to the right or below."""
    pixels = _enlarge(zones, scale)
    border = np.zeros(pixels.shape, np.bool_)
    if scale >= _LEAST_LINE_SCALE:
        border[:-1] |= pixels[1:] != pixels[:-1]
        border[:, :-1] |= pixels[:, 1:] != pixels[:, :-1]
    return border


def _around(seen: NDArray[np.bool_], scale: int) -> NDArray[np.bool_]:
    """Returns the mask of the pixels of unseen cells that border on seen cells."""
    pixels = _enlarge(seen, scale)
    near = pixels.copy()
    for _ in range(max(1, scale // 12) if scale >= _LEAST_LINE_SCALE else 0):
        grown = near.copy()
        for to, of in ((np.s_[1:], np.s_[:-1]), (np.s_[:-1], np.s_[1:])):
            grown[to] |= near[of]
            grown[:, to] |= near[:, of]
        near = grown
    return near & ~pixels


def _enlarge(cells: NDArray[_Cell], scale: int) -> NDArray[_Cell]:
    return cells.repeat(scale, axis=0).repeat(scale, axis=1)
