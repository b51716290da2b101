"""Writer of recorded worlds for `emberwatch-server --states`: a `.npz` and its `.toml`."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.common.paths import utf8
from emberwatch.errors import InvalidArgumentError, invalid

#: The states: name, colour and reward.
_STATES: Final = (
    ("unburnt", "#3b6ea5", 0.0),
    ("burning", "#c8371b", 1.0),
    ("burnt", "#4a4a4a", 0.0),
)
# As in the wildfire model, the sensor errs in 2 % of the cells, equally often with each error.
_RIGHT, _WRONG = 0.98, 0.01


def write(
    out: Path, sequences: Sequence[NDArray[np.uint8]], step: str, begins: Sequence[str | None]
) -> None:
    """Writes the `.npz` and its `.toml`; `begins`: dates of step 0 of the sequences, if known."""
    digits = max(3, len(str(len(sequences) - 1)))  # sorting the names as text keeps their order
    names = [f"states_{number:0{digits}}" for number in range(len(sequences))]
    text = description(utf8("--out", out.stem), step, dict(zip(names, begins, strict=True)))
    out.parent.mkdir(parents=True, exist_ok=True)
    arrays = dict(zip(names, sequences, strict=True))
    np.savez_compressed(out, **arrays)  # pyright: ignore
    out.with_suffix(".toml").write_text(text, "utf-8")


def description(name: str, step: str, begins: dict[str, str | None]) -> str:
    """Returns the text of the `.toml`."""
    lines = [f"name = {quoted(name)}", f"step = {quoted(step)} # duration of a step"]
    lines += [f"# {array} begins at {begin}" for array, begin in begins.items() if begin]
    for state, color, reward in _STATES:
        row = ", ".join(str(_RIGHT if other == state else _WRONG) for other, _, _ in _STATES)
        lines += ["", "[[states]]", f'name = "{state}"', f'color = "{color}"']
        lines += [f"observed_as = [{row}]", f"reward = {reward}"]
    for state, color, _ in _STATES:
        lines += ["", "[[observations]]", f'name = "{state}"', f'color = "{color}"']
    return "\n".join(lines) + "\n"


def quoted(text: str) -> str:
    """Returns the text as a TOML string."""
    # TOML strings are JSON strings, except for surrogates and U+007F, which must be escaped.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def check_new(ending: str, out: Path, *others: Path, force: bool) -> None:
    """Refuses an output with another ending and, without `force`, files that exist already."""
    if out.suffix != ending:
        raise invalid("--out", f"a {ending} file", out)
    for file in (out, *others):
        if file.exists() and not force:
            raise InvalidArgumentError(f"--out: {file} exists already; --force replaces it")
