"""`python -m emberwatch.render.film`: makes a GIF or a PNG of a recording."""

from __future__ import annotations

import argparse
import io
import math
import sys
import warnings
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from emberwatch.belief import Belief, known
from emberwatch.belief.prior import prior_of
from emberwatch.client import recording
from emberwatch.client.observer import Truth
from emberwatch.client.replies import ServerInfo
from emberwatch.common.output import Parser, end_with_reader, number
from emberwatch.common.paths import shown
from emberwatch.errors import EmberwatchError, InvalidArgumentError, invalid
from emberwatch.model import Model
from emberwatch.render.scenes import MOST_PREDICTED, Scene, scenes

if TYPE_CHECKING:
    from PIL.Image import Image

    from emberwatch.render.page import Page

_NAME = "python -m emberwatch.render.film"
_PAUSE_MILLIS = 1000  # minimum duration of the last picture
_MOST_PIXELS = 1 << 30  # maximum sum over all pictures, which Pillow keeps in memory


def main(arguments: Sequence[str] | None = None) -> None:
    """Makes the film or still. On an error, exits with a message: code 2 for flags, otherwise 1."""
    parser = _parser()
    flags = parser.parse_args(arguments)
    if flags.step is not None:
        if (flags.first, flags.last, flags.every) != (0, math.inf, 1):
            parser.error("--step: expected no --from, --to or --every beside it, got one")
        flags.first = flags.last = flags.step
    if flags.out.suffix != (".gif" if flags.step is None else ".png"):
        parser.error(f"--out: expected a .gif, or with --step a .png, got {flags.out}")
    try:
        from emberwatch.render.page import Page
    except ImportError as error:
        parser.exit(1, f"{_NAME}: expected Pillow, got: {error}; pip install emberwatch[film]\n")
    try:
        with warnings.catch_warnings(action="always"):
            warnings.showwarning = _warn
            server, has_truth = _contents(flags.recording, flags.world)
            model = _model(flags.model, server)
            if model is None:
                _warn("no belief, as the recording has no model that fits; give --model")
            begin = None if model is None else partial(_begin, model, server)
            page = Page(server, model, world=flags.world, scale=flags.scale, has_truth=has_truth)
            _write(flags, page, scenes(recording.read(flags.recording, world=flags.world), begin))
    except (EmberwatchError, OSError) as error:
        parser.exit(1, f"{_NAME}: {error}\n")


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=_NAME,
        description="Make a film or a still of a recording: the hidden states, the robots' frames, "
        "and the belief of the known model's filter.",
    )
    add = parser.add_argument
    add("recording", type=Path, help="a recording of `emberwatch-server record`")
    add("--out", type=Path, required=True, metavar="FILE", help="a .gif, or with --step a .png")
    step = number(int, 0)
    add("--step", type=step, metavar="K", help="make a still of this step")
    add("--from", dest="first", type=step, default=0, metavar="K", help="first step to show [0]")
    add("--to", dest="last", type=step, default=math.inf, metavar="K", help="last step [the last]")
    add(
        "--every",
        type=number(int, 1),
        default=1,
        metavar="N",
        help="show every N-th step [1]",
    )
    add(
        "--fps",
        type=number(float, 0.1, 50),
        default=10.0,
        metavar="N",
        help="pictures per second, 0.1 to 50 [10]",
    )
    add("--world", type=int, default=0, metavar="N", help="number of the world [0]")
    add(
        "--scale",
        type=number(int, 1, 100),
        metavar="N",
        help="side of a cell in pixels [panels of about 200]",
    )
    add("--model", metavar="FILE", help="a model file [the recorded one]")
    return parser


def _contents(path: Path, world: int) -> tuple[ServerInfo, bool]:
    """Returns the first server of a world, and whether its hidden states are recorded."""
    server, has_truth, worlds = None, False, set[int]()
    with warnings.catch_warnings(action="ignore"):  # a second reading shows them
        for record in recording.read(path):
            worlds.add(record.sample.world)
            if record.sample.world == world:
                server = server or record.server
                has_truth |= isinstance(record.sample, Truth)
    if server is None:
        if not worlds:
            list(recording.read(path, strict=True))  # raises an error if the file is damaged
        recorded = ", ".join(map(str, sorted(worlds)))
        raise invalid("--world", f"one of the recorded worlds: {recorded}", world)
    return server, has_truth


def _model(path: str | None, server: ServerInfo) -> Model | None:
    """Returns the model of the file `path`, or without one the recorded model, if there is one."""
    if path is not None:
        return Model.named(path)
    try:
        return None if server.model is None else Model.from_toml(server.model)
    except InvalidArgumentError:  # it has a form of an earlier release
        return None


def _warn(warning: Warning | str, *_: object) -> None:
    print(f"{_NAME}: warning: {warning}", file=sys.stderr)


def _begin(model: Model, server: ServerInfo, k: int) -> Belief:
    """Makes the filter before the frame of step k, the first recorded step."""
    burn_in = min(server.burn_in + k, MOST_PREDICTED)
    grid = {"height": server.height, "width": server.width, "burn_in": burn_in}
    return known(model, prior=prior_of(None, model, **grid))


def _write(flags: argparse.Namespace, page: Page, scenes: Iterator[Scene]) -> None:
    """Draws the scenes and writes the file."""
    width, height = page.size
    most = _MOST_PIXELS // (width * height)
    pictures, last = list["Image"](), None
    for scene in scenes:
        last = scene.frame.result.step
        if flags.first <= last <= flags.last and (last - flags.first) % flags.every == 0:
            if len(pictures) == most:
                raise invalid("--every, --scale", f"at most {most} pictures of this size", "more")
            picture = page.draw(scene)
            # One byte a pixel. This changes colours only in pictures with more than 256.
            pictures.append(picture.quantize() if flags.step is None else picture)
            if flags.step is not None:
                break
    if not pictures:
        expected = f"some of the recorded steps, of which the last is {last}"
        raise invalid("--step, --from, --to", expected, f"{flags.first} to {flags.last}")
    content = io.BytesIO()
    if flags.step is not None:
        pictures[0].save(content, "PNG")
    else:
        millis = 10 * round(100 / flags.fps)  # GIF durations are multiples of 10 ms
        pictures[0].save(
            content,
            "GIF",
            save_all=True,
            append_images=pictures[1:],
            duration=[millis] * (len(pictures) - 1) + [max(millis, _PAUSE_MILLIS)],
            loop=0,
            optimize=True,  # stores only the changed part of each picture
        )
    flags.out.parent.mkdir(parents=True, exist_ok=True)
    flags.out.write_bytes(content.getbuffer())
    size = f"{width} x {height} pixels, {content.tell()} bytes"
    print(shown(f"{flags.out}: {len(pictures)} pictures of {size}"))


if __name__ == "__main__":
    end_with_reader()
    main()
