"""Sums of an evaluation over the steps of several worlds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.belief.merit import MeritTally
from emberwatch.benchmark.rows import Row
from emberwatch.envs.observations import cells_of
from emberwatch.envs.settings import WorldSpec
from emberwatch.model.moves import fly


class Tally:
    """Sums of results over the steps of several worlds, one entry for each world."""

    def __init__(self, spec: WorldSpec, n_worlds: int) -> None:
        self._spec: Final = spec
        target = 0 if spec.described is None else spec.described.target_state
        grid = spec.height, spec.width
        self._merit = MeritTally(n_worlds, grid, target=target)
        self._reward = np.zeros(n_worlds)
        counts = np.zeros((4, n_worlds), np.int64)
        self._n_visited, self._n_visits, self._n_hits, self._n_fire = counts
        #: Seconds that the policy took for all actions.
        self.seconds = 0.0

    def add(
        self,
        results: NDArray[np.void],
        paths: NDArray[np.integer],
        truths: NDArray[np.uint8] | None,
    ) -> None:
        """Adds a step of all robots; `truths`: hidden states of their worlds, if known."""
        n_robots, robots = self._spec.n_robots, results["robot"]
        worlds = results["world"][::n_robots]
        self._reward += worlds["reward"]
        self._n_visited += worlds["n_visited"]
        self._n_visits += robots["n_visited"].reshape(-1, n_robots).sum(1, np.int64)
        self._n_hits += worlds["n_hits"]
        self._n_fire += worlds["n_target_cells"]
        visited = np.zeros((len(worlds), self._spec.height, self._spec.width), np.bool_)
        cells = fly(np.stack((robots["start_row"], robots["start_col"]), 1), paths, self._spec)
        rows = np.arange(len(robots))[:, np.newaxis]
        visited[rows // n_robots, cells[..., 0], cells[..., 1]] = True
        self._merit.update(
            visited,
            cells_of(robots).reshape(-1, n_robots, 2),
            n_hits=worlds["n_hits"],
            n_burning=worlds["n_target_cells"],
            states=None if truths is None or not self._spec.described else truths[::n_robots],
        )

    def rows(self, seeds: Sequence[int], columns: dict[str, Any]) -> list[Row]:
        """Returns the row of each world; `columns`: values that are equal in all rows."""
        steps, visited = columns["steps"], self._n_visited.tolist()
        return [
            Row(
                **columns,
                world_seed=seed,
                mean_reward=float(self._reward[index]) / steps,
                mean_distinct_cells=visited[index] / steps,
                hit_rate=int(self._n_hits[index]) / max(visited[index], 1),
                mean_fire_cells=int(self._n_fire[index]) / steps,
                mean_plan_millis=1e3 * self.seconds / steps / len(seeds),
                brier="",
                moves=self._spec.n_moves,
                mean_repeated=1.0 - visited[index] / int(self._n_visits[index]),
                **asdict(self._merit.merit(index)),
            )
            for index, seed in enumerate(seeds)
        ]
