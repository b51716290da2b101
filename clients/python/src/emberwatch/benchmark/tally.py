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

    def __init__(self, spec: WorldSpec, n_worlds: int, recent_steps: int) -> None:
        self._spec: Final = spec
        self.n_moves: Final = spec.n_moves
        self.n_robots: Final = spec.n_robots
        self.recent_steps: Final = recent_steps
        self._shape = (n_worlds, spec.height, spec.width)
        described = spec.described
        self._knows_target = described is not None
        target = 0 if described is None else described.target_state
        self.merit: Final = MeritTally(
            n_worlds, self._shape[1:], target=target, recent_steps=recent_steps
        )
        self.reward = np.zeros(n_worlds)
        self.n_visited, self.n_visits, self.n_hits, self.n_fire = np.zeros((4, n_worlds), np.int64)
        #: Seconds that the policy took for all actions.
        self.seconds = 0.0

    def add(
        self,
        results: NDArray[np.void],
        paths: NDArray[np.integer],
        truths: NDArray[np.uint8] | None,
    ) -> None:
        """Adds a step of all robots; `truths`: hidden states of their worlds, if known."""
        worlds = results["world"][:: self.n_robots]
        self.reward += worlds["reward"]
        self.n_visited += worlds["n_visited"]
        self.n_visits += results["robot"]["n_visited"].reshape(-1, self.n_robots).sum(1, np.int64)
        self.n_hits += worlds["n_hits"]
        self.n_fire += worlds["n_target_cells"]
        self.merit.update(
            self._visited(results["robot"], paths),
            cells_of(results["robot"]).reshape(-1, self.n_robots, 2),
            n_hits=worlds["n_hits"],
            n_burning=worlds["n_target_cells"],
            states=None if truths is None or not self._knows_target else truths[:: self.n_robots],
        )

    def rows(self, seeds: Sequence[int], columns: dict[str, Any]) -> list[Row]:
        """Returns the row of each world; `columns`: values that are equal in all rows."""
        steps = columns["steps"]
        return [
            Row(
                **columns,
                world_seed=seed,
                mean_reward=float(self.reward[index]) / steps,
                mean_distinct_cells=int(self.n_visited[index]) / steps,
                hit_rate=int(self.n_hits[index]) / max(int(self.n_visited[index]), 1),
                mean_fire_cells=int(self.n_fire[index]) / steps,
                mean_plan_millis=1e3 * self.seconds / steps / len(seeds),
                brier="",
                moves=self.n_moves,
                mean_repeated=1.0 - int(self.n_visited[index]) / int(self.n_visits[index]),
                **asdict(self.merit.merit(index)),
            )
            for index, seed in enumerate(seeds)
        ]

    def _visited(self, robots: NDArray[np.void], paths: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Returns the mask of the cells that robots of each world visited, `(n_worlds, H, W)`."""
        visited = np.zeros(self._shape, np.bool_)
        worlds = np.arange(len(robots))[:, np.newaxis] // self.n_robots
        cells = fly(np.stack((robots["start_row"], robots["start_col"]), 1), paths, self._spec)
        visited[worlds, cells[..., 0], cells[..., 1]] = True
        return visited
