"""The pages of a film: a row of pictures with titles and legends, drawn with Pillow."""

from collections.abc import Iterator
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from emberwatch.belief import entropy
from emberwatch.client.replies import ServerInfo
from emberwatch.model import Color, Model
from emberwatch.model.moves import fly
from emberwatch.render import Picture, draw_hatches, rgb_array
from emberwatch.render.palette import LIGHT, Palette
from emberwatch.render.scenes import Scene

_MARGIN, _GAP, _LINE, _SWATCH = 14, 16, 20, 12  # pixels
_TOP = 76  # y of the panels, below step and titles, pixels
_LEAST_ROOM = 150  # minimum width of a panel's column, for its title and legend, pixels
_LEAST_WIDTH = 400  # minimum width of a page, for the step and its reward, pixels
_LONG_SIDE, _MOST_SCALE = 200, 20  # default side of a panel, and maximum default side of a cell
_INK, _EDGE = (0x33, 0x33, 0x33), (0x66, 0x66, 0x66)
_SHADES = 24  # number of shades of a probability; more make larger files without visible gain
# ColorBrewer's YlGnBu (Apache-2.0): its lightness falls evenly.
_RAMP = "ffffd9 edf8b1 c7e9b4 7fcdbb 41b6c4 1d91c0 225ea8 253494 081d58".split()

_TEXT = cast("ImageFont.FreeTypeFont", ImageFont.load_default(13))
_TITLE = cast("ImageFont.FreeTypeFont", ImageFont.load_default(17))

_Legend = list[tuple[NDArray[np.uint8], str]]


class Page:
    """The layout of a film's pages, which draws scenes."""

    def __init__(
        self,
        server: ServerInfo,
        model: Model | None,
        *,
        world: int,
        scale: int | None,
        has_truth: bool,
    ) -> None:
        """Draws the parts that all pages share; without a model, the belief is left out."""
        height, width = server.height, server.width
        described = server.recorded_states or model
        self._server, self._model, self._has_truth = server, model, has_truth
        self._name = f"{described.name if described else 'hidden model'}, world {world}"
        self._scale = scale or min(max(_LONG_SIDE // max(height, width), 1), _MOST_SCALE)
        self._room = max(_LEAST_ROOM, width * self._scale)
        self._palette = Palette.of(described or server.n_observations, on_paper=True)
        self._shades = replace(self._palette, observations=_ramp())
        columns = list(self._columns(described.state_names if described else ()))
        self._lefts = [_MARGIN + at * (self._room + _GAP) for at in range(len(columns))]
        below = _TOP + height * self._scale + 6
        n_lines = sum(len(legend) for _, legend in columns)  # an upper bound
        page_width = max(_LEAST_WIDTH, self._lefts[-1] + self._room + _MARGIN)
        base = Image.new("RGB", (page_width, below + (n_lines + 2) * _LINE), LIGHT)
        bottom = below
        for left, (title, legend) in zip(self._lefts, columns, strict=True):
            _write(base, (left, _TOP - 13), title)
            bottom = max(bottom, self._draw_legend(base, (left, below), legend))
        self._base = base.crop((0, 0, page_width, bottom + _LINE))

    @property
    def size(self) -> tuple[int, int]:
        return self._base.size

    def draw(self, scene: Scene) -> Image.Image:
        """Draws the page of a scene."""
        image, result = self._base.copy(), scene.frame.result
        title = f"step k = {result.step}"
        if result.step > 0:
            title += f": reward {result.reward:.4g}, mean {scene.mean_reward:.1f}"
        place = f"{self._name}, seed {result.seed}, episode {result.episode}"
        _write(image, (_MARGIN, 16), title, _TITLE)
        _write(image, (_MARGIN, 37), place)
        _write(image, (_MARGIN, image.height - _LINE // 2), _remarks(scene))
        for left, picture in zip(self._lefts, self._pictures(scene), strict=True):
            height, width = (it * self._scale for it in (self._server.height, self._server.width))
            edge = (left - 1, _TOP - 1, left + width, _TOP + height)
            ImageDraw.Draw(image).rectangle(edge, LIGHT, _EDGE)
            if picture is None:
                _write(image, (left + 4, _TOP + height // 2), "not recorded")
            else:
                pixels = rgb_array(picture, scale=self._scale)[:height, :width]
                image.paste(Image.fromarray(pixels), (left, _TOP))
        return image

    def _columns(self, states: tuple[str, ...]) -> Iterator[tuple[str, _Legend]]:
        """Yields the title and the legend of each panel."""
        palette = self._palette
        of_states = [(_swatch(it), name) for it, name in zip(palette.states, states, strict=False)]
        colors = zip(palette.observations, self._server.observations, strict=False)
        seen = [(_swatch(color), name) for color, name in colors]
        if self._has_truth:
            yield "truth (hidden)", of_states
            if self._server.observations == states:
                seen = []  # the legend of the hidden states names the same colours
        seen.append((_swatch(palette.unobserved), "not seen"))
        if self._server.airspace.no_fly is not None:
            closed = np.full((_SWATCH, _SWATCH, 3), LIGHT, np.uint8)
            draw_hatches(closed, np.ones((4, 4), np.bool_), scale=3)
            seen.append((_framed(closed), "no-fly"))
        robot = Picture(frame=np.zeros((1, 1), np.uint8), palette=self._shades, robots=[(0, 0)])
        yield "seen in this step", [*seen, (rgb_array(robot, scale=_SWATCH), "robot")]
        if self._model is not None:
            levels = np.tile(np.arange(_SHADES, dtype=np.uint8), (4, 1))
            ramp = _framed(rgb_array(Picture(frame=levels, palette=self._shades), scale=3))
            fire = self._model.state_names[self._model.target_state]
            yield f"belief: {fire}", [(ramp, "0 to 1")]
            most = np.log(self._model.n_states)
            yield "entropy of the belief", [(ramp, f"0 to {most:.2f} nats")]

    def _draw_legend(self, image: Image.Image, at: tuple[int, int], legend: _Legend) -> int:
        """Draws the marks and names of a legend in one or more lines; returns its lower edge."""
        x, y = at
        for mark, name in legend:
            width = mark.shape[1] + 5 + _TEXT.getlength(name)
            if x > at[0] and x + width > at[0] + self._room:
                x, y = at[0], y + _LINE
            image.paste(Image.fromarray(mark), (int(x), y + (_LINE - len(mark)) // 2))
            _write(image, (x + mark.shape[1] + 5, y + _LINE // 2), name)
            x += width + 12
        return y + _LINE

    def _pictures(self, scene: Scene) -> Iterator[Picture | None]:
        """Yields the picture of each panel; None if its contents are not recorded."""
        server, frame, palette = self._server, scene.frame.frame, self._palette
        paths = [
            np.array([it.result.start, *fly(it.result.start, it.path, server)], np.intp)
            for it in scene.frame.robots
        ]
        robots = [(int(path[-1, 0]), int(path[-1, 1])) for path in paths]
        seen = Picture(
            frame=frame, palette=palette, robots=robots, paths=paths, airspace=server.airspace
        )
        if self._has_truth:
            of_states = replace(palette, observations=palette.states)
            truth = scene.truth
            yield None if truth is None else replace(seen, frame=truth, palette=of_states, paths=())
        yield seen
        if self._model is not None and scene.belief is not None:
            shares = scene.belief[self._model.target_state]
            unsure = entropy(scene.belief) / np.log(self._model.n_states)
            for part in (shares, unsure):
                levels = np.rint(part.clip(0.0, 1.0) * (_SHADES - 1)).astype(np.uint8)
                yield replace(seen, frame=levels, palette=self._shades, paths=())


def _write(
    image: Image.Image, at: tuple[float, float], text: str, font: ImageFont.FreeTypeFont = _TEXT
) -> None:
    ImageDraw.Draw(image).text(at, text, _INK, font, "lm")


def _swatch(color: Color) -> NDArray[np.uint8]:
    return _framed(np.full((_SWATCH, _SWATCH, 3), color, np.uint8))


def _framed(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    framed = np.full((len(image) + 2, image.shape[1] + 2, 3), _EDGE, np.uint8)
    framed[1:-1, 1:-1] = image
    return framed


def _ramp() -> tuple[Color, ...]:
    """Returns the shades from light to dark."""
    anchors = np.array([list(bytes.fromhex(color)) for color in _RAMP])
    at = np.linspace(0, len(anchors) - 1, _SHADES)
    channels = [np.interp(at, range(len(anchors)), anchors[:, i]).round() for i in range(3)]
    return tuple((int(r), int(g), int(b)) for r, g, b in zip(*channels, strict=True))


def _remarks(scene: Scene) -> str:
    """Returns a text on missing steps, and on robots that did not fly."""
    is_late = scene.since > 0 and scene.belief is not None
    texts = [f"the belief begins at step {scene.since}"] * is_late
    texts += [f"{scene.n_lost} steps before this one are not recorded"] * (scene.n_lost > 0)
    result = scene.frame.result
    for what, mask in (("hovered", result.hovered), ("late", result.late)):
        robots = range(len(scene.frame.robots))
        texts += [f"robot {robot} {what}" for robot in robots if mask >> robot & 1]
    return "; ".join(texts)
