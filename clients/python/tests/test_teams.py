"""Several robots of one world through the plain client: leases, paths, team frames."""

from pathlib import Path
from typing import Any

import numpy as np
from environments import SMALL, WILDFIRE

import emberwatch.benchmark
from emberwatch.benchmark import evaluate


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
