"""Pictures of one world: the last frame, the path, and the hidden states if they are known.

`rgb_array` returns an image, and `ansi` a text. `Screen` shows an image or a text to people, for
``render_mode="human"``. The path of a single robot is dark or light, whichever has more contrast to
the colours below it, and the robot is a circle in dark and light. Each robot of a team has its own
colour.
"""

import contextlib
import importlib
import io
import itertools
import logging
import os
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from emberwatch.common.codes import UNOBSERVED
from emberwatch.errors import invalid
from emberwatch.model import Color
from emberwatch.render.palette import DARK, LIGHT, ROBOTS, mark_on
from emberwatch.render.palette import Palette as Palette
from emberwatch.render.scenery import Scenery

_EDGE = (0xB4, 0xB4, 0xB4)
_LONG_SIDE = 512  # default length of a panel's longer side, pixels; approximate
_GAP = 8  # pixels between panels
LEAST_LINE_SCALE = 3  # minimum side of a cell in pixels, to show its colour next to a line
_LEAST_RIM_SCALE = 12  # minimum side of a cell in pixels, for a rim around the line
_TINT = 0.45  # share of white in visited cells that are too small for a line
_LEAST_RADIUS, _MOST_RADIUS = 6.0, 14.0  # range of the radius of a robot's mark, pixels
_MOST_WIDE_ROWS = 32  # maximum number of rows that fit a terminal with one line for each
_NOTHING = Scenery()
_SYMBOLS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz+/"

_LOG = logging.getLogger(__name__)

Cells = NDArray[np.integer] | Sequence[tuple[int, int]]
"""Visited cells (row, column) in order, shape (n, 2). Each is a neighbour of the previous one, or
equal to it."""


class Picture:
    """The checked contents of a picture."""

    def __init__(
        self,
        frame: NDArray[np.uint8],
        robots: Sequence[tuple[int, int]],
        palette: Palette,
        paths: Sequence[Cells] = (),
        truth: NDArray[np.uint8] | None = None,
        scenery: Scenery = _NOTHING,
    ) -> None:
        """Checks the contents.

        Args:
            frame: Observed values, 255 in unobserved cells, shape (H, W).
            robots: The cell (row, column) of each robot to draw.
            palette: The colours.
            paths: The visited cells of each robot that flew, in order.
            truth: The hidden states, shape (H, W); None: unknown.
            scenery: The no-fly cells of the grid, and the sensor's range.
        """
        if frame.ndim != 2 or not frame.size:
            raise invalid("frame", "shape (H, W)", frame.shape)
        if truth is not None and truth.shape != frame.shape:
            raise invalid("truth", f"shape {frame.shape}", truth.shape)
        self.frame, self.robots, self.palette, self.truth = frame, robots, palette, truth
        self.scenery = scenery
        self.paths = [np.asarray(path, dtype=np.intp).reshape(-1, 2) for path in paths]
        for what, places in (("robot", _cells(robots)), *(("path", path) for path in self.paths)):
            off = ((places < 0) | (places >= frame.shape)).any(axis=1)
            if off.any():
                got = tuple(places[np.argmax(off)].tolist())
                raise invalid(what, f"cells of a {frame.shape} grid", got)
        for path in self.paths:
            jumps = np.abs(np.diff(path, axis=0)).sum(axis=1) > 1
            if jumps.any():
                at = int(np.argmax(jumps))
                got = [tuple(cell) for cell in path[at : at + 2].tolist()]
                raise invalid("path", "consecutive cells to be neighbours", got)

    def color_of(self, robot: int) -> Color | None:
        """Returns the colour of a robot of a team; None for a single robot."""
        return ROBOTS[divmod(robot, len(ROBOTS))[1]] if len(self.robots) > 1 else None


def rgb_array(picture: Picture, *, scale: int | None = None) -> NDArray[np.uint8]:
    """Draws a frame with paths and robots, and the hidden states next to it (below on wide grids).

    A path is a line, or a tint if cells are smaller than 3 pixels. The size of the image depends
    only on the grid, the scale, and whether hidden states are known. Width and height are even, as
    video codecs require.

    Args:
        picture: The contents.
        scale: Side of a cell in pixels, at least 1. None: the longer side of a panel is about 512
            pixels.

    Returns:
        An image of shape (height, width, 3): red, green, blue.
    """
    palette = picture.palette
    height, width = picture.frame.shape
    if scale is None:  # an even number, unless cells are too small
        scale = max(1, 2 * round(_LONG_SIDE / max(height, width) / 2))
    if scale < 1:
        raise invalid("scale", "at least 1 pixel", scale)
    colors = palette.paint_frame(picture.frame)
    if scale < LEAST_LINE_SCALE:
        panels = [_enlarge(_tinted(colors, _visited(picture)), scale)]
        picture.scenery.draw(panels[0], picture.frame, scale)
    else:
        seen = (picture.frame != UNOBSERVED)[:, :, None]
        line = np.where(seen, palette.path, mark_on(palette.unobserved)).astype(np.uint8)
        panels = [_enlarge(colors, scale)]
        picture.scenery.draw(panels[0], picture.frame, scale)
        for robot, path in enumerate(picture.paths):
            _draw_path(panels[0], path, line, picture.color_of(robot), scale)
    if picture.truth is not None:
        panels.append(_enlarge(palette.paint_truth(picture.truth), scale))
        picture.scenery.draw(panels[1], picture.truth, scale)
    for panel in panels:
        for robot, cell in enumerate(picture.robots):
            _draw_robot(panel, cell, picture.color_of(robot), scale)
    return _join(panels, axis=0 if width >= 2 * height else 1)


def ansi(picture: Picture, *, color: bool = True) -> str:
    """Draws the picture as text for a terminal, hidden states on the right; no final line break.

    With colour (24 bits), a cell is two characters. On grids of more than 32 rows, a cell is half a
    character, and the path is a tint. Without colour, a cell is two ASCII characters. The first
    character is the value as ``0-9A-Za-z+/``, or ``.`` for an unobserved cell. The second character
    is ``@`` for a robot, ``*`` for a path, ``x`` for a no-fly cell, otherwise a space.
    """
    palette, cells, robots = picture.palette, _visited(picture), _cells(picture.robots)
    grids = [(picture.frame, picture.palette.paint_frame(picture.frame), cells)]
    if picture.truth is not None:
        grids.append((picture.truth, palette.paint_truth(picture.truth), cells[:0]))
    if not color:
        panels = [_ascii_lines(values, _marks(picture, at, robots)) for values, _, at in grids]
    elif len(picture.frame) <= _MOST_WIDE_ROWS:
        panels = [_wide_lines(colors, _marks(picture, at, robots)) for _, colors, at in grids]
    else:
        panels = list[Iterator[str]]()
        for values, colors, at in grids:
            colors = _tinted(colors, at)
            picture.scenery.draw(colors, values, 1)
            panels.append(_half_lines(colors, robots))
    return "\n".join("  ".join(lines).rstrip(" ") for lines in zip(*panels, strict=True))


class Screen:
    """A window, or the terminal, that shows pictures to people.

    A window needs pygame and a display (``DISPLAY``, ``WAYLAND_DISPLAY`` or ``SDL_VIDEODRIVER``);
    pygame has one window per process. Without a window, pictures go to the standard output if it is
    a terminal. Without a window or a terminal, a warning is logged once, and nothing is shown. If
    the user closes the window, the program continues without pictures.
    """

    def __init__(self, *, title: str = "Emberwatch", fps: float = 0.0) -> None:
        """Opens no window yet. `fps`: maximum number of pictures per second; 0: no limit."""
        self._title, self._fps = title, fps
        self._next: float | None = None
        self._window: Any = None
        self._pygame = _pygame_with_display()
        #: Where pictures are shown.
        self.kind: Literal["window", "terminal", "nothing"] = "window"
        if self._pygame is None:
            self.kind = "terminal" if sys.stdout.isatty() else "nothing"
        if self.kind == "nothing":
            _LOG.warning(
                "render_mode 'human' shows nothing: it needs pygame and a display, or a terminal "
                "as standard output; use 'rgb_array' or 'ansi' to get pictures"
            )

    def show(self, picture: Picture) -> None:
        """Replaces the shown picture; waits first if the last one is too recent for `fps`."""
        if self.kind == "window":
            self._show_in_window(rgb_array(picture))
        elif self.kind == "terminal":
            clear = "\x1b[2J" if self._next is None else ""
            sys.stdout.write(f"{clear}\x1b[H{ansi(picture)}\x1b[K\n\x1b[J")
            sys.stdout.flush()
        self._pace()

    def close(self) -> None:
        """Closes the window, if any. Later pictures are not shown. May be called again."""
        # Another screen of this process may use the window by now.
        if self._window is not None and self._pygame.display.get_surface() is self._window:
            self._pygame.display.quit()
        self._window, self.kind = None, "nothing"

    def _show_in_window(self, image: NDArray[np.uint8]) -> None:
        pygame, (height, width, _) = self._pygame, image.shape
        if pygame.display.get_surface() is not self._window:
            self._window = None
        if self._window is None or self._window.get_size() != (width, height):
            self._window = pygame.display.set_mode((width, height))
            pygame.display.set_caption(self._title)
        surface = pygame.image.frombuffer(image.tobytes(), (width, height), "RGB")
        self._window.blit(surface, (0, 0))
        pygame.display.flip()
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()

    def _pace(self) -> None:
        now = time.monotonic()
        at = now if self._next is None else max(now, self._next)
        if self.kind != "nothing":
            time.sleep(at - now)
            self._next = at + (1.0 / self._fps if self._fps > 0.0 else 0.0)


def _cells(places: Sequence[tuple[int, int]]) -> NDArray[np.intp]:
    return np.array(places, np.intp).reshape(-1, 2)


def _visited(picture: Picture) -> NDArray[np.intp]:
    """Returns the cells of all paths."""
    return np.concatenate([_cells([]), *picture.paths])


def _tinted(colors: NDArray[np.uint8], cells: NDArray[np.intp]) -> NDArray[np.uint8]:
    tinted, (rows, cols) = colors.copy(), cells.T
    tinted[rows, cols] = np.rint(colors[rows, cols] * (1 - _TINT) + 255 * _TINT)
    return tinted


def _enlarge(colors: NDArray[np.uint8], scale: int) -> NDArray[np.uint8]:
    return colors.repeat(scale, axis=0).repeat(scale, axis=1)


def _draw_path(
    image: NDArray[np.uint8],
    cells: NDArray[np.intp],
    colors: NDArray[np.uint8],
    color: Color | None,
    scale: int,
) -> None:
    """Draws a line through the cells' middles, with a square where it begins.

    In each cell, the line has the colour that `colors` gives, dark or light. If `color` is given,
    the whole line has this colour.
    """
    if not len(cells):
        return
    rims = np.where(colors[:, :, :1] == DARK[0], LIGHT, DARK).astype(np.uint8)
    if color is not None:
        colors, rims = np.full_like(colors, color), np.full_like(colors, mark_on(color))
    line = max(1, min(6, scale // 4))
    rim = 0 if scale < _LEAST_RIM_SCALE else max(1, line // 3)
    ink, other = _enlarge(colors, scale), _enlarge(rims, scale)
    middles = cells * scale + (scale - line) // 2
    legs = list(zip(middles, middles[1:], strict=False))
    begin = (middles[0], middles[0])
    for drawn, grow, source in (
        (legs, rim, other),
        (legs, 0, ink),
        ([begin], rim + 2, ink),
        ([begin], rim + 1, other),
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


def _join(panels: list[NDArray[np.uint8]], *, axis: int) -> NDArray[np.uint8]:
    """Joins panels along an axis with gaps between them; rounds both sides up to even numbers."""
    shape = list(panels[0].shape)
    shape[axis] = _GAP
    gap = np.full(shape, _EDGE, dtype=np.uint8)
    image = np.concatenate([part for panel in panels for part in (gap, panel)][1:], axis=axis)
    height, width, _ = image.shape
    return np.pad(image, ((0, height & 1), (0, width & 1), (0, 0)), mode="edge")


def _marks(picture: Picture, cells: NDArray[np.intp], robots: NDArray[np.intp]) -> NDArray[np.str_]:
    marks = np.full(picture.frame.shape, " ")
    if picture.scenery.no_fly is not None:
        marks[picture.scenery.no_fly] = "x"
    marks[tuple(cells.T)] = "*"
    marks[tuple(robots.T)] = "@"
    return marks


def _ascii_lines(values: NDArray[np.uint8], marks: NDArray[np.str_]) -> Iterator[str]:
    symbols = np.full(256, ".")
    symbols[: len(_SYMBOLS)] = list(_SYMBOLS)
    for line in np.stack([symbols[values], marks], axis=-1):
        yield "".join(line.ravel().tolist())


def _wide_lines(colors: NDArray[np.uint8], marks: NDArray[np.str_]) -> Iterator[str]:
    """Yields lines in which each cell is two characters on a background of its colour."""
    wide = {" ": "  ", "*": "··", "@": "()", "x": "xx"}
    for line, line_marks in zip(colors.tolist(), marks.tolist(), strict=True):
        cells: list[tuple[str, str]] = []
        for (red, green, blue), mark in zip(line, line_marks, strict=True):
            ink, _, _ = mark_on((red, green, blue))
            cells.append((f"38;2;{ink};{ink};{ink};48;2;{red};{green};{blue}", wide[mark]))
        yield _styled(cells)


def _half_lines(colors: NDArray[np.uint8], robots: NDArray[np.intp]) -> Iterator[str]:
    """Yields lines for two rows of cells: the upper row as foreground, the lower as background."""
    colors = colors.copy()
    colors[tuple(robots.T)] = LIGHT
    for row in range(0, len(colors), 2):
        cells: list[tuple[str, str]] = []
        for col, (red, green, blue) in enumerate(colors[row].tolist()):
            behind = "49"
            if row + 1 < len(colors):
                behind = "48;2;{};{};{}".format(*colors[row + 1, col].tolist())
            cells.append((f"38;2;{red};{green};{blue};{behind}", "▀"))
        yield _styled(cells)


def _styled(cells: list[tuple[str, str]]) -> str:
    """Joins texts with their style, which is written only where it changes."""
    runs = itertools.groupby(cells, key=lambda cell: cell[0])
    texts = (f"\x1b[{style}m" + "".join(text for _, text in run) for style, run in runs)
    return "".join(texts) + "\x1b[0m"


def _pygame_with_display() -> Any:
    """Returns pygame with an initialised display; None if there is no display or no pygame."""
    if not any(os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")):
        return None
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints its version
            pygame = importlib.import_module("pygame")
    except ImportError:
        return None
    try:
        pygame.display.init()
    except pygame.error:
        return None
    return pygame
