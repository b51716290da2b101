"""Several robots of one world through the plain client: leases, paths, team frames."""

from pathlib import Path
from typing import Any

import numpy as np
from environments import SMALL, WILDFIRE
from processes import server

import emberwatch.benchmark
from emberwatch.benchmark import evaluate


def paths(n_robots: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 4, (n_robots, 6))


def test_robots_are_numbered_across_worlds() -> None:
    started = server(worlds=3, robots=2)
    client = started.connect()
    assert (client.info.n_worlds, client.info.n_robots) == (3, 2)
    lease = client.acquire(2, 3)
    assert (lease.robots, lease.worlds) == (range(2, 5), range(1, 3))
    assert [(info.world, info.robots) for info in lease.start] == [
        (1, ((0, 0), (4, 6))),
        (2, ((0, 0), (4, 6))),
    ]
    answer = lease.step(paths(3))
    assert answer.world_of.tolist() == [0, 0, 1]
    assert answer.worlds["hovered"].tolist() == [0, 0b10]
    holders = [world.holder_pids for world in started.status().worlds]
    us = holders[1][0]
    assert us is not None and holders == [(None, None), (us, us), (us, None)]


def test_team_frames_combine_the_robots_frames() -> None:
    lease = server(worlds=2, robots=3).connect().acquire(0, 6)
    answer = lease.step(paths(6))
    expected = answer.frames.reshape(2, 3, 5, 7).min(axis=1)
    assert (expected != 255).sum() > (answer.frames != 255).sum() / 6
    for team in (
        lease.observe(team=True),
        lease.client.observe(0, 6, team=True),
        lease.client.recall(1, 0, 6, team=True),
    ):
        assert (team.frames == expected).all() and (team.results == answer.results).all()
    seen = lease.client.observe(4, team=True)
    assert (seen.frames[0] == expected[1]).all() and len(seen.robots) == 1
    flown = lease.step(paths(6, seed=1), team=True)
    assert (flown.frames == lease.observe().frames.reshape(2, 3, 5, 7).min(axis=1)).all()


def test_a_team_is_evaluated_as_a_whole(tmp_path: Path) -> None:
    def fly(_: Any) -> np.ndarray:
        return np.tile(np.array([[1, 1, 1, 1], [1, 1, 3, 3]]), (len(_["robot"]) // 2, 1))

    keywords: Any = {**SMALL, "start": "centre", "env": WILDFIRE, "progress": None}
    keywords |= {"seeds": [1000, 1001], "steps": 5}
    rows = evaluate(fly, name="both", robots=2, csv=tmp_path / "team.csv", **keywords)
    assert [(row.robots, row.team) for row in rows] == [(2, "alone")] * 2
    shared = evaluate(fly, name="shared", robots=2, observation=("robot", "team"), **keywords)
    assert [row.team for row in shared] == ["shared"] * 2
    assert [row.mean_reward for row in shared] == [row.mean_reward for row in rows]
    # At first the robots share two cells, then visit two more each. Later they push against the
    # edge.
    assert all(0.0 < row.mean_repeated < 0.5 for row in rows)
    assert all(row.mean_distinct_cells < 8 for row in rows)
    assert emberwatch.benchmark.read(tmp_path / "team.csv") == rows
