"""What lies on a world's grid whatever happens there: zones of land and no-fly cells.

What was not observed has the colour of its zone, muted; thin lines go around zones, unless there
are many, hatches over no-fly cells, and a line around what robots saw, if that is more than their
path. All lines are dark or light, whichever the pixel below is not.
"""

from dataclasses import dataclass, replace
from typing import Final, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from emberwatch.common.codes import UNOBSERVED
from emberwatch.model import Color, color_from_hex
from emberwatch.model.airspace import Airspace, Zones
from emberwatch.render.palette import mark_on_each

#: Most zones that have lines around them and names in legends; more would cover what is below.
MOST_ZONES: Final = 8

_TINT = 0.4  # share of a zone's colour: states and observations, in full colours, stay apart
_LEAST_LINE_SCALE = 3  # pixels a cell needs to show its colour beside a line
_LEAST_HATCH, _MOST_HATCH = 3, 10  # pixels from line to line

_Cell = TypeVar("_Cell", bound=np.generic)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scenery:
    """Zones, no-fly cells, and whether robots see beyond their path; by default, none of it."""

    n_rings: int = 1
    """Observation matrices: the observations of each are as many, in the same colours."""
    sees_beyond: bool = False
    no_fly: NDArray[np.bool_] | None = None
    """Where no robot may be, shape (H, W)."""
    zones: NDArray[np.uint8] | None = None
    """The zone of each cell, shape (H, W)."""
    zone_names: tuple[str, ...] = ()
    zone_colors: tuple[Color, ...] = ()

    @classmethod
    def of(cls, air: Airspace, land: Zones | None) -> Self:
        """What robots may fly over and see, and the zones of the land."""
        common = cls(n_rings=air.n_rings, sees_beyond=air.radius > 0, no_fly=air.no_fly)
        if land is None:
            return common
        colors = tuple(map(color_from_hex, land.colors))
        return replace(common, zones=land.map, zone_names=land.names, zone_colors=colors)

    def tints(self, unobserved: Color) -> tuple[Color, ...]:
        """The colour of what was not observed, by zone."""
        colors = np.array(self.zone_colors).reshape(-1, 3) * _TINT
        mixed = np.rint(colors + np.array(unobserved) * (1 - _TINT)).astype(int)
        return tuple((red, green, blue) for red, green, blue in mixed.tolist())

    def tint(
        self, colors: NDArray[np.uint8], frame: NDArray[np.uint8], unobserved: Color
    ) -> NDArray[np.uint8]:
        """The colours (H, W, 3) of a frame (H, W), with those of zones where it has no value."""
        if self.zones is None:
            return colors
        tints = np.array(self.tints(unobserved), np.uint8)[self.zones]
        return np.where((frame == UNOBSERVED)[:, :, None], tints, colors)

    def draw(self, image: NDArray[np.uint8], frame: NDArray[np.uint8], scale: int) -> None:
        """Draws all lines over a picture of so many pixels a cell."""
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
    """The pixels of cells that border on another zone to the right or below."""
    pixels = _enlarge(zones, scale)
    border = np.zeros(pixels.shape, np.bool_)
    if scale >= _LEAST_LINE_SCALE:
        border[:-1] |= pixels[1:] != pixels[:-1]
        border[:, :-1] |= pixels[:, 1:] != pixels[:, :-1]
    return border


def _around(seen: NDArray[np.bool_], scale: int) -> NDArray[np.bool_]:
    """The pixels of other cells that border on seen ones."""
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
