"""Evaluations for the tests of `emberwatch.benchmark`."""

from pathlib import Path
from typing import Any

import numpy as np
from environments import LIVELY

from emberwatch.benchmark import Row, evaluate
from emberwatch.model import Model

#: Keywords of small worlds.
WORLDS: dict[str, Any] = {"height": 7, "width": 9, "n_moves": 4, "model": LIVELY, "burn_in": 60}


def play(policy: Any, name: str = "mine", **changes: Any) -> list[Row]:
    """Evaluates a policy in three small worlds."""
    keywords = {**WORLDS, "observation": "frame", "seeds": range(3, 6), "steps": 5, **changes}
    return evaluate(policy, name=name, **{"progress": None} | keywords)


def wall(folder: Path) -> Path:
    """Returns a model whose no-fly cells form a wall with one gap, so that masks matter."""
    closed = np.zeros((7, 9), int)
    closed[:, 4], closed[3, 4] = 1, 0
    path = folder / "wall.toml"
    path.write_text(f"no_fly = {closed.tolist()}\n" + Model.named(LIVELY).toml)
    return path
