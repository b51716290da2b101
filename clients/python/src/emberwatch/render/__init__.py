"""Pictures of one world: the last frame, the path, and the hidden states if they are known.

`rgb_array` returns an image, and `ansi` a text. `Screen` shows an image or a text to people, for
``render_mode="human"``. `film` draws recordings. The path of a single robot is dark or light,
whichever has more contrast to the colours below it, and the robot is a circle in dark and light.
Each robot of a team has its own colour. Hatches cover no-fly cells. A line surrounds the observed
cells if robots see more than their path.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emberwatch.common.codes import UNOBSERVED
from emberwatch.model import Color
from emberwatch.model.airspace import Airspace
from emberwatch.render.palette import DARK, LIGHT, ROBOTS, mark_on
from emberwatch.render.palette import Palette as Palette

_EDGE = (0xB4, 0xB4, 0xB4)
_LONG_SIDE = 512  # default length of a panel's longer side, pixels; approximate
_GAP = 8  # pixels between panels
_LEAST_LINE_SCALE = 3  # minimum side of a cell in pixels, to show its colour next to a line
_LEAST_RIM_SCALE = 12  # minimum side of a cell in pixels, for a rim around the line
_TINT = 0.45  # share of white in visited cells that are too small for a line
_LEAST_RADIUS, _MOST_RADIUS = 6.0, 14.0  # range of the radius of a robot's mark, pixels
_LEAST_HATCH, _MOST_HATCH = 3, 10  # range of the distance between hatch lines, pixels
_MOST_WIDE_ROWS = 32  # maximum number of rows that fit a terminal with one line for each


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Picture:
    """The contents of a picture of one world."""

    frame: NDArray[np.uint8]
    """Observed values, 255 in unobserved cells, shape (H, W)."""
    palette: Palette
    robots: Sequence[tuple[int, int]] = ()
    """The cell (row, column) of each robot."""
    paths: Sequence[NDArray[np.intp]] = ()
    """The visited cells (row, column) of each robot that flew, in order, shape (n, 2)."""
    truth: NDArray[np.uint8] | None = None
    """The hidden states, shape (H, W); None if they are unknown."""
    airspace: Airspace = Airspace()  # noqa: RUF009

    def color_of(self, robot: int) -> Color | None:
        """Returns the colour of a robot of a team; None for a single robot."""
        return ROBOTS[robot % len(ROBOTS)] if len(self.robots) > 1 else None


def rgb_array(picture: Picture, *, scale: int | None = None) -> NDArray[np.uint8]:
    """Draws a frame with paths and robots, and the hidden states next to it (below on wide grids).

    A path is a line, or a tint if cells are smaller than 3 pixels. `scale` is the side of a cell in
    pixels, at least 1; None: the longer side of a panel is about 512 pixels. The image has shape
    (height, width, 3). Its size depends only on the grid, the scale, and whether hidden states are
    known; both sides are even, as video codecs require.
    """
    height, width = picture.frame.shape
    if scale is None:  # an even number, unless cells are too small
        scale = max(1, 2 * round(_LONG_SIDE / max(height, width) / 2))
    panels = _panels(picture, scale)
    for panel in panels:
        for robot, cell in enumerate(picture.robots):
            _draw_robot(panel, cell, picture.color_of(robot), scale)
    image = _join(panels, _GAP, axis=0 if width >= 2 * height else 1)
    return np.pad(image, ((0, len(image) & 1), (0, image.shape[1] & 1), (0, 0)), mode="edge")


def ansi(picture: Picture) -> str:
    """Draws the picture as text for a terminal, hidden states on the right; no final line break.

    A character is two pixels in 24-bit colour, one above the other. A cell is 2 x 2 pixels, or on
    grids of more than 32 rows one pixel. Paths are tints.
    """
    scale = 2 if len(picture.frame) <= _MOST_WIDE_ROWS else 1
    panels = _panels(picture, scale)
    for panel in panels:
        for robot, (row, col) in enumerate(picture.robots):
            cell = np.s_[row * scale : (row + 1) * scale, col * scale : (col + 1) * scale]
            panel[cell] = picture.color_of(robot) or LIGHT
    image = _join(panels, gap=2, axis=1).tolist()
    return "\n".join(
        itertools.starmap(_half_blocks, itertools.zip_longest(image[::2], image[1::2]))
    )


def _panels(picture: Picture, scale: int) -> list[NDArray[np.uint8]]:
    """Draws the frame and, if they are known, the hidden states, without robots."""
    palette, frame, no_fly = picture.palette, picture.frame, picture.airspace.no_fly
    colors = palette.paint_frame(frame)
    if scale < _LEAST_LINE_SCALE:
        rows, cols = np.concatenate([np.empty((0, 2), np.intp), *picture.paths]).T
        colors[rows, cols] = np.rint(colors[rows, cols] * (1 - _TINT) + 255 * _TINT)
    panels = [_enlarge(colors, scale)]
    if picture.airspace.radius > 0:
        _draw_outline(panels[0], frame != UNOBSERVED, scale)
    if picture.truth is not None:
        panels.append(_enlarge(palette.paint_truth(picture.truth), scale))
    if no_fly is not None:
        for panel in panels:
            draw_hatches(panel, no_fly, scale)
    if scale >= _LEAST_LINE_SCALE:
        seen = (frame != UNOBSERVED)[:, :, np.newaxis]
        ink = np.where(seen, palette.path, mark_on(np.array(palette.unobserved)))
        for robot, path in enumerate(picture.paths):
            color = picture.color_of(robot)
            _draw_path(panels[0], path, ink if color is None else np.full_like(ink, color), scale)
    return panels


def _enlarge(cells: NDArray[Any], scale: int) -> NDArray[Any]:
    return cells.repeat(scale, axis=0).repeat(scale, axis=1)


def _draw_outline(image: NDArray[np.uint8], seen: NDArray[np.bool_], scale: int) -> None:
    """Draws a line around the seen cells, over pixels of unseen cells."""
    pixels = _enlarge(seen, scale)
    near = pixels.copy()
    for _ in range(max(1, scale // 12) if scale >= _LEAST_LINE_SCALE else 0):
        grown = near.copy()
        for to, of in ((np.s_[1:], np.s_[:-1]), (np.s_[:-1], np.s_[1:])):
            grown[to] |= near[of]
            grown[:, to] |= near[:, of]
        near = grown
    line = near & ~pixels
    image[line] = mark_on(image[line])


def draw_hatches(image: NDArray[np.uint8], no_fly: NDArray[np.bool_], scale: int) -> None:
    """Draws lines over the no-fly cells of an image whose cells have `scale` pixels."""
    rows, cols = np.ogrid[: image.shape[0], : image.shape[1]]
    period = min(max(scale, _LEAST_HATCH), _MOST_HATCH)
    lines = _enlarge(no_fly, scale) & (np.remainder(rows + cols, period) < max(1, period // 4))
    image[lines] = mark_on(image[lines])


def _draw_path(
    image: NDArray[np.uint8], path: NDArray[np.intp], colors: NDArray[np.uint8], scale: int
) -> None:
    """Draws a line through the middles of a path's cells, with a square where it begins.

    `colors` has the colour of the line in each cell, (H, W, 3).
    """
    if not len(path):
        return
    line = max(1, min(6, scale // 4))
    rim = 0 if scale < _LEAST_RIM_SCALE else max(1, line // 3)
    ink, other = _enlarge(colors, scale), _enlarge(mark_on(colors), scale)
    middles = path * scale + (scale - line) // 2
    legs, begin = list(itertools.pairwise(middles)), [(middles[0], middles[0])]
    for drawn, grow, source in (
        (legs, rim, other),
        (legs, 0, ink),
        (begin, rim + 2, ink),
        (begin, rim + 1, other),
    ):
        for ends in drawn:
            top, left = np.maximum(np.minimum(*ends) - grow, 0)
            bottom, right = np.maximum(*ends) + line + grow
            image[top:bottom, left:right] = source[top:bottom, left:right]


def _draw_robot(
    image: NDArray[np.uint8], robot: tuple[int, int], color: Color | None, scale: int
) -> None:
    """Draws a dot in a ring, or a disc of one `color`, large enough to be seen on small cells."""
    row, col = ((2 * at + 1) * scale / 2 - 0.5 for at in robot)
    radius = min(_MOST_RADIUS, max(_LEAST_RADIUS, 0.46 * scale))
    top, left = max(0, int(row - radius)), max(0, int(col - radius))
    window = image[top : int(row + radius) + 2, left : int(col + radius) + 2]
    rows, cols = np.ogrid[: window.shape[0], : window.shape[1]]
    distance = np.hypot(rows + top - row, cols + left - col)
    rings = ((1.0, LIGHT), (0.8, DARK), (0.55, color or LIGHT), (0.3, color or DARK))
    for share, ink in rings:
        window[distance <= radius * share] = ink


def _join(panels: list[NDArray[np.uint8]], gap: int, *, axis: int) -> NDArray[np.uint8]:
    shape = list(panels[0].shape)
    shape[axis] = gap
    edge = np.full(shape, _EDGE, dtype=np.uint8)
    return np.concatenate([part for panel in panels for part in (edge, panel)][1:], axis=axis)


def _half_blocks(upper: list[list[int]], lower: list[list[int]] | None) -> str:
    """Returns a line of text: upper pixels as foreground, lower ones, if any, as background."""
    styles = ["38;2;{};{};{};".format(*color) for color in upper]
    behind = ["48;2;{};{};{}".format(*color) for color in lower or ()] or ["49"] * len(upper)
    runs = itertools.groupby(f"{front}{back}" for front, back in zip(styles, behind, strict=True))
    return "".join(f"\x1b[{style}m" + "▀" * len(list(run)) for style, run in runs) + "\x1b[0m"
