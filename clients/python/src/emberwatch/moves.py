"""Moves of a robot, and the cells that they lead to."""

from typing import Final, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Row and column that each move adds: up, down, left, right.
DIRECTIONS: Final = np.array(((-1, 0), (1, 0), (0, -1), (0, 1)), np.int64)


class Grid(Protocol):
    """What has a height and a width, such as a `WorldSpec` or a `ServerInfo`."""

    @property
    def height(self) -> int: ...

    @property
    def width(self) -> int: ...


def fly(start: ArrayLike, moves: ArrayLike, grid: Grid) -> NDArray[np.int64]:
    """The cells of a path after each move, `(T, 2)`: a move off the grid stays in place.

    Or those of n paths, `(n, T, 2)`, where `start` is `(n, 2)` and `moves` `(n, T)`.
    """
    given, cell = np.asarray(moves), np.asarray(start, np.int64)
    cells = np.empty((*given.shape, 2), np.int64)
    for move in range(given.shape[-1]):
        cell = (cell + DIRECTIONS[given[..., move]]).clip(0, (grid.height - 1, grid.width - 1))
        cells[..., move, :] = cell
    return cells
