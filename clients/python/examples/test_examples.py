"""Runs every example in short form. `scripts/test --all` installs their dependencies."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent

#: Each example, short arguments, and a pattern that its output must match.
EXAMPLES = [
    (
        "sb3_moves.py",
        "--total-steps 600 --worlds 4 --steps 5",
        r"sb3_ppo: \d\S* \+- \S+ a step on 8 worlds",
    ),
    (
        "sb3_moves.py",
        "--total-steps 400 --worlds 2 --robots 4 --reward marginal --steps 5",
        r"sb3_ppo: \d\S* \+- \S+ a step on 8 worlds",
    ),
    (
        "ppo.py",
        "--worlds 8 --imitate 3 --cpu-seconds 6 --steps 5",
        r"ppo: \d\S* \+- \S+ a step on 8 worlds",
    ),
    (
        "learned_belief.py",
        "--worlds 8 --cpu-seconds 6 --steps 5",
        r" s: reward \d\S+ loss \d(.*\n)+learned_belief: \d\S* \+- \S+ a step on 8 worlds",
    ),
    (
        "sb3_objective.py",
        "--model wildfire --moves 64 --worlds 4 --total-steps 500 --test-worlds 2 --test-steps 50",
        r"DQN .*\nrandom .*\nexploit +[1-9]",
    ),
    ("rllib_team.py", "--iterations 1 --batch 500", r"iteration 0: 500\S* moves, reward of .* \d"),
    (
        "ray_cluster.py",
        "--iterations 3 --runners 3 --batch 800 --kill",
        r"runner (\d+) is killed\n(?:.*\n)*server (\d+) is killed\n(?:.*\n)*"
        r"iteration (?!.*\b(?:\1|\2)\b)\d+: .*(?:, runners \[\d+(?:, \d+)?\] on server \d+){2}\n",
    ),
    ("mcts.py", "--seeds 1000..1002 --steps 3", r"mcts: \d\S* \+- \S+ a step on 2 worlds"),
    (
        "filter_benchmark.py",
        f"{FOLDER.parent}/tests/data/fires/fires-window.npz",
        r"\| known\+spatial\+cavities \| 0\.\d+ \| 0\.\d+ \| -0\.\d+ ±",
    ),
    ("swap.py", "--steps 50", r"Python takes over\n(.*\n)*.*code 3 .*\n.*second Rust agent flew"),
]


@pytest.mark.parametrize(("name", "arguments", "line"), EXAMPLES, ids=[e[0] for e in EXAMPLES])
def test_an_example_runs(name: str, arguments: str, line: str, tmp_path: Path) -> None:
    command = [sys.executable, str(FOLDER / name)]
    command += arguments.split()
    # Finds programs that pip installed next to Python. With "local", Ray starts its own cluster
    # instead of joining another example's.
    path = f"{os.environ['PATH']}:{Path(sys.executable).parent}"
    env = os.environ | {"PATH": path, "RAY_ADDRESS": "local"}
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=900, cwd=tmp_path, env=env
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert re.search(line, done.stdout), done.stdout
    assert "the state that pays most" not in done.stderr, "a world with nothing to find"


def test_every_example_is_run() -> None:
    files = {path.name for path in FOLDER.glob("*.py")} - {Path(__file__).name}
    assert files == {name for name, _, _ in EXAMPLES}


def test_the_readme_trains_and_scores_a_policy(tmp_path: Path) -> None:
    page = (FOLDER.parents[2] / "README.md").read_text("utf-8")
    code = re.search(r"```python\n(.*?)```", page, re.DOTALL)
    assert code is not None
    short = code[1].replace("100_000", "2_048").replace("steps=100", "steps=5")
    done = subprocess.run(
        [sys.executable, "-c", short], capture_output=True, text=True, timeout=900, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert re.search(r"ppo: \d\S* \+- \S+ a step on 32 test worlds", done.stdout), done.stdout
