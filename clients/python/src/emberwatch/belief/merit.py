"""Figures of merit of runs in several worlds, defined in `docs/figures-of-merit.md`.

The figures need no model, only the index of the target state. Two figures also need the hidden
states.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import emberwatch._native as _native


@dataclass(frozen=True, slots=True)
class Merit:
    """The figures of one run. A figure is None if there was nothing to measure."""

    #: Number of steps until a robot first visited a burning cell.
    steps_to_detection: int | None
    #: Number of the world's burning cells in the step of that first visit.
    burning_cells_at_detection: int | None
    #: Share of the burning cells that count as seen, because a robot visited them in the last 10
    #: steps. Mean over the steps in which cells burn.
    burning_seen_share: float | None
    #: Smallest number of moves from a robot to a burning cell that does not count as seen. Mean
    #: over the steps that have such a cell.
    front_distance: float | None
    #: Share of all cells that a robot visited at any time.
    grid_seen_share: float


class MeritTally:
    """Running figures of merit of several worlds that step together."""

    def __init__(self, n_worlds: int, shape: tuple[int, int], *, target: int) -> None:
        """Starts without steps. `target` is the burning state."""
        self._tally = _native.MeritTally(n_worlds, *shape, target)

    def update(
        self,
        visited: NDArray[np.bool_],
        robots: NDArray[np.int64],
        *,
        n_hits: NDArray[np.integer],
        n_burning: NDArray[np.integer],
        states: NDArray[np.uint8] | None = None,
    ) -> None:
        """Adds one step of all worlds.

        Args:
            visited: Cells that a robot visited, shape (n_worlds, H, W).
            robots: Row and column of each robot after the step, shape (n_worlds, R, 2).
            n_hits: Number of distinct burning cells that the robots of each world visited.
            n_burning: Number of burning cells of each world.
            states: The hidden states after the step, shape (n_worlds, H, W); None: unknown.
        """
        counts = n_hits.astype(np.uint32), n_burning.astype(np.uint32)
        self._tally.update(visited, robots, *counts, states)

    def merit(self, world: int) -> Merit:
        """Returns the figures of one world's steps so far."""
        return Merit(*self._tally.merit(world))
