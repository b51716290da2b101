"""TOML files as editors on Windows save them: with a byte order mark, or in UTF-16."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import LIVELY, RECORDED, WILDFIRE, closed_later

import emberwatch
from emberwatch.model import Model
from emberwatch.model.tasks import Task

TASK = """name = "mine"
model = "wildfire-small"
height = 16
width = 16
moves = 8
burn_in = 10
max_steps = 2
test_seeds = { start = 0, end = 2 }
# é
"""


def of_states(file: Path) -> Any:
    np.savez(file.with_suffix(".npz"), fire=np.zeros((3, 4, 4), np.uint8))
    return closed_later(gymnasium.make(WILDFIRE, states=file.with_suffix(".npz"), n_moves=4))


#: A function that reads a file, and the file's text in UTF-8.
READERS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "task": (Task.named, TASK),
    "model": (Model.named, Path(LIVELY).read_text("utf-8")),
    "states": (of_states, RECORDED.read_text("utf-8")),
    "embedded worlds": (
        lambda file: emberwatch.embed(**{**SMALL_SETTINGS, "model": file}).close(),
        Path(LIVELY).read_text("utf-8"),
    ),
}

SMALL_SETTINGS: dict[str, Any] = {"height": 7, "width": 5, "moves": 4, "burn_in": 5}


@pytest.mark.parametrize("kind", READERS)
def test_a_byte_order_mark_is_skipped(kind: str, tmp_path: Path) -> None:
    read, text = READERS[kind]
    plain, marked = tmp_path / "plain.toml", tmp_path / "marked.toml"
    plain.write_text(text, "utf-8")
    marked.write_text(text.replace("\n", "\r\n"), "utf-8-sig")
    expected, got = read(plain), read(marked)
    if isinstance(expected, Task | Model):
        assert expected == got
    if isinstance(expected, Model):
        assert not got.toml.startswith("\ufeff")
