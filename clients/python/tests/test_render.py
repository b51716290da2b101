"""Pictures: colours of cells, contrast of marks, constant sizes, and the available screens."""

import logging
import re
import sys
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pytest
from environments import actions, make, make_vec
from numpy.typing import NDArray

from emberwatch.model import Model
from emberwatch.model.airspace import Airspace
from emberwatch.render import Palette, Picture, ansi, rgb_array
from emberwatch.render.palette import ROBOTS, mark_on
from emberwatch.render.screen import Screen

WILDFIRE = Palette.of(Model.wildfire())
NORMAL, LATENT, FIRE = WILDFIRE.observations
DARK, WHITE = (0x14, 0x14, 0x14), (255, 255, 255)
FRAME = np.array([[0, 255, 255], [2, 1, 255]], np.uint8)
TRUTH = np.array([[0, 1, 2], [2, 1, 0]], np.uint8)
PATH = np.array([(0, 0), (1, 0), (1, 1)])
PARTS: dict[str, Any] = {"frame": FRAME, "robots": [(1, 1)], "palette": WILDFIRE, "paths": [PATH]}


def pixel(image: NDArray[np.uint8], row: int, col: int) -> tuple[int, ...]:
    return tuple(image[row, col].tolist())


def draw(**changes: Any) -> NDArray[np.uint8]:
    scale = changes.pop("scale", 40)
    return rgb_array(Picture(**PARTS | changes), scale=scale)


def text(**changes: Any) -> list[str]:
    return ansi(Picture(**PARTS | changes)).split("\n")


def test_cells_are_squares_of_their_colour() -> None:
    image = draw()
    assert image.shape == (80, 120, 3) and image.dtype == np.uint8
    for row, col, color in ((0, 0, NORMAL), (1, 0, FIRE), (1, 1, LATENT), (0, 2, None)):
        for down, right in ((0, 0), (0, 39), (39, 0), (39, 39)):
            at = 40 * row + down, 40 * col + right
            assert pixel(image, *at) == (color or WILDFIRE.unobserved)
    cells = WILDFIRE.paint_frame(FRAME).repeat(40, axis=0).repeat(40, axis=1)
    assert (draw(robots=[], paths=[]) == cells).all()
    # Odd pictures repeat their last row and column.
    image = draw(frame=np.full((3, 3), 2, np.uint8), robots=[(0, 0)], paths=[], scale=15)
    assert image.shape == (46, 46, 3)
    assert pixel(image, 45, 45) == pixel(image, 45, 0) == FIRE


def test_the_path_is_a_line_that_ends_at_the_robot() -> None:
    image = draw()
    assert pixel(image, 40, 20) == DARK  # between the first two cells
    assert pixel(image, 20, 20) == WHITE  # where the path begins
    assert pixel(image, 60, 60) == DARK  # the robot's dot
    assert {DARK, WHITE} <= {pixel(image, 60, col) for col in range(45, 60)}  # and its circle
    without = draw(paths=[])
    assert pixel(without, 40, 20) == FIRE and pixel(without, 20, 20) == NORMAL
    unseen = draw(frame=np.full((2, 3), 255, np.uint8))
    assert pixel(unseen, 40, 20) == WHITE and pixel(unseen, 40, 12) == WILDFIRE.unobserved
    robots, paths = [(1, 1), (0, 2)], [PATH, np.array([(0, 1), (0, 2)])]
    image = draw(robots=robots, paths=paths)
    for (row, col), color in zip(robots, ROBOTS, strict=False):
        assert pixel(image, 40 * row + 20, 40 * col + 20) == color
    assert (pixel(image, 40, 20), pixel(image, 20, 80)) == ROBOTS[:2]  # the lines between cells


def test_the_truth_is_drawn_to_the_right_or_below() -> None:
    image = draw(truth=TRUTH)
    assert pixel(image, 5, 128 + 45) == LATENT and pixel(image, 5, 128 + 85) == FIRE
    assert pixel(image, 5, 124) == (0xB4, 0xB4, 0xB4)
    wide = np.zeros((2, 6), np.uint8)
    assert draw(frame=wide, truth=wide, scale=10).shape == (20 + 8 + 20, 60, 3)


def test_panels_are_about_512_pixels_with_even_sides() -> None:
    for grid, panel, both in (
        ((7, 5), (518, 370), (518, 748)),
        ((40, 128), (160, 512), (328, 512)),
        ((600, 601), (600, 602), (600, 1210)),
    ):
        parts = {"frame": np.full(grid, 255, np.uint8), "robots": [(0, 0)], "paths": []}
        assert draw(**parts, scale=None).shape[:2] == panel
        assert draw(**parts, truth=np.zeros(grid, np.uint8), scale=None).shape[:2] == both


def test_grey_and_path_differ_from_the_models_colours() -> None:
    assert (WILDFIRE.unobserved, WILDFIRE.path) == ((0x30,) * 3, DARK)
    toml = Model.wildfire().toml
    dark = Model.from_toml(re.sub(r"#\w{6}\"", '#202028"', toml))
    assert Palette.of(dark).unobserved == (0x60,) * 3
    assert Palette.of(dark).path == WHITE
    assert mark_on(np.array([NORMAL, LATENT], np.uint8)).tolist() == [list(WHITE), list(DARK)]
    # A hidden model has colours, too.
    palette = Palette.of(3)
    assert palette.observations == WILDFIRE.observations
    draw(palette=palette, truth=TRUTH + np.uint8(60))
    assert len(set(Palette.of(8).observations)) == 8


def styled(*colors: Any) -> str:
    """Returns the style of text with these colours of the foreground and the background."""
    return ";".join("{};2;{};{};{}".format(n, *it) for n, it in zip((38, 48), colors, strict=False))


def test_a_cell_of_text_is_two_characters() -> None:
    first, second = text()
    tint = [round(0.55 * it + 255 * 0.45) for it in NORMAL]
    grey = WILDFIRE.unobserved
    assert first == f"\x1b[{styled(tint, tint)}m▀▀\x1b[{styled(grey, grey)}m▀▀▀▀\x1b[0m"
    assert f"\x1b[{styled(WHITE, WHITE)}m▀▀" in second, "the robot"
    assert text(truth=TRUTH)[1].count(styled(WHITE, WHITE)) == 2
    team = text(robots=[(1, 1), (0, 2)])
    assert styled(ROBOTS[0]) in team[1] and styled(ROBOTS[1]) in team[0]


def test_a_cell_of_a_tall_grid_is_half_a_character() -> None:
    tall = np.full((41, 3), 255, np.uint8)
    tall[1] = 2
    lines = text(frame=tall, robots=[(0, 0)], paths=[])
    assert len(lines) == 21
    assert lines[0].startswith(f"\x1b[{styled(WHITE, FIRE)}m▀")
    assert lines[-1] == "\x1b[38;2;48;48;48;49m▀▀▀\x1b[0m"


NO_FLY = np.array([[False, True, False], [False, False, True]])


def test_no_fly_cells_are_hatched_in_a_colour_that_stands_out() -> None:
    bare: dict[str, Any] = {"robots": [], "paths": [], "truth": TRUTH}
    closed = bare | {"airspace": Airspace(no_fly=NO_FLY)}
    plain, image = draw(**bare), draw(**closed)
    for left, (row, col) in product((0, 128), np.ndindex(FRAME.shape)):
        area = np.s_[40 * row : 40 * row + 40, left + 40 * col : left + 40 * col + 40]
        before, after = plain[area].reshape(-1, 3), image[area].reshape(-1, 3)
        changed = (before != after).any(axis=1)
        assert (0.1 < changed.mean() < 0.5) == NO_FLY[row, col] == changed.any()
        assert (after[changed] == mark_on(before[0])).all()
    assert (draw(**closed, scale=1) != draw(**bare, scale=1)).any(), "in cells of a pixel, too"
    assert text(**closed) != text(**bare)


def test_a_line_surrounds_cells_seen_beyond_the_path() -> None:
    bare: dict[str, Any] = {"robots": [], "paths": []}
    plain, image = draw(**bare, scale=20), draw(**bare, scale=20, airspace=Airspace(radius=1))
    changed = (plain != image).any(axis=2)
    assert changed[:20, 20].all() and changed[20:, 40].all()
    assert (plain[changed] == WILDFIRE.unobserved).all(), "what was seen is not covered"
    assert (image[changed] == WHITE).all() and changed.sum() < 100


@pytest.fixture(autouse=True)
def headless(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)


def test_a_window_shows_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    screen, other = Screen(fps=1000), Screen(fps=1000)  # share one window in turn
    assert screen.kind == "window"
    for parts in (PARTS, PARTS | {"truth": TRUTH}):
        for one in (other, screen):
            one.show(Picture(**parts))
        shown = pygame.surfarray.array3d(pygame.display.get_surface()).transpose(1, 0, 2)
        assert (shown == rgb_array(Picture(**parts))).all()
    other.close()
    screen.show(Picture(**PARTS))
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    screen.show(Picture(**PARTS))
    assert screen.kind == "nothing" and not pygame.display.get_init()
    screen.show(Picture(**PARTS))
    screen.close()


def test_a_terminal_redraws_the_text_in_place(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    screen = Screen(fps=1000)
    assert screen.kind == "terminal"
    screen.show(Picture(**PARTS))
    screen.show(Picture(**PARTS, truth=TRUTH))
    screen.close()
    screen.show(Picture(**PARTS))
    first, second = ansi(Picture(**PARTS)), ansi(Picture(**PARTS, truth=TRUTH))
    shown = f"\x1b[2J\x1b[H{first}\x1b[K\n\x1b[J\x1b[H{second}\x1b[K\n\x1b[J"
    assert capsys.readouterr().out == shown


@pytest.mark.parametrize("making", [make, partial(make_vec, 2)])
def test_each_step_is_shown_to_a_human(
    making: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    shown, drawn = (making(render_mode=mode) for mode in ("human", "ansi"))
    for env in (drawn, shown):
        env.reset(seed=1)
        capsys.readouterr()
        env.step(actions(env, 1)[0])
    picture = np.atleast_1d(drawn.render())[0]
    assert picture in capsys.readouterr().out and shown.render() in (None, (None, None))


def test_a_missing_screen_is_logged_once(
    caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    with caplog.at_level(logging.WARNING):
        screen = Screen(fps=0.001)
        screen.show(Picture(**PARTS))
        screen.show(Picture(**PARTS))
        screen.close()
    assert screen.kind == "nothing" and capsys.readouterr().out == ""
    (record,) = caplog.records
    assert "shows nothing: it needs pygame and a display, or a terminal" in record.message


def test_pictures_are_limited_to_fps(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setattr("time.sleep", waits.append)
    monkeypatch.setattr("time.monotonic", lambda: 50.0)
    screen = Screen(fps=4.0)
    for _ in range(3):
        screen.show(Picture(**PARTS))
    assert waits == [0.25, 0.25]
