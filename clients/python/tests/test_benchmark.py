"""`emberwatch.benchmark`, compared with `emberwatch-agent compare`."""

import subprocess
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import WORLDS, play
from environments import LIVELY, MOVES, RECORDED, WILDFIRE
from failures import refuses
from numpy.typing import NDArray
from processes import find, server

import emberwatch
from emberwatch.benchmark import FIRST_TRAINING_SEED, Row, evaluate, read, summary
from emberwatch.client import recording

FLAGS: dict[str, Any] = {"height": 7, "width": 9, "moves": 4, "model": LIVELY, "burn_in": 60}
SCALE: dict[str, Any] = {"seeds": range(3, 7), "steps": 12, "progress": None}


def walk() -> Callable[[Any], NDArray[np.int64]]:
    rng = np.random.default_rng(0)
    return lambda seen: rng.integers(0, 4, len(seen))


def figures(row: Row, *others: str) -> dict[str, Any]:
    """Returns the columns that do not depend on the program, except some others."""
    others += ("policy", "estimator", "team", "brier", "log_likelihood")
    others += ("mean_plan_millis", "training_seconds")
    return {name: value for name, value in asdict(row).items() if name not in others}


def compare(*flags: object) -> str:
    """Runs the agent's `compare` on the worlds of `SCALE`; returns its output."""
    command = [find("emberwatch-agent"), "compare", "--seeds=3..7", "--steps=12", *map(str, flags)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def score(name: str = "mine", **changes: Any) -> list[Row]:
    return play(changes.pop("policy", walk()), name, **SCALE | changes)


@pytest.fixture
def states(tmp_path: Path) -> Path:
    """Writes a recorded world of 12 steps, in which the second of three states pays most."""
    path = tmp_path / "lab.npz"
    np.savez(path, states_000=np.random.default_rng(5).integers(0, 3, (13, 7, 9), np.uint8))
    path.with_suffix(".toml").write_bytes(RECORDED.read_bytes())
    return path


@pytest.mark.parametrize(("robots", "policy"), [(3, "known/beam/exploit"), (1, "coverage")])
def test_replayed_paths_have_exactly_the_same_scores(
    tmp_path: Path, states: Path, robots: int, policy: str
) -> None:
    settings, worlds = FLAGS, WORLDS
    if policy == "coverage":  # needs no model, as recorded worlds have none
        worlds = {"n_moves": 4, "states": states, "states_symmetries": True}
        settings = {"moves": 4, "states": states, "states_symmetries": True}
        settings |= dict.fromkeys(("height", "width", "burn_in"))
    running = server(worlds=5, publish_truth=True, coverage="client", robots=robots, **settings)
    file, csv = tmp_path / "beam.recording", tmp_path / "theirs.csv"
    recorder = subprocess.Popen(
        [find("emberwatch-server"), "record", f"--instance={running.instance}", f"--out={file}"]
    )
    try:
        with emberwatch.connect(running.instance) as client:
            while not client.status().n_observers:
                pass
        flags = [f"--instance={running.instance}", f"--csv={csv}", "--team=joint"]
        compare(f"--policies={policy}", *flags)
    finally:
        recorder.terminate()
        recorder.wait(20)
    frames = [it.sample for it in recording.read(file) if isinstance(it.sample, emberwatch.Frame)]
    paths = {(it.result.seed, it.result.step): [one.path for one in it.robots] for it in frames}
    steps = iter(range(1, 13))

    def again(_: Any) -> NDArray[np.int64]:
        step = next(steps)
        return np.concatenate([paths[seed, step] for seed in range(3, 7)]).astype(np.int64)

    keywords = {**worlds, **SCALE, "robots": robots}
    rows = [figures(row) for row in evaluate(again, name="again", env=WILDFIRE, **keywords)]
    assert rows == [figures(row) for row in read(csv)]
    assert len(rows) == 4 and None not in [value for row in rows for value in row.values()]


def test_rows_join_the_ladder_of_policies(tmp_path: Path) -> None:
    figures, flags = tmp_path / "figures", ["--policies=random_walk,coverage"]
    for name in ("mine", "other"):
        score(name, csv=tmp_path / f"{name}.csv")
        flags.append(f"--add={tmp_path / name}.csv")
    flags.append("--baseline=coverage")
    flags += [f"--{name.replace('_', '-')}={value}" for name, value in FLAGS.items()]
    shown = compare(*flags, f"--figures={figures}", f"--csv={tmp_path / 'all.csv'}")
    assert "| mine " in shown and "| other " in shown
    assert "\nmine" in (figures / "ladder.svg").read_text()
    names = {row.policy for row in read(tmp_path / "all.csv")}
    assert names == {"random_walk", "coverage", "mine", "other"}


def test_a_row_names_the_estimator_of_the_belief() -> None:
    of_kind = {"kind": "known+spatial"}, "known+spatial"
    for changes, expected in (({}, "known"), of_kind, ({"estimator": "mine"}, "mine")):
        assert {row.estimator for row in score(observation="local", **changes)} == {expected}
    assert {row.estimator for row in score()} == {"none"}


def rows_of(policy: str, *rewards: float, first: int = 1000, **changes: Any) -> list[Row]:
    values: dict[str, Any] = {"policy": policy, "estimator": "none", "steps": 5, "moves": 4}
    values |= {"mean_distinct_cells": 4.0, "hit_rate": 0.1, "mean_fire_cells": 9.0, "brier": ""}
    values |= {"mean_plan_millis": 0.1, "worlds_fingerprint": "ab", **changes}
    return [Row(world_seed=at, mean_reward=it, **values) for at, it in enumerate(rewards, first)]


def test_a_summary_has_differences_from_a_baseline() -> None:
    base, better = rows_of("base", 1.0, 2.0, 4.0), rows_of("better", 2.0, 5.0, 9.0)
    # Differences 1, 3 and 5: mean 3, variance 4, error sqrt(4 / 3) = 1.155.
    assert summary([*better[::-1], *base], baseline="base").splitlines() == [
        "better: 5.33 +- 2.03 a step on 3 worlds; difference from base: +3.00 +- 1.15",
        "base: 2.33 +- 0.88 a step on 3 worlds",
    ]
    assert summary(base + better).splitlines()[1] == "better: 5.33 +- 2.03 a step on 3 worlds"
    tests = rows_of("base", 1.0, 2.0, first=FIRST_TRAINING_SEED - 1)
    assert summary(tests).endswith("a step on 2 (1 test) worlds")
    assert summary(tests[:1]) == "base: 1.00 a step on 1 test world"
    with refuses("rows: expected at least one, got none"):
        summary([])
    one = summary(base[:1] + better[:1], baseline="base").splitlines()[1]
    assert one.endswith("on 1 world; difference from base: +1.00")


def test_rows_that_do_not_pair_are_refused() -> None:
    base = rows_of("base", 1.0, 2.0)
    for rows in (rows_of("x", 1.0), base + rows_of("base", 1.0, team="shared")):
        with refuses("baseline: expected the name of one of the policies .*, got 'base'"):
            summary(rows, baseline="base")
    unknown = {"worlds_fingerprint": ""}
    for rows in (
        base + rows_of("x", 1.0),
        base + 2 * rows_of("x", 1.0, 2.0),
        base + rows_of("x", 1.0, 2.0, first=1001),
        base + rows_of("x", 1.0, 2.0, steps=6),
        base + rows_of("x", 1.0, 2.0, worlds_fingerprint="cd"),
        rows_of("base", 1.0, **unknown) + rows_of("x", 1.0, **unknown),
    ):
        with refuses("rows: expected the same worlds_fingerprint, seeds and steps of 'x' and 'bas"):
            summary(rows, baseline="base")


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"policy": None}, "policy: expected a function of observations, or a model of .*, got No"),
        ({"seeds": []}, "seeds: expected at least one seed, without duplicates"),
        ({"seeds": [4, 4]}, "seeds: expected at least one seed, without duplicates"),
        ({"seeds": 8}, "seeds: expected one for each world, got int"),
        ({"batch": 0}, "batch: expected an integer within 1 to 4294967295, got 0"),
        ({"env": "CartPole-v1"}, f"env: expected '{MOVES}' or '{WILDFIRE}', got 'CartPole-v1'"),
    ],
)
def test_wrong_evaluation_arguments_are_named(changes: dict[str, Any], problem: str) -> None:
    with refuses(problem):
        score(**changes)


@pytest.mark.parametrize("flags", [{}, {"publish_truth": True, "reveal_model": False}], ids=str)
def test_some_figures_need_no_hidden_states(flags: dict[str, Any], tmp_path: Path) -> None:
    running = server(worlds=4, **FLAGS, **flags)
    keywords = {**SCALE, "burn_in": 60, "instance": running.instance, "observation": "frame"}
    rows = evaluate(walk(), name="mine", csv=tmp_path / "mine.csv", **keywords)
    of_truth = ("burning_seen_share", "front_distance")
    assert {getattr(row, name) for row in rows for name in of_truth} == {None}
    assert [figures(it, *of_truth) for it in rows] == [figures(it, *of_truth) for it in score()]
    assert read(tmp_path / "mine.csv") == rows


def test_episodes_that_are_too_short_are_refused(states: Path) -> None:
    with refuses("steps: expected at most 12, .*, got 13"):
        evaluate(walk(), name="mine", n_moves=4, states=states, observation="frame", steps=13)
