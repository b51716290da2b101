"""`emberwatch.benchmark`, compared with `emberwatch-agent compare`."""

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from environments import LIVELY, MOVES, RECORDED, WILDFIRE
from failures import refuses
from numpy.typing import NDArray
from processes import find, server

import emberwatch
from emberwatch.benchmark import Row, evaluate, read, summary
from emberwatch.client import recording

WORLDS: dict[str, Any] = {"height": 7, "width": 9, "n_moves": 6, "model": LIVELY, "burn_in": 60}
SCALE: dict[str, Any] = {"seeds": range(3, 7), "steps": 12, "progress": None}
PLAIN = "world_seed steps mean_reward mean_distinct_cells hit_rate mean_fire_cells moves".split()
MERIT = (
    "steps_to_detection burning_cells_at_detection recent_steps burning_seen_share front_distance "
    "grid_seen_share"
).split()


def walk(seed: int) -> Callable[[Any], NDArray[np.int64]]:
    rng = np.random.default_rng(seed)
    return lambda frames: rng.integers(0, 4, len(frames))


def compare(
    *flags: object, seeds: str = "3..7", steps: int = 12
) -> subprocess.CompletedProcess[str]:
    command = [find("emberwatch-agent"), "compare", f"--seeds={seeds}", f"--steps={steps}"]
    command += [str(flag) for flag in flags]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def private(**changes: object) -> list[str]:
    flags = {"height": 7, "width": 9, "moves": 6, "model": LIVELY, "burn-in": 60, **changes}
    return [f"--{name}={value}" for name, value in flags.items()]


def score(path: Path | None = None, name: str = "mine", **changes: Any) -> list[Row]:
    keywords = {**WORLDS, **SCALE, "observation": "frame", **changes}
    return evaluate(walk(0), name=name, csv=path, **keywords)


@pytest.fixture
def states(tmp_path: Path) -> Path:
    """Writes recorded worlds of 12 and 15 steps, in which the second of three states pays most."""
    path = tmp_path / "lab.npz"
    random = np.random.default_rng(5)
    sequences = [random.integers(0, 3, (length, 7, 9), np.uint8) for length in (13, 16)]
    np.savez(path, states_000=sequences[0], states_001=sequences[1])
    path.with_suffix(".toml").write_bytes(RECORDED.read_bytes())
    return path


@pytest.mark.parametrize(
    ("robots", "recent_steps", "policy"), [(3, 2, "beam_exploit"), (1, 3, "coverage")]
)
def test_replayed_paths_have_exactly_the_same_scores(
    tmp_path: Path, states: Path, robots: int, recent_steps: int, policy: str
) -> None:
    settings = {"height": 7, "width": 9, "moves": 6, "model": LIVELY, "burn_in": 60}
    worlds = WORLDS
    if policy == "coverage":  # needs no model, as recorded worlds have none
        settings = {"height": None, "width": None, "moves": 6, "burn_in": None}
        settings |= {"states": states, "states_symmetries": True}
        worlds = {"n_moves": 6, "states": states, "states_symmetries": True}
    settings["robots"] = robots
    running = server(worlds=5, publish_truth=True, coverage="client", **settings)
    file = tmp_path / "beam.recording"
    recorder = subprocess.Popen(
        [find("emberwatch-server"), "record", f"--instance={running.instance}", f"--out={file}"]
    )
    try:
        with emberwatch.connect(running.instance) as client:
            while not client.status().n_observers:
                pass
        csv = tmp_path / "theirs.csv"
        flags = [f"--instance={running.instance}", f"--csv={csv}", "--team=joint"]
        flags += [f"--recent-steps={recent_steps}"]
        done = compare(f"--policies={policy}", *flags)
        assert done.returncode == 0, done.stderr
    finally:
        recorder.terminate()
        recorder.wait(20)
    samples = (record.sample for record in recording.read(file))
    frames = [sample for sample in samples if isinstance(sample, emberwatch.Frame)]
    paths = {
        (frame.result.seed, frame.result.step): [robot.path for robot in frame.robots]
        for frame in frames
    }
    steps = iter(range(1, 13))

    def again(_: Any) -> NDArray[np.int64]:
        step = next(steps)
        return np.concatenate([paths[seed, step] for seed in range(3, 7)]).astype(np.int64)

    keywords = {**worlds, **SCALE, "robots": robots, "recent_steps": recent_steps}
    rows = evaluate(again, name="again", env=WILDFIRE, **keywords)
    theirs = read(csv)
    assert len(rows) == len(theirs) == 4
    for mine, other in zip(rows, theirs, strict=True):
        for value in (*PLAIN, *MERIT):
            assert getattr(mine, value) == getattr(other, value), value
        assert None not in [getattr(mine, value) for value in MERIT]


def test_rows_join_the_ladder_of_policies(tmp_path: Path) -> None:
    file, figures = tmp_path / "mine.csv", tmp_path / "figures"
    score(file)
    score(file, name="other", append=True)
    flags = ["--policies=random_walk,coverage", "--baseline=coverage", f"--add={file}"]
    done = compare(*flags, f"--figures={figures}", f"--csv={tmp_path / 'all.csv'}", *private())
    assert done.returncode == 0, done.stderr
    assert "| mine " in done.stdout and "| other " in done.stdout
    assert "\nmine" in (figures / "ladder.svg").read_text()
    names = {row.policy for row in read(tmp_path / "all.csv")}
    assert names == {"random_walk", "coverage", "mine", "other"}


def test_a_row_names_the_estimator_of_the_belief() -> None:
    for changes, expected in (
        ({"observation": "frame"}, "none"),
        ({"observation": "local"}, "known_model"),
        ({"observation": ["frame", "belief"]}, "known_model"),
        ({"observation": "local", "estimator": "mine"}, "mine"),
    ):
        keywords = {**WORLDS, **SCALE, "seeds": [3], "steps": 1, **changes}
        (row,) = evaluate(lambda _: np.zeros(1, int), name="mine", **keywords)
        assert row.estimator == expected


def test_a_summary_counts_the_test_worlds() -> None:
    rows = score(seeds=[3, 5000], steps=2)
    assert summary(rows).endswith("a step on 2 (1 test) worlds")
    assert summary(rows[:1]).endswith(" a step on 1 test world, too few for a standard error")
    assert summary(rows[1:]).endswith(" a step on 1 world, too few for a standard error")
    with refuses("rows: expected at least one, got none"):
        summary([])


def rows_of(policy: str, *rewards: float, first: int = 1000, **changes: Any) -> list[Row]:
    values: dict[str, Any] = {
        **{"policy": policy, "estimator": "none", "steps": 5, "moves": 4, "mean_plan_millis": 0.1},
        **{"mean_distinct_cells": 4.0, "hit_rate": 0.1, "mean_fire_cells": 9.0, "brier": ""},
        **{"worlds_fingerprint": "ab"},
    }
    return [
        Row(world_seed=seed, mean_reward=reward, **values | changes)
        for seed, reward in enumerate(rewards, first)
    ]


def test_a_summary_has_differences_from_a_baseline() -> None:
    base, better = rows_of("base", 1.0, 2.0, 4.0), rows_of("better", 2.0, 5.0, 9.0)
    # Differences 1, 3 and 5: mean 3, variance 4, error sqrt(4 / 3) = 1.155. Student's t with 2
    # degrees of freedom is 4.303 at 97.5 %, so the interval is 3 +- 4.97.
    assert summary([*better[::-1], *base], baseline="base").splitlines() == [
        "better: 5.33 +- 2.03 a step on 3 worlds; difference from base: +3.00 +- 1.15 [-1.97, "
        "+7.97]",
        "base: 2.33 +- 0.88 a step on 3 worlds",
    ]
    assert summary(base + better).splitlines()[1] == "better: 5.33 +- 2.03 a step on 3 worlds"
    # Differences 0.1, 0.3 and eight zeros: t with 9 degrees of freedom is 2.262.
    ten = rows_of("base", *[0.0] * 10) + rows_of("better", 0.1, 0.3, *[0.0] * 8)
    assert summary(ten, baseline="base").endswith("+0.04 +- 0.03 [-0.03, +0.11]")
    one = summary(base[:1] + better[:1], baseline="base").splitlines()[1]
    assert one.endswith("on 1 world, too few for a standard error; difference from base: +1.00")
    for rows, problem in (
        (better, "baseline: expected the name of one of the policies better, got 'base'"),
        (base + rows_of("base", 1.0, team="shared"), "baseline: expected the name of one of the"),
        (base + better[:2], "rows: expected one for each of the same worlds and steps of 'better'"),
        (base + better + better, "rows: expected one for each of the same worlds and steps of"),
        (base + rows_of("x", 1.0, 2.0, 4.0, first=1001), "rows: expected one for each of the same"),
        (base + rows_of("x", 1.0, 2.0, 4.0, steps=6), "rows: expected one for each of the same w"),
        (base + rows_of("x", 1.0, worlds_fingerprint="cd"), "in all rows, got 'ab', 'cd'"),
        (rows_of("base", 1.0, worlds_fingerprint=""), "worlds_fingerprint in all rows, got ''"),
    ):
        with refuses(problem):
            summary(rows, baseline="base")


#: Wrong arguments of `evaluate`, each with words of its error.
WRONG: list[tuple[dict[str, Any], str]] = [
    ({"name": ""}, "name: expected a name for the table, got ''"),
    ({"estimator": "a\nb"}, r"estimator: expected a name for the table, got 'a\\nb'"),
    *(({"seeds": it}, "seeds: expected at least one seed, without dup") for it in ([], [4, 4])),
    ({"seeds": 8}, r"seeds: expected several seeds, such as range\(8\), got 8"),
    ({"observation": None}, "observation: expected one or several of"),
    ({"seeds": [-1]}, "seed: expected an integer"),
    *(
        ({name: 0}, f"{name}: expected an integer within 1 to 4294967295, got 0")
        for name in ("steps", "batch", "recent_steps")
    ),
    ({"env": "CartPole-v1"}, f"env: expected '{MOVES}' or '{WILDFIRE}', got 'CartPole-v1'"),
]  # fmt: skip


def test_wrong_evaluation_arguments_are_named() -> None:
    for changes, problem in WRONG:
        with refuses(problem):
            score(**changes)
    with refuses("policy: expected a function"):
        evaluate(None, name="mine", **{**WORLDS, **SCALE})


def test_some_figures_need_no_hidden_states(tmp_path: Path) -> None:
    settings = {"height": 7, "width": 9, "moves": 6, "model": LIVELY, "burn_in": 60}
    whole, of_truth = score(), ("burning_seen_share", "front_distance")
    for flags in ({}, {"publish_truth": True, "reveal_model": False}):
        running = server(worlds=4, **settings, **flags)
        keywords = {**SCALE, "burn_in": 60, "instance": running.instance, "observation": "frame"}
        csv = tmp_path / f"{len(flags)}.csv"
        rows = evaluate(walk(0), name="mine", csv=csv, **keywords)
        for row, other in zip(rows, whole, strict=True):
            assert [getattr(row, value) for value in of_truth] == [None, None]
            for value in {*MERIT, "worlds_fingerprint"} - {*of_truth}:
                assert getattr(row, value) == getattr(other, value), value
        assert read(csv) == rows


def test_worlds_that_do_not_fit_an_evaluation_are_refused(states: Path) -> None:
    keywords = {**SCALE, "n_moves": 6, "states": states, "observation": "frame", "seeds": [0, 1]}
    with refuses("steps: expected at most 12, .*, got 13"):
        evaluate(walk(0), name="mine", **(keywords | {"steps": 13}))
    running = server(worlds=1, robots=4, height=7, width=9, moves=6, model=LIVELY, burn_in=60)
    keywords = {**SCALE, "burn_in": 60, "instance": running.instance, "observation": "frame"}
    with refuses("robots: expected the server.s 4"):
        evaluate(walk(0), name="mine", **keywords)
