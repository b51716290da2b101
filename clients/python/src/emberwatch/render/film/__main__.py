"""`python -m emberwatch.render.film`: makes a GIF or a PNG of a recording."""

from __future__ import annotations

import argparse
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from emberwatch.belief import Belief, known
from emberwatch.belief.prior import PriorKind, prior_of
from emberwatch.client import recording
from emberwatch.client.observer import Frame
from emberwatch.client.replies import ServerInfo
from emberwatch.common.output import end_with_reader
from emberwatch.common.paths import shown
from emberwatch.errors import EmberwatchError, InvalidArgumentError, invalid
from emberwatch.model import Model
from emberwatch.render.film.scenes import Scene, Selection, scenes, steps

if TYPE_CHECKING:
    from PIL.Image import Image

    from emberwatch.render.film.page import Page

_NAME = "python -m emberwatch.render.film"
_PAUSE_MILLIS = 1000  # minimum duration of the last picture and of pictures of gaps
_MOST_PIXELS = 1 << 30  # maximum sum over all pictures, which Pillow keeps in memory
_MOST_SIMULATED = 100_000  # maximum burn-in of a first belief; longer ones do not change it
_MOST_NAMED = 6  # maximum number of runs of steps in an error


def main(arguments: Sequence[str] | None = None) -> None:
    """Makes the film or still. On an error, exits with a message: code 2 for flags, otherwise 1."""
    parser = _parser()
    flags = parser.parse_args(arguments)
    selection = _selection(flags, parser.error)
    try:
        from emberwatch.render.film.page import Page
    except ImportError as error:
        parser.exit(1, f"{_NAME}: expected Pillow, got: {error}; pip install emberwatch[film]\n")
    try:
        server, has_truth, n_scenes = _survey(flags, selection)
        model = _model(flags.model, server)
        begin = None if model is None else partial(_begin, flags.prior, model, server)
        page = Page(server, model, world=flags.world, scale=flags.scale, has_truth=has_truth)
        with warnings.catch_warnings(action="ignore"):  # `_survey` has printed them
            recorded = steps(recording.read(flags.recording, world=flags.world))
            _write(flags, page, n_scenes, scenes(recorded, selection, begin))
    except (EmberwatchError, OSError) as error:
        parser.exit(1, f"{_NAME}: {error}\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_NAME,
        description="Make a film or a still of a recording: the hidden states, the robots' frames, "
        "and the belief of the known model's filter.",
    )
    add = parser.add_argument
    add("recording", type=Path, help="a recording of `emberwatch-server record`")
    add("--out", type=Path, required=True, metavar="FILE", help="a .gif, or with --step a .png")
    add("--step", type=int, metavar="K", help="make a still of this step")
    add("--from", type=int, default=0, metavar="K", help="first step to show [0]")
    add("--to", type=int, default=math.inf, metavar="K", help="last step to show [the last]")
    add("--every", type=int, default=1, metavar="N", help="show every N-th step [1]")
    add("--fps", type=float, default=10.0, metavar="N", help="pictures per second, 0.1 to 50 [10]")
    add("--world", type=int, default=0, metavar="N", help="number of the world [0]")
    add("--scale", type=int, metavar="N", help="side of a cell in pixels [panels of about 200]")
    add("--model", metavar="FILE", help="a model file [the recorded one]")
    priors = ("simulated", "initial", "uniform")
    add(
        "--prior", choices=priors, default="simulated", help="the filter's first belief [simulated]"
    )
    return parser


def _selection(flags: argparse.Namespace, error: Callable[[str], NoReturn]) -> Selection:
    """Checks the flags, and returns the steps to show; a still is a film of one step."""
    values: dict[str, Any] = vars(flags)
    for name, least, most in (
        ("step", 0, math.inf),
        ("from", 0, math.inf),
        ("to", values["from"], math.inf),
        ("every", 1, math.inf),
        ("fps", 0.1, 50),
        ("scale", 1, 100),
    ):
        if values[name] is not None and not least <= values[name] <= most:
            error(f"--{name}: expected {least} to {most}, got {values[name]}")
    suffix = ".gif" if flags.step is None else ".png"
    if flags.out.suffix != suffix:
        error(f"--out: expected a .gif, or with --step a .png, got {flags.out}")
    if flags.step is None:
        return Selection(first=values["from"], last=flags.to, every=flags.every)
    if (values["from"], flags.to, flags.every) != (0, math.inf, 1):
        error("--step: cannot be combined with --from, --to or --every")
    return Selection(first=flags.step, last=flags.step, every=1)


def _survey(flags: argparse.Namespace, selection: Selection) -> tuple[ServerInfo, bool, int]:
    """Reads the recording once, and prints warnings about missing parts.

    Returns the server, whether hidden states are recorded, and the number of scenes.
    """
    worlds, episodes = set[int](), set[int]()
    runs = list[tuple[int, int]]()
    server: ServerInfo | None = None
    n_steps = n_gaps = n_lost = 0
    has_truth = False

    def of_world() -> Iterator[recording.Record]:
        for record in recording.read(flags.recording):
            if isinstance(record.sample, Frame):
                worlds.add(record.sample.world)
            if record.sample.world == flags.world:
                yield record

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for step in steps(of_world()):
            server, k = server or step.server, step.frame.result.step
            runs.append((runs.pop()[0] if step.n_lost == 0 else k, k))
            n_lost += step.n_lost or 0
            n_gaps += selection.shows_gap(step)
            if selection.shows(step):
                n_steps += 1
                has_truth |= step.truth is not None
                episodes.add(step.frame.result.episode)
    if server is None and not worlds and caught:
        raise EmberwatchError(str(caught[-1].message), "recording")
    if server is None:
        recorded = ", ".join(map(str, sorted(worlds)))
        raise invalid("--world", f"one of the recorded worlds {recorded}", flags.world)
    if n_steps == 0:
        known = ", ".join(f"{first} to {last}" for first, last in runs[:_MOST_NAMED])
        more = ", ..." if len(runs) > _MOST_NAMED else ""
        raise InvalidArgumentError(
            f"--step, --from, --to: expected some of the recorded steps {known}{more}, "
            f"got {selection.first} to {selection.last}"
        )
    said = [str(warning.message) for warning in caught]
    if n_lost:
        said.append(f"{n_lost} steps are not recorded; the belief is predicted through them")
    if flags.step is not None and len(episodes) > 1:
        said.append(f"--step: recorded in {len(episodes)} episodes; showing the first")
    for warning in said:
        _warn(warning)
    return server, has_truth, n_steps + n_gaps


def _model(path: str | None, server: ServerInfo) -> Model | None:
    """Returns the model of the file `path`, or without one the recorded model.

    Warns and returns None if there is no recorded model, or it has a form of an earlier release.
    """
    if path is not None:
        model = Model.named(path)
        if model.n_observations != server.n_observations:
            raise InvalidArgumentError(
                f"--model: expected one with {server.n_observations} observations, as recorded, "
                f"got {model.n_observations}"
            )
        return model
    problem = "the server hid its model"
    if server.recorded_world is not None:
        problem = "recorded worlds have no model"
    if server.model is not None:
        try:
            return Model.from_toml(server.model)
        except InvalidArgumentError:
            problem = "the model has a form of an earlier release"
    _warn(f"the belief is left out, as {problem}; give --model")
    return None


def _warn(warning: str) -> None:
    print(f"{_NAME}: warning: {warning}", file=sys.stderr)


def _begin(prior: PriorKind, model: Model, server: ServerInfo, k: int) -> Belief:
    """Makes the filter before the frame of step k, the first recorded step."""
    burn_in = min(server.burn_in + k, _MOST_SIMULATED)
    grid = {"height": server.height, "width": server.width, "burn_in": burn_in}
    return known(model, prior=prior_of(prior, model, **grid))


def _write(flags: argparse.Namespace, page: Page, n_scenes: int, scenes: Iterator[Scene]) -> None:
    """Writes a temporary file next to the output and renames it, so that no output is partial."""
    (width, height), out = page.size, flags.out
    if n_scenes * width * height > _MOST_PIXELS:
        most = _MOST_PIXELS // (width * height)
        raise invalid("--every, --scale", f"at most {most} pictures of this size", n_scenes)
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        if flags.step is not None:
            page.draw(next(scene for scene in scenes if not scene.is_gap)).save(temporary, "PNG")
        else:
            pictures = _pictures(page, scenes, n_scenes, flags.fps)
            next(pictures).save(
                temporary,
                "GIF",
                save_all=True,
                append_images=pictures,
                loop=0,
                optimize=True,  # stores only the changed part of each picture
                palette=page.palette.getpalette(),
            )
        os.replace(temporary, out)
    finally:
        temporary.unlink(missing_ok=True)
    size = f"{width} x {height} pixels, {out.stat().st_size} bytes"
    print(shown(f"{out}: {n_scenes} pictures of {size}"))


def _pictures(page: Page, scenes: Iterator[Scene], n_scenes: int, fps: float) -> Iterator[Image]:
    """Draws scenes and sets how long each is shown: the last scene and gaps are shown longer."""
    for number, scene in enumerate(scenes, 1):
        image = page.indexed(page.draw(scene))
        millis = 10 * round(100 / fps)  # GIF durations are multiples of 10 ms
        stays = scene.is_gap or number == n_scenes
        image.info["duration"] = max(millis, _PAUSE_MILLIS) if stays else millis
        yield image


if __name__ == "__main__":
    end_with_reader()
    main()
