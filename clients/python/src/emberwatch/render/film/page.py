"""Pictures of scenes: hidden states, path, belief and entropy, with legends."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from emberwatch.belief import entropy
from emberwatch.client.replies import ServerInfo
from emberwatch.errors import invalid
from emberwatch.model import Color, Model
from emberwatch.render import LEAST_LINE_SCALE, Picture, rgb_array
from emberwatch.render.film.scenes import Scene
from emberwatch.render.palette import DARK, LIGHT, ROBOTS, Palette
from emberwatch.render.scenery import Scenery

_MARGIN, _GAP, _LINE, _SWATCH = 14, 16, 20, 11  # pixels
_TOP = 68  # y of the panels, below step and titles, pixels
_LEAST_ROOM = 150  # minimum width of a panel's column, for its title and legend, pixels
_LONG_SIDE, _MOST_SCALE = 200, 20  # default side of a panel, and maximum default side of a cell
_MOST_SIDE, _MOST_AREA = 65_535, 1 << 26  # maximum side (the GIF format's) and area of a picture
_INK, _WARNING, _EDGE = (0x33, 0x33, 0x33), (0xD5, 0x5E, 0x00), (0x66, 0x66, 0x66)
_SHADES = 24  # number of shades of a probability; more make larger files without visible gain
# ColorBrewer's YlGnBu (Apache-2.0): its lightness falls evenly.
_RAMP = "ffffd9 edf8b1 c7e9b4 7fcdbb 41b6c4 1d91c0 225ea8 253494 081d58".split()

_FINE = 4  # factor by which texts are drawn larger, and then reduced
_TEXT = cast("ImageFont.FreeTypeFont", ImageFont.load_default(13 * _FINE))
_TITLE = cast("ImageFont.FreeTypeFont", ImageFont.load_default(16 * _FINE))

_Mark = Color | Literal["robot", "scale", "no-fly"]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Panel:
    title: str
    palette: Palette
    marks: list[tuple[_Mark, str]]
    cells: Callable[[Scene], NDArray[np.uint8] | None]
    """Returns each cell's index in the palette; None if a scene has no data for the panel."""
    has_path: bool = False


class Page:
    """The layout of a film's pictures, which draws scenes."""

    def __init__(
        self,
        server: ServerInfo,
        model: Model | None,
        *,
        world: int,
        scale: int | None,
        has_truth: bool,
    ) -> None:
        """Draws the parts that all pictures share; without a model, the belief is left out."""
        height, width = server.height, server.width
        described = server.recorded_states or model
        self._name = f"{described.name if described else 'hidden model'}, world {world}"
        self._scale = scale or min(max(_LONG_SIDE // max(height, width), 1), _MOST_SCALE)
        self._grid = height * self._scale, width * self._scale
        self._room = max(_LEAST_ROOM, self._grid[1])
        self._scenery = scenery = Scenery.of(server.airspace)
        source = described or server.n_observations
        palette = Palette.of(source, on_paper=True)
        names = (described.state_names if described else (), server.observations)
        self._panels = _panels(palette, names, model, scenery, has_truth=has_truth)
        self.palette = _film_palette(palette)
        n_panels = len(self._panels)
        bottom = _TOP + self._grid[0] + 6
        legends = [self._placed(panel.marks) for panel in self._panels]
        n_lines = max(1 + y // _LINE for legend in legends for _, _, (_, y) in legend)
        self._foot = bottom + n_lines * _LINE + _LINE // 2
        size = 2 * _MARGIN + n_panels * (self._room + _GAP) - _GAP, self._foot + _LINE
        if max(size) > _MOST_SIDE or size[0] * size[1] > _MOST_AREA:
            most = f"at most {_MOST_SIDE} pixels a side and {_MOST_AREA} in all"
            raise invalid("--scale", f"pictures of {most}", f"{size[0]} x {size[1]}")
        self._base = Image.new("RGB", size, LIGHT)
        for left, panel, legend in zip(self._lefts(), self._panels, legends, strict=True):
            _write(self._base, (left, _TOP - 13), _fit(panel.title, self._room))
            for mark, name, (x, y) in legend:
                self._draw_mark(mark, name, (left + x, bottom + y + _LINE // 2))

    @property
    def size(self) -> tuple[int, int]:
        return self._base.size

    def draw(self, scene: Scene) -> Image.Image:
        image, result = self._base.copy(), scene.step.frame.result
        middle, right = _MARGIN + 8, image.width - _MARGIN
        step = f"step k = {scene.k}"
        _write(image, (_MARGIN, middle), step, font=_TITLE)
        left = _MARGIN + _length(step, _TITLE) + _GAP
        if result.step > 0 and not scene.is_gap:
            reward = f"reward {result.reward:.4g}, mean {scene.mean_reward:.1f}"
            right -= _length(reward, _TITLE)
            _write(image, (right, middle), reward, font=_TITLE)
        place = f"{self._name}, seed {result.seed}"
        place += f", episode {result.episode}" if result.episode else ""
        _write(image, (left, middle), _fit(place, right - _GAP - left))
        for left, panel in zip(self._lefts(), self._panels, strict=True):
            self._draw_panel(image, left, panel, scene)
        text, color = _small_print(scene)
        _write(image, (_MARGIN, self._foot), _fit(text, image.width - 2 * _MARGIN), ink=color)
        return image

    def indexed(self, image: Image.Image) -> Image.Image:
        """Converts a picture to the film's palette."""
        return image.quantize(palette=self.palette, dither=Image.Dither.NONE)

    def _lefts(self) -> list[int]:
        return [_MARGIN + at * (self._room + _GAP) for at in range(len(self._panels))]

    def _draw_panel(self, image: Image.Image, left: int, panel: _Panel, scene: Scene) -> None:
        (height, width), draw = self._grid, ImageDraw.Draw(image)
        draw.rectangle((left - 1, _TOP - 1, left + width, _TOP + height), LIGHT, _EDGE)
        cells = panel.cells(scene)
        if cells is None:
            text = _fit("not recorded", width)
            at = left + (width - _length(text)) // 2, _TOP + height // 2
            _write(image, at, text, ink=_WARNING)
            return
        paths = scene.paths or []
        robots = [(row, col) for row, col in (path[-1].tolist() for path in paths)]
        if not panel.has_path or self._scale < LEAST_LINE_SCALE:
            paths = []
        picture = Picture(cells, robots, panel.palette, paths, scenery=self._scenery)
        pixels = rgb_array(picture, scale=self._scale)
        image.paste(Image.fromarray(pixels[:height, :width]), (left, _TOP))

    def _placed(self, marks: list[tuple[_Mark, str]]) -> list[tuple[_Mark, str, tuple[int, int]]]:
        """Returns the marks and names of a legend with their positions, on one or more lines."""
        x = y = 0
        placed: list[tuple[_Mark, str, tuple[int, int]]] = []
        for mark, name in marks:
            name = _fit(name, self._room - _width(mark))
            width = _width(mark) + _length(name)
            if x > 0 and x + width > self._room:
                x, y = 0, y + _LINE
            placed.append((mark, name, (x, y)))
            x += width + 12
        return placed

    def _draw_mark(self, mark: _Mark, name: str, at: tuple[int, int]) -> None:
        draw, (x, y) = ImageDraw.Draw(self._base), at
        top, bottom = y - _SWATCH // 2, y + _SWATCH // 2
        blank = Palette(states=(), observations=(LIGHT,), unobserved=LIGHT, path=DARK)
        if mark == "robot":
            frame = np.zeros((1, 1), np.uint8)
            robot = rgb_array(Picture(frame, [(0, 0)], blank), scale=_SWATCH + 1)
            self._base.paste(Image.fromarray(robot), (x, top))
        elif mark == "no-fly":
            frame = np.zeros((4, 4), np.uint8)
            hatch = Picture(frame, [], blank, scenery=Scenery(no_fly=frame == 0))
            self._base.paste(Image.fromarray(rgb_array(hatch, scale=3)), (x, top))
            draw.rectangle((x, top, x + _SWATCH, bottom), outline=_EDGE)
        elif mark == "scale":
            _write(self._base, (x, y), "0")
            draw.rectangle((x + 11, top - 1, x + 76, bottom + 1), outline=_EDGE)
            for column, color in enumerate(_ramp(64), x + 12):
                draw.line((column, top, column, bottom), color)
        else:
            draw.rectangle((x, top, x + _SWATCH - 1, bottom), mark, outline=_EDGE)
        _write(self._base, (x + _width(mark), y), name)


def _write(
    image: Image.Image,
    at: tuple[int, int],
    text: str,
    *,
    font: ImageFont.FreeTypeFont = _TEXT,
    ink: Color = _INK,
) -> None:
    """Writes text with its left edge and middle at `at`.

    It is drawn large and then reduced, which keeps the letters apart.
    """
    mask = Image.new("L", (_FINE * (_length(text, font) + 2), 2 * int(font.size)))
    draw, bold = ImageDraw.Draw(mask), 1 if font is _TITLE else 0
    draw.text((0, mask.height / 2), text, 255, font, "lm", stroke_width=bold)
    mask = mask.reduce(_FINE)
    image.paste(ink, (at[0], at[1] - mask.height // 2), mask)


def _length(text: str, font: ImageFont.FreeTypeFont = _TEXT) -> int:
    return math.ceil(font.getlength(text) / _FINE)


def _fit(text: str, room: float) -> str:
    """Returns the text, shortened if it is wider than `room` pixels."""
    if _length(text) <= room:
        return text
    while text and _length(f"{text}…") > room:
        text = text[:-1]
    return f"{text}…" if text else ""


def _film_palette(palette: Palette) -> Image.Image:
    """Returns the colours of cells, marks and text, at most 256."""
    cells = np.array([*palette.observations, palette.unobserved])
    inks = np.linspace(LIGHT, [_INK, _WARNING], 8).reshape(-1, 3)
    marks = np.array([DARK, LIGHT, _EDGE, *ROBOTS, *palette.states, *_ramp(_SHADES)])
    image = Image.new("P", (1, 1))
    colors = np.concatenate([cells, marks, inks])[:256]
    image.putpalette(colors.astype(np.uint8).tobytes())
    return image


def _panels(
    palette: Palette,
    names: tuple[Sequence[str], Sequence[str]],
    model: Model | None,
    scenery: Scenery,
    *,
    has_truth: bool,
) -> list[_Panel]:
    states = list[tuple[_Mark, str]](zip(palette.states, names[0], strict=False))
    seen = list[tuple[_Mark, str]](zip(palette.observations, names[1], strict=False))
    if has_truth and seen == states:
        seen = []  # the legend of the hidden states names the same colours
    truth = _Panel(
        title="truth (hidden)",
        palette=replace(palette, observations=palette.states),
        marks=states,
        cells=lambda scene: None if scene.is_gap else scene.step.truth,
    )
    path = _Panel(
        title="seen in this step",
        palette=palette,
        marks=[*seen, *_land(palette, scenery), ("robot", "robot")],
        cells=lambda scene: None if scene.is_gap else scene.step.frame.frame,
        has_path=True,
    )
    panels = [truth, path] if has_truth else [path]
    if model is not None:
        shades = replace(palette, observations=_ramp(_SHADES))
        target, most = model.target_state, float(np.log(model.n_states))
        belief = _Panel(
            title=f"belief: {model.state_names[target]}",
            palette=shades,
            marks=[("scale", "1")],
            cells=lambda scene: None if scene.belief is None else _levels(scene.belief[target]),
        )
        unsure = _Panel(
            title="entropy of the belief",
            palette=shades,
            marks=[("scale", f"{most:.2f} nats")],
            cells=lambda scene: (
                None if scene.belief is None else _levels(entropy(scene.belief) / most)
            ),
        )
        panels += [belief, unsure]
    return panels


def _land(palette: Palette, scenery: Scenery) -> list[tuple[_Mark, str]]:
    """Returns the legend of unseen cells and of no-fly cells."""
    marks: list[tuple[_Mark, str]] = [(palette.unobserved, "not seen")]
    if scenery.no_fly is not None:
        marks.append(("no-fly", "no-fly"))
    return marks


def _levels(shares: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.rint(shares.clip(0.0, 1.0) * (_SHADES - 1)).astype(np.uint8)


def _ramp(n_colors: int) -> tuple[Color, ...]:
    """Returns colours from light to dark."""
    anchors = np.array([list(bytes.fromhex(color)) for color in _RAMP])
    at = np.linspace(0, len(anchors) - 1, n_colors)
    channels = [np.interp(at, range(len(anchors)), anchors[:, i]).round() for i in range(3)]
    return tuple((int(r), int(g), int(b)) for r, g, b in zip(*channels, strict=True))


def _width(mark: _Mark) -> int:
    """Returns the width of a mark and the space after it, pixels."""
    return 12 + 64 + 6 if mark == "scale" else _SWATCH + 5


def _small_print(scene: Scene) -> tuple[str, Color]:
    """Returns a text on the limits of a scene, such as missing steps, and its colour."""
    if scene.is_gap:
        first = scene.k - (scene.step.n_lost or 0) + 1
        lost = f"step {first} is" if first == scene.k else f"steps {first} to {scene.k} are"
        predicted = "" if scene.belief is None else ": the belief is only predicted"
        return f"{lost} not recorded{predicted}", _WARNING
    begins = f"the belief begins at step {scene.since}"
    lost = f"{scene.n_lost} steps before this one are not recorded"
    texts = [begins] * (scene.since > 0) + [lost] * (scene.n_lost > 0)
    result = scene.step.frame.result
    for what, mask in (("hovered", result.hovered), ("late", result.late)):
        texts += [
            f"robot {robot} {what}" for robot in range(mask.bit_length()) if mask >> robot & 1
        ]
    return "; ".join(texts), _INK
