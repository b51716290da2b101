"""No-fly cells and cells seen beyond the path, in pictures."""

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emberwatch.render import Palette, Picture, ansi, rgb_array
from emberwatch.render.palette import mark_on
from emberwatch.render.scenery import Scenery

PALETTE = Palette.of(3)
FRAME = np.array([[0, 255, 255], [2, 255, 1]], np.uint8)
TRUTH = np.array([[0, 1, 2], [2, 1, 0]], np.uint8)
NO_FLY = np.array([[False, True, False], [False, False, True]])
SCALE = 20
GAP = 8


def draw(*, truth: bool = False, scale: int = SCALE, **scenery: Any) -> NDArray[np.uint8]:
    shown = Picture(FRAME, [], PALETTE, (), TRUTH if truth else None, Scenery(**scenery))
    return rgb_array(shown, scale=scale)


def cell(image: NDArray[np.uint8], row: int, col: int, left: int = 0) -> NDArray[np.uint8]:
    top, left = SCALE * row, left + SCALE * col
    return image[top : top + SCALE, left : left + SCALE].reshape(-1, 3)


def test_no_fly_cells_are_hatched_in_a_colour_that_stands_out() -> None:
    plain, image = draw(truth=True), draw(truth=True, no_fly=NO_FLY)
    for left, (row, col) in product((0, 3 * SCALE + GAP), np.ndindex(FRAME.shape)):
        before, after = (cell(drawn, row, col, left) for drawn in (plain, image))
        changed = (before != after).any(axis=1)
        assert (0.1 < changed.mean() < 0.5) == NO_FLY[row, col] == changed.any()
        ink = mark_on((before[0, 0], before[0, 1], before[0, 2]))
        assert (after[changed] == ink).all()
    assert (draw(scale=1, no_fly=NO_FLY) != draw(scale=1)).any(), "in cells of a pixel, too"


def test_a_line_surrounds_cells_seen_beyond_the_path() -> None:
    plain, image = draw(), draw(sees_beyond=True)
    changed = (plain != image).any(axis=2)
    assert changed[:, SCALE].all() and changed[SCALE - 1, 2 * SCALE :].all()
    assert (plain[changed] == PALETTE.unobserved).all(), "what was seen is not covered"
    assert (image[changed] == mark_on(PALETTE.unobserved)).all()
    assert changed.sum() < 5 * SCALE
    assert (draw(scale=2, sees_beyond=True) == draw(scale=2)).all(), "no room for lines"


def test_terminals_show_no_fly_cells() -> None:
    shown = Picture(FRAME, [(0, 0)], PALETTE, scenery=Scenery(no_fly=NO_FLY))
    assert ansi(shown, color=False).split("\n") == ["0@.x.", "2 . 1x"]
    assert "xx" in ansi(shown)
    tall, cells = FRAME.repeat(20, axis=0), NO_FLY.repeat(20, axis=0)
    plain = ansi(Picture(tall, [], PALETTE))
    assert ansi(Picture(tall, [], PALETTE, scenery=Scenery(no_fly=cells))) != plain
