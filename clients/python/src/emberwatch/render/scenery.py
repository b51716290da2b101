"""The constant parts of a world's picture.

Hatches cover no-fly cells. A line surrounds the observed cells if robots see more than their path.
Each pixel of a line is dark on a light pixel, and light on a dark one.
"""

from dataclasses import dataclass
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from emberwatch.common.codes import UNOBSERVED
from emberwatch.model.airspace import Airspace
from emberwatch.render.palette import mark_on_each

_LEAST_LINE_SCALE = 3  # minimum side of a cell in pixels, to show its colour next to a line
_LEAST_HATCH, _MOST_HATCH = 3, 10  # range of the distance between hatch lines, pixels

_Cell = TypeVar("_Cell", bound=np.generic)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scenery:
    """The no-fly cells of a grid, and the range of the sensor. Empty by default."""

    sees_beyond: bool = False
    """Whether robots see cells beyond their path."""
    no_fly: NDArray[np.bool_] | None = None
    """True in the no-fly cells, shape (H, W); None if there are none."""

    @classmethod
    def of(cls, air: Airspace) -> Self:
        """Makes the scenery of an airspace."""
        return cls(sees_beyond=air.radius > 0, no_fly=air.no_fly)

    def draw(self, image: NDArray[np.uint8], frame: NDArray[np.uint8], scale: int) -> None:
        """Draws all lines over a picture; `scale`: side of a cell in pixels."""
        rows, cols = np.ogrid[: image.shape[0], : image.shape[1]]
        lines = np.zeros(image.shape[:2], np.bool_)
        if self.no_fly is not None:
            period = min(max(scale, _LEAST_HATCH), _MOST_HATCH)
            hatch = np.remainder(rows + cols, period) < max(1, period // 4)
            lines |= _enlarge(self.no_fly, scale) & hatch
        if self.sees_beyond:
            lines |= _around(frame != UNOBSERVED, scale)
        image[lines] = mark_on_each(image[lines])


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
