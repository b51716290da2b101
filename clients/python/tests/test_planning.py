"""Beam search: the best paths, and the refusal of what makes no sense."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError
from emberwatch.model.moves import DIRECTIONS
from emberwatch.planning import beam_search

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


def test_the_generator_breaks_ties() -> None:
    values, robots = np.ones((40, 9, 9)), np.full((40, 2), 4)
    first, again, other = (
        beam_search(values, robots, 3, rng=np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    # Up, down, left and right are alike.
    counts = np.bincount(np.concatenate((first, other))[:, 0], minlength=4)
    assert counts.min() >= 5, counts


def test_small_integers_are_cells_too() -> None:
    values = np.zeros((1, 64, 64))
    values[0, 40, 41] = 1.0
    assert beam_search(values, np.array([(40, 40)], np.uint8), 1, rng=RNG).tolist() == [[3]]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"n_moves": 0}, "n_moves: expected an integer within 1 to 4096, got 0"),
        ({"width": 2.5}, "width: expected an integer within 1 to 65536, got 2.5"),
        ({"values": np.zeros((2, 2))}, r"values: expected .*, got shape \(2, 2\)"),
        ({"values": np.full((1, 2, 2), np.nan)}, "values: expected finite numbers"),
        ({"robots": np.zeros((1, 2))}, "robots: expected integers .*, got float64"),
        ({"robots": np.zeros((2, 2), int)}, r"robots: expected .* of shape \(1, 2\)"),
        ({"robots": np.array([(0, 2)])}, "robots: expected cells of a 2 x 2 grid"),
        ({"visited": np.zeros(4)}, r"visited: expected shape \(1, 2, 2\), got \(4,\)"),
    ],
    ids=str,
)
def test_wrong_input_is_named(wrong: dict[str, Any], message: str) -> None:
    right = {"values": np.zeros((1, 2, 2)), "robots": np.zeros((1, 2), int), "n_moves": 1}
    with pytest.raises(InvalidArgumentError, match=message):
        beam_search(**{**right, **wrong}, rng=RNG)
