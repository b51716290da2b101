"""Pictures of one world: what was seen along the path, beside the truth where it is known.

`rgb_array` and `ansi` are pure: arrays in, a picture or a text out; `emberwatch.screen` shows them.
Colours are the model's; the path is dark or white, whichever is further from them, and the robot a
ring of both: lightness tells them apart, in grey and under every colour blindness.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from emberwatch.belief import UNOBSERVED
from emberwatch.model import MAX_VALUES, Color, Model
from emberwatch.screen import Screen as Screen

_WHITE, _INK, _EDGE = (255, 255, 255), (0x14, 0x14, 0x14), (0xB4, 0xB4, 0xB4)
_LONG_SIDE = 512  # pixels of a panel, about, unless a scale is given
_GAP = 8  # pixels between panels
_LEAST_LINE_SCALE = 4  # pixels a cell needs to show its colour beside a line
_LEAST_RIM_SCALE = 12  # the same with a rim around the line
_TINT = 0.45  # share of white in visited cells too small for a line
_LEAST_RADIUS, _MOST_RADIUS = 6.0, 14.0  # pixels of the robot's mark
_MOST_WIDE_ROWS = 32  # rows that fit a terminal at one line each
_SYMBOLS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz+/"
# The wildfire model's three, then from Okabe and Ito (2008), with a brown for their orange.
_COLORS = ("3B6EA5", "E3B23C", "C8371B", "009E73", "CC79A7", "56B4E9", "8C510A", "F0E442")
_GREYS = (0x30, 0x60, 0x98, 0xE2)  # for what was not observed, the preferred one first
_APART = 3 * 60 * 60  # squared distance at which colours are told apart, as in the Rust figures

Cells = NDArray[np.integer] | Sequence[tuple[int, int]]
"""Visited cells (row, column) in order, shape (n, 2); each a neighbour of the last, or the same."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Palette:
    """Colours of states, of observations, and of cells where nothing was observed."""

    states: tuple[Color, ...]
    """By state."""
    observations: tuple[Color, ...]
    """By observed value."""
    unobserved: Color
    """A grey unlike the others, dark if it can be."""
    path: Color
    """Dark or white, whichever is further from the observations."""

    @classmethod
    def of(cls, source: Model | int) -> Self:
        """The model's colours, or for a hidden model eight others in turn, by its observations."""
        if isinstance(source, Model):
            states, observations = source.state_colors, source.observation_colors
        else:
            states = tuple(_color(i) for i in range(MAX_VALUES))  # however many there may be
            observations = states[:source]
        lights = [_luminance(color) for color in observations]
        is_light = min(lights) * max(lights) > _luminance(_INK) * _luminance(_WHITE)
        return cls(
            states=states,
            observations=observations,
            unobserved=_grey_unlike((*states, *observations)),
            path=_INK if is_light else _WHITE,
        )

    def paint_frame(self, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Colours (H, W, 3) of a frame (H, W).

        Raises:
            ValueError: A value is neither an observation nor 255.
        """
        return _paint(frame, {**dict(enumerate(self.observations)), UNOBSERVED: self.unobserved})

    def paint_truth(self, truth: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Colours (H, W, 3) of hidden states (H, W).

        Raises:
            ValueError: A value is no state.
        """
        return _paint(truth, dict(enumerate(self.states)))


def rgb_array(
    *,
    frame: NDArray[np.uint8],
    robot: tuple[int, int],
    palette: Palette,
    path: Cells | None = None,
    truth: NDArray[np.uint8] | None = None,
    scale: int | None = None,
) -> NDArray[np.uint8]:
    """Draws a frame with path and robot, and the truth beside it (below it on wide grids).

    The picture's size depends on the grid, the scale and whether there is a truth, on nothing else;
    it is even both ways, for video codecs.

    Args:
        frame: Observed values, 255 where nothing was observed; shape (H, W).
        robot: The robot's cell (row, column).
        palette: The colours.
        path: Visited cells in order; a line, or a tint where cells are below 4 pixels.
        truth: Hidden states, shape (H, W).
        scale: Side of a cell in pixels, at least 1; the default makes panels about 512 long.

    Returns:
        Shape (height, width, 3), red, green, blue.

    Raises:
        ValueError: An argument is of another shape, leaves the grid or the palette.
    """
    cells = _check(frame, robot, path, truth)
    height, width = frame.shape
    if scale is None:  # even, where cells can be
        scale = max(1, 2 * round(_LONG_SIDE / max(height, width) / 2))
    if scale < 1:
        raise ValueError(f"scale: expected at least 1 pixel, got {scale}")
    colors = palette.paint_frame(frame)
    if scale < _LEAST_LINE_SCALE:
        rows, cols = cells.T
        colors[rows, cols] = np.rint(colors[rows, cols] * (1 - _TINT) + 255 * _TINT)
    panels = [_enlarge(colors, scale)]
    if scale >= _LEAST_LINE_SCALE:
        _draw_path(panels[0], cells, scale, palette.path)
    if truth is not None:
        panels.append(_enlarge(palette.paint_truth(truth), scale))
    for panel in panels:
        _draw_robot(panel, robot, scale)
    return _join(panels, axis=0 if width >= 2 * height else 1)


def ansi(
    *,
    frame: NDArray[np.uint8],
    robot: tuple[int, int],
    palette: Palette,
    path: Cells | None = None,
    truth: NDArray[np.uint8] | None = None,
    color: bool = True,
) -> str:
    """Draws the same for a terminal, the truth at the right, without a line break at the end.

    In colour (24 bits), a cell is two characters, or on grids of more than 32 rows half of one,
    which shows the path only by what was observed. Without colour it is two ASCII characters: the
    value as ``0-9A-Za-z+/``, or ``.`` where nothing was observed, then ``@`` for the robot, ``*``
    for the path or a space. The other arguments are those of `rgb_array`.

    Raises:
        ValueError: An argument is of another shape, leaves the grid or the palette.
    """
    seen = _marks(frame.shape, _check(frame, robot, path, truth), robot)
    grids = [(frame, palette.paint_frame(frame), seen)]
    if truth is not None:
        unseen = _marks(frame.shape, np.empty((0, 2), dtype=np.intp), robot)
        grids.append((truth, palette.paint_truth(truth), unseen))
    if not color:
        panels = [_ascii_lines(values, marks) for values, _, marks in grids]
    elif len(frame) <= _MOST_WIDE_ROWS:
        panels = [_wide_lines(colors, marks) for _, colors, marks in grids]
    else:
        panels = [_half_lines(colors, robot) for _, colors, _ in grids]
    return "\n".join("  ".join(lines).rstrip(" ") for lines in zip(*panels, strict=True))


def _check(
    frame: NDArray[np.uint8],
    robot: tuple[int, int],
    path: Cells | None,
    truth: NDArray[np.uint8] | None,
) -> NDArray[np.intp]:
    """The path as cells (n, 2), all arguments checked."""
    if frame.ndim != 2 or not frame.size:
        raise ValueError(f"frame: expected shape (H, W), got {frame.shape}")
    if truth is not None and truth.shape != frame.shape:
        raise ValueError(f"truth: expected shape {frame.shape}, got {truth.shape}")
    cells = np.asarray([] if path is None else path, dtype=np.intp).reshape(-1, 2)
    for what, places in (("robot", np.asarray([robot])), ("path", cells)):
        off = ((places < 0) | (places >= frame.shape)).any(axis=1)
        if off.any():
            got = tuple(places[np.argmax(off)].tolist())
            raise ValueError(f"{what}: expected cells of a {frame.shape} grid, got {got}")
    jumps = np.abs(np.diff(cells, axis=0)).sum(axis=1) > 1
    if jumps.any():
        at = int(np.argmax(jumps))
        got = [tuple(cell) for cell in cells[at : at + 2].tolist()]
        raise ValueError(f"path: expected neighbours one after the other, got {got}")
    return cells


def _paint(values: NDArray[np.uint8], colors: dict[int, Color]) -> NDArray[np.uint8]:
    table = np.zeros((256, 3), dtype=np.uint8)
    for value, color in colors.items():
        table[value] = color
    unknown = np.isin(values, list(colors), invert=True)
    if unknown.any():
        got = int(values[unknown][0])
        raise ValueError(f"picture: expected values out of {sorted(colors)}, got {got}")
    return table[values]


def _color(index: int) -> Color:
    red, green, blue = bytes.fromhex(_COLORS[index % len(_COLORS)])
    return red, green, blue


def _grey_unlike(colors: tuple[Color, ...]) -> Color:
    """The first grey that is well apart from all colours, else the one furthest from them."""

    def nearest(grey: int) -> int:
        return min((sum((c - grey) ** 2 for c in color) for color in colors), default=_APART)

    grey = next((g for g in _GREYS if nearest(g) >= _APART), max(_GREYS, key=nearest))
    return grey, grey, grey


def _luminance(color: Color) -> float:
    """What contrast ratios are made of, as the Web Content Accessibility Guidelines 2.1 do."""
    red, green, blue = ((channel / 255.0) ** 2.2 for channel in color)
    return 0.05 + 0.2126 * red + 0.7152 * green + 0.0722 * blue


def _enlarge(colors: NDArray[np.uint8], scale: int) -> NDArray[np.uint8]:
    return colors.repeat(scale, axis=0).repeat(scale, axis=1)


def _draw_path(image: NDArray[np.uint8], cells: NDArray[np.intp], scale: int, color: Color) -> None:
    """A line through the cells' middles, and a square where it begins."""
    if not len(cells):
        return
    line = min(6, scale // 4)
    rim = 0 if scale < _LEAST_RIM_SCALE else max(1, line // 3)
    other = _INK if color == _WHITE else _WHITE
    middles = cells * scale + (scale - line) // 2
    for grow, ink in ((rim, other), (0, color)):
        for ends in zip(middles, middles[1:], strict=False):
            top, left = np.minimum(*ends) - grow
            bottom, right = np.maximum(*ends) + line + grow
            image[top:bottom, left:right] = ink
    row, col = middles[0]
    for grow, ink in ((rim + 2, color), (rim + 1, other)):
        top, left = max(0, row - grow), max(0, col - grow)
        image[top : row + line + grow, left : col + line + grow] = ink


def _draw_robot(image: NDArray[np.uint8], robot: tuple[int, int], scale: int) -> None:
    """A ring around a dot, at least as large as can be seen."""
    row, col = ((2 * at + 1) * scale / 2 - 0.5 for at in robot)
    radius = min(_MOST_RADIUS, max(_LEAST_RADIUS, 0.46 * scale))
    top, left = max(0, int(row - radius)), max(0, int(col - radius))
    window = image[top : int(row + radius) + 2, left : int(col + radius) + 2]
    rows, cols = np.ogrid[: window.shape[0], : window.shape[1]]
    distance = np.hypot(rows + top - row, cols + left - col)
    for share, color in ((1.0, _WHITE), (0.8, _INK), (0.55, _WHITE), (0.3, _INK)):
        window[distance <= radius * share] = color


def _join(panels: list[NDArray[np.uint8]], *, axis: int) -> NDArray[np.uint8]:
    """Panels along an axis with a gap between, both sides rounded up to even."""
    shape = list(panels[0].shape)
    shape[axis] = _GAP
    gap = np.full(shape, _EDGE, dtype=np.uint8)
    image = np.concatenate([part for panel in panels for part in (gap, panel)][1:], axis=axis)
    height, width, _ = image.shape
    return np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _marks(
    shape: tuple[int, ...], cells: NDArray[np.intp], robot: tuple[int, int]
) -> NDArray[np.str_]:
    marks = np.full(shape, " ")
    marks[tuple(cells.T)] = "*"
    marks[tuple(robot)] = "@"
    return marks


def _ascii_lines(values: NDArray[np.uint8], marks: NDArray[np.str_]) -> Iterator[str]:
    symbols = np.full(256, ".")
    symbols[: len(_SYMBOLS)] = list(_SYMBOLS)
    for line in np.stack([symbols[values], marks], axis=-1):
        yield "".join(line.ravel().tolist())


def _wide_lines(colors: NDArray[np.uint8], marks: NDArray[np.str_]) -> Iterator[str]:
    """Lines of cells two characters wide, on the cell's colour."""
    wide = {" ": "  ", "*": "··", "@": "()"}
    for line, line_marks in zip(colors.tolist(), marks.tolist(), strict=True):
        cells: list[tuple[str, str]] = []
        for (red, green, blue), mark in zip(line, line_marks, strict=True):
            ink = 0 if _luminance((red, green, blue)) > 0.23 else 255
            cells.append((f"38;2;{ink};{ink};{ink};48;2;{red};{green};{blue}", wide[mark]))
        yield _styled(cells)


def _half_lines(colors: NDArray[np.uint8], robot: tuple[int, int]) -> Iterator[str]:
    """Lines of cells half a character high: the upper one in front, the lower one behind it."""
    colors = colors.copy()
    colors[tuple(robot)] = _WHITE
    for row in range(0, len(colors), 2):
        cells: list[tuple[str, str]] = []
        for col, (red, green, blue) in enumerate(colors[row].tolist()):
            behind = "49"
            if row + 1 < len(colors):
                behind = "48;2;{};{};{}".format(*colors[row + 1, col].tolist())
            cells.append((f"38;2;{red};{green};{blue};{behind}", "▀"))
        yield _styled(cells)


def _styled(cells: list[tuple[str, str]]) -> str:
    """Texts with their style, which is written only where it changes."""
    runs = itertools.groupby(cells, key=lambda cell: cell[0])
    texts = (f"\x1b[{style}m" + "".join(text for _, text in run) for style, run in runs)
    return "".join(texts) + "\x1b[0m"
