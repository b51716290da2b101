"""Beam search: the best paths, and refusals of invalid arguments."""

from typing import Any

import numpy as np
from failures import refuses

from emberwatch.model.airspace import Airspace
from emberwatch.planning import beam_search

RNG = np.random.default_rng(3)


def test_visited_cells_have_no_value() -> None:
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
    # Up, down, left and right are equally good.
    counts = np.bincount(np.concatenate((first, other))[:, 0], minlength=4)
    assert counts.min() >= 5, counts


#: Changes that make valid arguments invalid, and words of the error.
WRONG: list[tuple[dict[str, Any], str]] = [
    *(
        ({"n_moves": n}, f"n_moves: expected an integer within 1 to 4096, got {n}")
        for n in (0, 10**30)
    ),
    ({"width": 2.5}, "width: expected an integer within 1 to 65536, got 2.5"),
    (
        {"values": np.zeros((1, 4096, 4096)), "n_moves": 4096, "width": 65536},
        "width: expected an integer within 1 to 1016, got 65536",  # limited by memory
    ),
    ({"values": np.zeros((1, 1, 5000))}, "grid: expected height and width .*, got 1 x 5000"),
    ({"values": np.zeros((2, 2))}, r"values: expected .*, got shape \(2, 2\)"),
    ({"values": np.full((1, 2, 2), np.nan)}, "values: expected finite numbers"),
    ({"robots": np.zeros((1, 2))}, "robots: expected integers .*, got float64"),
    ({"robots": np.zeros((2, 2), int)}, r"robots: expected .* of shape \(1, 2\)"),
    ({"robots": np.array([(0, 2)])}, r"robots: expected cells of a 2 x 2 grid .* got \[0, 2\]"),
    ({"visited": np.zeros(4)}, r"visited: expected shape \(1, 2, 2\), got \(4,\)"),
    ({"airspace": Airspace(no_fly=np.zeros((5, 7), bool))}, r"no_fly: expected shape \(2, 2\)"),
    (
        {"airspace": Airspace(no_fly=np.array([[True, False], [False, False]]))},
        "robots: expected cells of a 2 x 2 grid where they may fly",
    ),
]


def test_wrong_search_arguments_are_named() -> None:
    right = {"values": np.zeros((1, 2, 2)), "robots": np.zeros((1, 2), int), "n_moves": 1}
    for wrong, words in WRONG:
        with refuses(words):
            beam_search(**{**right, **wrong}, rng=RNG)
