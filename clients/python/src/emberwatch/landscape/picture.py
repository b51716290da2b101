"""A picture of a sequence: some of its steps, and a curve of the burning cells."""

from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from emberwatch.landscape.fire import BURNING, BURNT
from emberwatch.landscape.world import COLORS, STATES

_COLUMNS, _ROWS = 4, 2  # number of panels
_SIDE, _GAP, _LINE, _CURVE = 220, 12, 20, 110  # pixels
_PAPER, _INK, _EDGE = (0xFF, 0xFF, 0xFF), (0x33, 0x33, 0x33), (0x99, 0x99, 0x99)
_TEXT: Final = cast("ImageFont.FreeTypeFont", ImageFont.load_default(13))


def draw(sequences: list[NDArray[np.uint8]], title: str) -> Image.Image:
    """Draws all sequences, one below the other."""
    parts = [
        _draw_one(states, title if len(sequences) == 1 else f"{title}, sequence {number}")
        for number, states in enumerate(sequences)
    ]
    whole = Image.new("RGB", (parts[0].width, sum(part.height for part in parts)), _PAPER)
    top = 0
    for part in parts:
        whole.paste(part, (0, top))
        top += part.height
    return whole


def _draw_one(states: NDArray[np.uint8], title: str) -> Image.Image:
    n_steps, height, width = states.shape
    share = _SIDE / max(height, width)
    size = max(1, round(width * share)), max(1, round(height * share))
    panel = size[0] + _GAP, size[1] + _LINE + _GAP
    whole = (_GAP + _COLUMNS * panel[0], 2 * _LINE + _ROWS * panel[1] + _CURVE + _LINE + _GAP)
    image = Image.new("RGB", whole, _PAPER)
    pen = ImageDraw.Draw(image)
    pen.text((_GAP, 4), f"{title}: {n_steps} steps, {height} x {width} cells", _INK, _TEXT)
    n_panels = _COLUMNS * _ROWS
    for number in range(n_panels):
        k = round(number * (n_steps - 1) / (n_panels - 1))
        row, column = divmod(number, _COLUMNS)
        left, top = _GAP + column * panel[0], 2 * _LINE + row * panel[1]
        pixels = Image.fromarray(np.array(COLORS, np.uint8)[states[k]])
        pen.text((left, top - _LINE + 4), f"k = {k}", _INK, _TEXT)
        image.paste(pixels.resize(size, Image.Resampling.NEAREST), (left, top))
        pen.rectangle((left - 1, top - 1, left + size[0], top + size[1]), None, _EDGE)
    _draw_curve(pen, states, (_GAP, 2 * _LINE + _ROWS * panel[1]), whole[0] - 2 * _GAP)
    return image


def _draw_curve(pen: Any, states: NDArray[np.uint8], corner: tuple[int, int], width: int) -> None:
    """Draws the shares of burning and of burnt cells over the steps."""
    left, top = corner
    at = np.linspace(0, len(states) - 1, width).round().astype(int)
    shares = {state: (states == state).mean(axis=(1, 2)) for state in (BURNING, BURNT)}
    most = max(1e-9, *(float(share.max()) for share in shares.values()))
    pen.rectangle((left, top, left + width, top + _CURVE), None, _EDGE)
    maxima = list[str]()
    for state, share in shares.items():
        ys = top + _CURVE - share[at] / most * (_CURVE - 4)
        points = [(left + x, round(float(y))) for x, y in enumerate(ys)]
        pen.line(points, COLORS[state], 2)
        maxima.append(f"{STATES[state].name} at most {100 * float(share.max()):.1f} %")
    pen.text((left, top + _CURVE + 2), f"share of cells: {', '.join(maxima)}", _INK, _TEXT)
