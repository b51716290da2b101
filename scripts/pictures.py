"""Draws the pictures on the environments' pages, docs/environments/*.png.

The package and Pillow must be installed.

The picture for Wildfire is the one that the example on its page draws.
"""

from __future__ import annotations

import contextlib
import re
import tempfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from PIL import Image

import emberwatch
from emberwatch.planning import beam_search

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "environments"
SMALL = {"model": "wildfire-small", "height": 32, "width": 32, "n_moves": 16, "burn_in": 3000}
SHOWN: dict[str, Any] = {"truth": True, "render_mode": "rgb_array"}


def save(name: str, picture: Any) -> None:
    """Saves a picture with a reduced palette."""
    Image.fromarray(picture).quantize(64).save(FOLDER / f"{name}.png", optimize=True)


def wildfire() -> None:
    """Draws the picture of the example in docs/environments/wildfire.md."""
    page = (FOLDER / "wildfire.md").read_text("utf-8")
    code = re.search(r"```python\n(.*?)```", page, re.DOTALL)
    assert code is not None
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        exec(code[1], {})
        save("wildfire", np.asarray(Image.open("wildfire.png").convert("RGB")))


def moves() -> None:
    """Draws a robot's last path, and a part of its next path."""
    parts = ("belief", "robot")
    env = gymnasium.make("emberwatch/WildfireMoves-v0", observation=parts, **SMALL, **SHOWN)
    seen, _ = env.reset(seed=1000)
    for k in range(30):
        path = beam_search(
            seen["belief"][None, :, :, 2], seen["robot"][None], 16, rng=env.np_random
        )
        for move in path[0] if k < 29 else path[0][:10]:
            seen = env.step(move)[0]
    save("moves", env.render())
    env.close()


def objective() -> None:
    """Draws a path that the agent planned to find fire."""
    env = gymnasium.make("emberwatch/WildfireObjective-v1", **SMALL, **SHOWN)
    env.reset(seed=1000)
    for _ in range(30):
        env.step(0)
    save("objective", env.render())
    env.close()


def team() -> None:
    """Draws four robots. Each robot plans with its own belief."""
    env = emberwatch.parallel_env(
        robots=4, action="path", observation=("belief", "robot"), start="random", **SMALL, **SHOWN
    )
    seen, _ = env.reset(seed=1000)
    rng = np.random.default_rng(0)
    for _ in range(30):
        fire = np.stack([seen[agent]["belief"][:, :, 2] for agent in env.agents])
        robots = np.stack([seen[agent]["robot"] for agent in env.agents])
        paths = beam_search(fire, robots, 16, rng=rng)
        seen = env.step(dict(zip(env.agents, paths, strict=True)))[0]
    save("team", env.render())
    env.close()


if __name__ == "__main__":
    for draw in (wildfire, moves, objective, team):
        draw()
