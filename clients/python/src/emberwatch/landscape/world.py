"""Writer of recorded worlds for `emberwatch-server --states`: a `.npz` and its `.toml`."""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.model import Color, color_from_hex

Fill = Callable[[IO[bytes]], object]
"""A function that writes the bytes of a file."""


class State(NamedTuple):
    """A state, as written to the description."""

    name: str
    color: str
    reward: float


STATES: Final = (
    State("unburnt", "#3b6ea5", 0.0),
    State("burning", "#c8371b", 1.0),
    State("burnt", "#4a4a4a", 0.0),
)
COLORS: Final[tuple[Color, ...]] = tuple(color_from_hex(state.color) for state in STATES)
# As in the wildfire model, the sensor errs in 2 % of the cells, equally often with each error.
_RIGHT, _WRONG = 0.98, 0.01


def description(name: str, step: str, begins: Sequence[str | None] = ()) -> str:
    """Returns the text of the `.toml`; `begins`: dates of step 0 of the sequences, if known."""
    lines = [f"name = {quoted(name)}", f"step = {quoted(step)} # duration of a step"]
    for array, begin in zip(_arrays(len(begins)), begins, strict=True):
        if begin is not None:
            lines.append(f"# {array} begins at {begin}")
    for state in STATES:
        row = ", ".join(str(_RIGHT if other is state else _WRONG) for other in STATES)
        lines += ["", "[[states]]", f'name = "{state.name}"', f'color = "{state.color}"']
        lines += [f"observed_as = [{row}]", f"reward = {state.reward}"]
    for state in STATES:
        lines += ["", "[[observations]]", f'name = "{state.name}"', f'color = "{state.color}"']
    return "\n".join(lines) + "\n"


def _arrays(n: int) -> list[str]:
    """Returns the names of `n` arrays, padded so that sorting them as text keeps their order."""
    digits = max(3, len(str(n - 1)))
    return [f"states_{number:0{digits}}" for number in range(n)]


def quoted(text: str) -> str:
    """Returns the text as a TOML string."""
    # TOML strings are JSON strings, except for surrogates and U+007F, which must be escaped.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def check_outputs(out: Path, picture: Path | None, *, force: bool) -> None:
    """Refuses names with wrong endings and, without `force`, files that exist already."""
    if out.suffix != ".npz":
        raise invalid("--out", "a .npz file", out)
    if picture is not None and picture.suffix != ".png":
        raise invalid("--picture", "a .png file", picture)
    for flag, file in (("out", out), ("out", out.with_suffix(".toml")), ("picture", picture)):
        if file is not None:
            check_new(f"--{flag}", file, force=force)


def check_new(flag: str, file: Path, *, force: bool) -> None:
    """Refuses a folder and, without `force`, a file that exists already."""
    if file.is_dir():
        raise invalid(flag, "a file", f"the folder {file}")
    if file.exists() and not force:
        raise InvalidArgumentError(f"{flag}: {file} exists already; --force replaces it")


def arrays(sequences: Sequence[NDArray[np.uint8]]) -> Fill:
    """Returns the function that writes the `.npz`."""
    named = dict(zip(_arrays(len(sequences)), sequences, strict=True))
    return lambda file: np.savez_compressed(file, **named)  # pyright: ignore


def write(files: Mapping[Path, Fill]) -> None:
    """Writes temporary files next to the outputs, and renames them when all are complete."""
    with ExitStack() as stack:
        renames = list[tuple[Path, Path]]()
        for path, fill in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = path.with_name(f".{path.name}.{os.getpid()}")
            stack.callback(temporary.unlink, missing_ok=True)
            with temporary.open("wb") as file:
                fill(file)
            renames.append((temporary, path))
        for temporary, path in renames:
            os.replace(temporary, path)
