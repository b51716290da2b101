"""Beam search in NumPy."""

from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError
from emberwatch.planning import beam_search
from emberwatch.view import DIRECTIONS

RNG = np.random.default_rng(3)


def worth(values: NDArray[np.floating], robot: NDArray[np.integer], path: tuple[int, ...]) -> float:
    """Of a path's distinct cells, move by move."""
    cell, visited = tuple(robot), set[tuple[int, ...]]()
    for move in path:
        row, col = np.add(cell, DIRECTIONS[move]).clip(0, np.array(values.shape) - 1)
        cell = (int(row), int(col))
        visited.add(cell)
    return sum(float(values[cell]) for cell in visited)


def test_a_wide_beam_finds_the_best_of_all_paths_in_each_world() -> None:
    values, robots = RNG.random((3, 4, 5)), np.array([(0, 0), (3, 4), (1, 2)])
    paths = beam_search(values, robots, 5, rng=RNG, width=4**5)
    for world, robot, path in zip(values, robots, paths, strict=True):
        best = max(worth(world, robot, every) for every in product(range(4), repeat=5))
        assert worth(world, robot, tuple(path)) == pytest.approx(best, abs=1e-5)


def test_visited_cells_are_worth_nothing() -> None:
    values, visited = np.zeros((1, 3, 3)), np.zeros((1, 3, 3), np.uint8)
    values[0, 1, 2], values[0, 0, 1], visited[0, 1, 2] = 9.0, 1.0, 255
    paths = beam_search(values, np.array([(1, 1)]), 1, rng=RNG, visited=visited)
    assert paths.tolist() == [[0]]


def test_a_path_without_moves_is_refused() -> None:
    with pytest.raises(InvalidArgumentError, match="at least 1, got 0 and 50"):
        beam_search(np.zeros((1, 2, 2)), np.zeros((1, 2), np.int64), 0, rng=RNG)
