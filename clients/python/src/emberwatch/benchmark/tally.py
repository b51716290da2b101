"""Sums of an evaluation over the steps of several worlds."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import emberwatch._native as _native
from emberwatch.benchmark.rows import Row
from emberwatch.envs.observations import cells_of
from emberwatch.envs.settings import WorldSpec
from emberwatch.model.moves import fly


class Tally:
    """Sums of results over the steps of several worlds, one entry for each world."""

    def __init__(self, spec: WorldSpec, n_worlds: int) -> None:
        self._spec: Final = spec
        target = 0 if spec.described is None else spec.described.target_state
        self._merit = _native.MeritTally(n_worlds, spec.height, spec.width, target)
        #: Rewards, distinct visited cells, visits, hits, and cells in the state that pays most.
        self._sums = np.zeros((5, n_worlds))
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
        n_visits = robots["n_visited"].reshape(-1, n_robots).sum(1)
        counts = (worlds[name] for name in ("n_hits", "n_target_cells"))
        self._sums += [worlds["reward"], worlds["n_visited"], n_visits, *counts]
        visited = np.zeros((len(worlds), self._spec.height, self._spec.width), np.bool_)
        cells = fly(np.stack((robots["start_row"], robots["start_col"]), 1), paths, self._spec)
        rows = np.arange(len(robots))[:, np.newaxis]
        visited[rows // n_robots, cells[..., 0], cells[..., 1]] = True
        self._merit.update(
            visited,
            cells_of(robots).reshape(-1, n_robots, 2),
            worlds["n_hits"].astype(np.uint32),
            worlds["n_target_cells"].astype(np.uint32),
            None if truths is None or not self._spec.described else truths[::n_robots],
        )

    def row(self, world: int, **columns: Any) -> Row:
        """Returns the row of a world; `columns`: values that do not depend on its steps."""
        steps = columns["steps"]
        reward, n_visited, n_visits, n_hits, n_fire = self._sums[:, world].tolist()
        detected, n_burning, seen, distance, grid_seen = self._merit.merit(world)
        return Row(
            **columns,
            mean_reward=reward / steps,
            mean_distinct_cells=n_visited / steps,
            hit_rate=n_hits / max(n_visited, 1),
            mean_fire_cells=n_fire / steps,
            mean_plan_millis=1e3 * self.seconds / steps / self._sums.shape[1],
            brier="",
            moves=self._spec.n_moves,
            mean_repeated=1.0 - n_visited / n_visits,
            steps_to_detection=detected,
            burning_cells_at_detection=n_burning,
            burning_seen_share=seen,
            front_distance=distance,
            grid_seen_share=grid_seen,
        )
