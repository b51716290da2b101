"""What `emberwatch-server --states` reads: sequences in one `.npz`, described by a `.toml`."""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import IO, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import invalid
from emberwatch.model import Color, color_from_hex

Fill = Callable[[IO[bytes]], object]
"""Writes a file's bytes."""


class State(NamedTuple):
    """A state as the description has it."""

    name: str
    color: str
    reward: float


STATES: Final = (
    State("unburnt", "#3b6ea5", 0.0),
    State("burning", "#c8371b", 1.0),
    State("burnt", "#4a4a4a", 0.0),
)
COLORS: Final[tuple[Color, ...]] = tuple(color_from_hex(state.color) for state in STATES)
# As in the wildfire model: the sensor errs in 2 % of the cells, either way alike.
_RIGHT, _WRONG = 0.98, 0.01


def description(name: str, step: str, begins: Sequence[datetime | None] = ()) -> str:
    """The text of the `.toml`; `begins`: when step 0 of each sequence is, where that is known."""
    lines = [f"name = {quoted(name)}", f"step = {quoted(step)} # that one step lasts"]
    for array, begin in zip(_arrays(len(begins)), begins, strict=True):
        if begin is not None:
            lines.append(f"# {array} begins at {begin:%Y-%m-%d %H:%M:%S} UTC")
    for state in STATES:
        row = ", ".join(str(_RIGHT if other is state else _WRONG) for other in STATES)
        lines += ["", "[[states]]", f'name = "{state.name}"', f'color = "{state.color}"']
        lines += [f"observed_as = [{row}]", f"reward = {state.reward}"]
    for state in STATES:
        lines += ["", "[[observations]]", f'name = "{state.name}"', f'color = "{state.color}"']
    return "\n".join(lines) + "\n"


def _arrays(n: int) -> list[str]:
    """Names of so many arrays, whose order as texts, the server's, is their own."""
    digits = max(3, len(str(n - 1)))
    return [f"states_{number:0{digits}}" for number in range(n)]


def quoted(text: str) -> str:
    """The text as TOML has it."""
    # TOML has JSON's escapes, but neither surrogates nor a bare U+007F.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def check_outputs(out: Path, picture: Path | None, *, force: bool) -> None:
    """Refuses names of other files, and without `force` files that are there already."""
    if out.suffix != ".npz":
        raise invalid("--out", "a .npz", out)
    if picture is not None and picture.suffix != ".png":
        raise invalid("--picture", "a .png", picture)
    for flag, file in (("out", out), ("out", out.with_suffix(".toml")), ("picture", picture)):
        if file is not None:
            check_new(f"--{flag}", file, force=force)


def check_new(flag: str, file: Path, *, force: bool) -> None:
    """Refuses a folder, and without `force` a file that is there already."""
    if file.is_dir():
        raise invalid(flag, "a file", f"the folder {file}")
    if file.exists() and not force:
        raise invalid(flag, f"no {file}", "one; --force replaces it")


def arrays(sequences: Sequence[NDArray[np.uint8]]) -> Fill:
    """What writes the `.npz`."""
    named = dict(zip(_arrays(len(sequences)), sequences, strict=True))
    return lambda file: np.savez_compressed(file, **named)  # pyright: ignore


def write(files: Mapping[Path, Fill]) -> None:
    """Writes each file beside itself, and puts them in place when all are whole."""
    with ExitStack() as stack:
        renames = list[tuple[Path, Path]]()
        for path, fill in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            beside = path.with_name(f".{path.name}.{os.getpid()}")
            stack.callback(beside.unlink, missing_ok=True)
            with beside.open("wb") as file:
                fill(file)
            renames.append((beside, path))
        for beside, path in renames:
            os.replace(beside, path)
