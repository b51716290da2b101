"""The field's figures of merit of some worlds' runs, as `docs/figures-of-merit.md` defines them.

They need no model: only which state is the target, and for two of them the hidden states.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

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
    """The figures of some worlds while they go on, together."""

    def __init__(
        self, n_worlds: int, shape: tuple[int, int], *, target: int, recent_steps: int
    ) -> None:
        """Before the first step. `target`: the state that burns; `recent_steps`: at least 1."""
        self._target, self._recent_steps = target, recent_steps
        self._rows, self._cols = np.arange(shape[0]), np.arange(shape[1])
        self._step = 0
        #: The step of the last visit to each cell; 0: never.
        self._last_visits = np.zeros((n_worlds, *shape), np.int64)
        #: Step, 0: none yet, and burning cells.
        self._detections = np.zeros((n_worlds, 2), np.int64)
        #: Sums and counts of the worlds that had a value.
        self._burning_seen, self._distances = np.zeros((2, 2, n_worlds))

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
        self._step += 1
        self._last_visits[visited] = self._step
        found = (self._detections[:, 0] == 0) & (n_hits > 0)
        self._detections[found, 0] = self._step
        self._detections[found, 1] = n_burning[found]
        if states is not None:
            self._watch(robots, states == self._target)

    def merit(self, world: int) -> Merit:
        """The figures of one world's steps so far."""
        step, n_burning = self._detections[world].tolist()
        visits = self._last_visits[world]
        return Merit(
            steps_to_detection=step or None,
            burning_cells_at_detection=n_burning if step else None,
            burning_seen_share=_mean(self._burning_seen[:, world]),
            front_distance=_mean(self._distances[:, world]),
            grid_seen_share=np.count_nonzero(visits) / visits.size,
        )

    def _watch(self, robots: NDArray[np.int64], burning: NDArray[np.bool_]) -> None:
        seen = self._last_visits > max(self._step - self._recent_steps, 0)
        n_burning = burning.sum(axis=(1, 2))
        n_seen = (burning & seen).sum(axis=(1, 2))
        burns = n_burning > 0
        self._burning_seen += np.where(burns, n_seen / np.maximum(n_burning, 1), 0.0), burns
        front: NDArray[np.bool_] = burning & ~seen
        far = sum(front.shape)
        nearest = np.full(len(front), far)
        for robot in robots.swapaxes(0, 1):
            row_moves = np.abs(self._rows - robot[:, :1])[:, :, np.newaxis]
            moves = row_moves + np.abs(self._cols - robot[:, 1:])[:, np.newaxis, :]
            nearest = np.minimum(nearest, np.where(front, moves, far).min(axis=(1, 2)))
        self._distances += np.where(nearest < far, nearest, 0), nearest < far


def _mean(of: NDArray[np.float64]) -> float | None:
    """Of a sum and a count."""
    total, count = of.tolist()
    return total / count if count else None
