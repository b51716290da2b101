"""Moves of a robot, and the cells that they reach."""

from typing import Final, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emberwatch.model.airspace import Airspace

#: Change in row and column of each move: up, down, left, right.
DIRECTIONS: Final = np.array(((-1, 0), (1, 0), (0, -1), (0, 1)), np.int64)


class Grid(Protocol):
    """The grid that robots fly on, such as a `WorldSpec` or a `ServerInfo`."""

    @property
    def height(self) -> int: ...

    @property
    def width(self) -> int: ...

    @property
    def airspace(self) -> Airspace: ...


def fly(start: ArrayLike, moves: ArrayLike, grid: Grid) -> NDArray[np.int64]:
    """Returns the cell after each move of a path, shape (T, 2), or of n paths, (n, T, 2).

    A move off the grid or into a no-fly cell leaves the robot in place. `start` has shape (2,) and
    `moves` (T,) for one path, (n, 2) and (n, T) for n paths.
    """
    given, cell = np.asarray(moves), np.asarray(start, np.int64)
    cells = np.empty((*given.shape, 2), np.int64)
    no_fly = grid.airspace.no_fly
    for move in range(given.shape[-1]):
        after = (cell + DIRECTIONS[given[..., move]]).clip(0, (grid.height - 1, grid.width - 1))
        if no_fly is not None:
            after = np.where(no_fly[after[..., 0], after[..., 1], np.newaxis], cell, after)
        cell = after
        cells[..., move, :] = cell
    return cells
