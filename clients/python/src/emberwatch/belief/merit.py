"""Figures of merit of runs in several worlds, which `docs/figures-of-merit.md` defines.

They need no model, only the number of the target state; two of them need the hidden states.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

import emberwatch._native as _native

#: Steps for which a cell counts as seen after a visit, unless told otherwise.
RECENT_STEPS: Final = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Merit:
    """The figures of one run; None where there was nothing to measure."""

    #: Steps until a robot first visited a burning cell.
    steps_to_detection: int | None
    #: Burning cells of the world in that step.
    burning_cells_at_detection: int | None
    #: Share of the burning cells that a robot visited in the last steps: mean over steps with fire.
    burning_seen_share: float | None
    #: Moves from the nearest robot to the nearest burning cell that is not among these: mean over
    #: steps that have one.
    front_distance: float | None
    #: Share of all cells that a robot ever visited.
    grid_seen_share: float


class MeritTally:
    """Running figures of merit of several worlds, which step together."""

    def __init__(
        self, n_worlds: int, shape: tuple[int, int], *, target: int, recent_steps: int
    ) -> None:
        """Before the first step. `target`: the state that burns; `recent_steps`: at least 1."""
        self._tally = _native.MeritTally(n_worlds, *shape, target, recent_steps)

    def update(
        self,
        visited: NDArray[np.bool_],
        robots: NDArray[np.int64],
        *,
        n_hits: NDArray[np.integer],
        n_burning: NDArray[np.integer],
        states: NDArray[np.uint8] | None = None,
    ) -> None:
        """One step of all worlds.

        Args:
            visited: Cells that some robot visited, `(n_worlds, H, W)`.
            robots: Row and column of each robot after it, `(n_worlds, R, 2)`.
            n_hits: Distinct burning cells that the robots of each world visited.
            n_burning: Burning cells of each world.
            states: The hidden states that the robots met, `(n_worlds, H, W)`; None: not known.
        """
        counts = n_hits.astype(np.uint32), n_burning.astype(np.uint32)
        self._tally.update(visited, robots, *counts, states)

    def merit(self, world: int) -> Merit:
        """The figures of one world's steps so far."""
        detected, n_burning, seen, distance, grid_seen = self._tally.merit(world)
        return Merit(
            steps_to_detection=detected,
            burning_cells_at_detection=n_burning,
            burning_seen_share=seen,
            front_distance=distance,
            grid_seen_share=grid_seen,
        )
