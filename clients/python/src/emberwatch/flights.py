"""Paths flown move by move by many robots: where they are, what they have visited."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError
from emberwatch.moves import DIRECTIONS
from emberwatch.settings import WorldSpec


class Flights:
    """The present path of each robot, as far as it is flown. Rows are robots."""

    def __init__(self, spec: WorldSpec, n_rows: int, *, pays: bool) -> None:
        """`pays`: each cell pays when it is first visited, what its hidden state pays."""
        self.spec: Final = spec
        if pays and spec.described is None:
            raise InvalidArgumentError("reward='move': expected a server that reveals its model")
        self._reward = spec.described.reward if pays and spec.described else None
        self._last_cell = np.array((spec.height - 1, spec.width - 1), np.int64)
        #: Row and column of each robot.
        self.robots = np.zeros((n_rows, 2), np.int64)
        #: Number of moves made.
        self.n_made = np.zeros(n_rows, np.int64)
        #: 255 in the cells visited, else 0.
        self.visited = np.zeros((n_rows, spec.height, spec.width), np.uint8)
        #: What the moves have been paid.
        self.paid = np.zeros(n_rows)
        self._states = np.zeros_like(self.visited)
        self._moves = np.zeros((n_rows, spec.n_moves), np.uint8)

    def begin(
        self,
        begun: NDArray[np.bool_],
        robots: NDArray[np.int64],
        states: NDArray[np.uint8] | None,
    ) -> None:
        """Begins some paths; `robots` and hidden `states` are those of all rows."""
        self.robots[begun] = robots[begun]
        self.n_made[begun] = 0
        self.visited[begun] = 0
        self.paid[begun] = 0.0
        if states is not None:
            self._states[begun] = states[begun]

    def completes(self) -> NDArray[np.bool_]:
        """Of which rows the next move is the last of its path."""
        return self.n_made == self.spec.n_moves - 1

    def paths(self, actions: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The paths that these actions would complete, `(n_rows, T)`."""
        return np.concatenate((self._moves[:, :-1], actions[:, np.newaxis]), axis=1)

    def made(self, row: int) -> NDArray[np.uint8]:
        """The moves made by one robot."""
        return self._moves[row, : self.n_made[row]]

    def move(self, indices: NDArray[np.intp], actions: NDArray[np.uint8]) -> NDArray[np.float64]:
        """One move of some robots; returns what it pays them."""
        chosen = actions[indices]
        self._moves[indices, self.n_made[indices]] = chosen
        self.n_made[indices] += 1
        cells = (self.robots[indices] + DIRECTIONS[chosen]).clip(0, self._last_cell)
        self.robots[indices] = cells
        at = (indices, cells[:, 0], cells[:, 1])
        rewards = np.zeros(len(indices))
        if self._reward is not None:
            rewards = np.where(self.visited[at] == 0, self._reward[self._states[at]], 0.0)
            self.paid[indices] += rewards
        self.visited[at] = 255
        return rewards
