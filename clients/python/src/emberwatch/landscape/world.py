"""Writer of recorded worlds for `emberwatch-server --states`: a `.npz` and its `.toml`."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.common.paths import utf8
from emberwatch.errors import InvalidArgumentError, invalid

# As in the wildfire model, the sensor errs in 2 % of the cells, equally often with each error.
_STATES: Final = """
states = [
    { name = "unburnt", color = "#3b6ea5", observed_as = [0.98, 0.01, 0.01], reward = 0.0 },
    { name = "burning", color = "#c8371b", observed_as = [0.01, 0.98, 0.01], reward = 1.0 },
    { name = "burnt", color = "#4a4a4a", observed_as = [0.01, 0.01, 0.98], reward = 0.0 },
]
observations = [
    { name = "unburnt", color = "#3b6ea5" },
    { name = "burning", color = "#c8371b" },
    { name = "burnt", color = "#4a4a4a" },
]
"""


def write(
    out: Path, sequences: Sequence[NDArray[np.uint8]], step: str, begins: Sequence[str | None]
) -> None:
    """Writes the `.npz` and its `.toml`; `begins`: dates of step 0 of the sequences, if known."""
    digits = max(3, len(str(len(sequences) - 1)))  # sorting the names as text keeps their order
    names = [f"states_{number:0{digits}}" for number in range(len(sequences))]
    known = zip(names, begins, strict=True)
    lines = [f"name = {quoted(utf8('--out', out.stem))}"]
    lines += [f"step = {quoted(step)} # duration of a step"]
    lines += [f"# {array} begins at {begin}" for array, begin in known if begin]
    out.parent.mkdir(parents=True, exist_ok=True)
    arrays = dict(zip(names, sequences, strict=True))
    np.savez_compressed(out, **arrays)  # pyright: ignore
    out.with_suffix(".toml").write_text("\n".join(lines) + "\n" + _STATES, "utf-8")


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
