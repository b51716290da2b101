"""The figures of merit on hand-made worlds, as `agent/src/benchmark/merit.rs` has them."""

from collections.abc import Sequence

import numpy as np
import pytest

from emberwatch.belief.merit import Merit, MeritTally

FIRE = 2

#: A row of cells in which `#` burns, and the cells that each robot visits, the last where it ends.
Step = tuple[str, Sequence[Sequence[int]]]


def merit(recent_steps: int, steps: Sequence[Step]) -> Merit:
    """The figures of a world, measured beside its mirror image, of which they are the same."""
    width = len(steps[0][0])
    tally = MeritTally(2, (1, width), target=FIRE, recent_steps=recent_steps)
    for row, flights in steps:
        burning = np.array([cell == "#" for cell in row])
        visited = np.zeros(width, np.bool_)
        visited[np.concatenate(flights).astype(int)] = True
        burning, visited = (np.stack((one, one[::-1])) for one in (burning, visited))
        ends = np.array([cells[-1] for cells in flights])
        robots = np.zeros((2, len(flights), 2), np.int64)
        robots[:, :, 1] = ends, width - 1 - ends
        tally.update(
            visited[:, np.newaxis],
            robots,
            n_hits=(burning & visited).sum(1),
            n_burning=burning.sum(1),
            states=np.where(burning, FIRE, 1).astype(np.uint8)[:, np.newaxis],
        )
    assert tally.merit(0) == tally.merit(1)
    return tally.merit(0)


def test_fire_is_detected_by_the_first_visit_to_a_cell_that_burns_then() -> None:
    got = merit(9, [("....", [[0, 1]]), (".#..", [[2]]), (".##.", [[2]])])
    assert (got.steps_to_detection, got.burning_cells_at_detection) == (3, 2)
    got = merit(9, [("#...", [[0]]), ("####", [[1]])])
    assert (got.steps_to_detection, got.burning_cells_at_detection) == (1, 1)


def test_what_is_never_detected_has_no_time() -> None:
    got = merit(9, [("...#", [[0]]), ("...#", [[1]])])
    assert (got.steps_to_detection, got.burning_cells_at_detection) == (None, None)
    assert (got.burning_seen_share, got.front_distance) == (0.0, 2.5)


def test_a_world_without_fire_has_no_share_and_no_front() -> None:
    got = merit(9, [("....", [[0]]), ("....", [[1, 2]])])
    assert (got.burning_seen_share, got.front_distance, got.grid_seen_share) == (None, None, 0.75)
    assert merit(9, [("....", [[0]]), ("#..#", [[1]])]).burning_seen_share == 0.5


def test_fire_that_is_all_seen_has_no_front() -> None:
    got = merit(9, [("##..", [[1, 0]]), ("##..", [[2, 3]])])
    assert (got.burning_seen_share, got.front_distance, got.grid_seen_share) == (1.0, None, 1.0)


@pytest.mark.parametrize(
    ("recent_steps", "seen", "distance"), [(3, 1.5, 6.0), (2, 1.0, 6.0), (1, 0.5, 5.0)]
)
def test_cells_are_seen_for_the_last_steps_alone(
    recent_steps: int, seen: float, distance: float
) -> None:
    got = merit(recent_steps, [("#..#", [[0]]), ("#..#", [[1]]), ("#..#", [[2]])])
    assert (got.burning_seen_share, got.front_distance) == (seen / 3, distance / 3)
    assert got.grid_seen_share == 0.75


def test_the_robots_of_a_team_see_together() -> None:
    got = merit(9, [("#....#.#", [[0, 1], [4, 5]])])
    assert (got.burning_seen_share, got.burning_cells_at_detection) == (2 / 3, 3)
    assert (got.front_distance, got.grid_seen_share) == (2.0, 0.5)


def test_distances_count_moves_in_rows_and_columns() -> None:
    tally = MeritTally(1, (3, 4), target=FIRE, recent_steps=1)
    states = np.zeros((1, 3, 4), np.uint8)
    states[0, 2, 3] = FIRE
    none, robots = np.zeros((1, 3, 4), np.bool_), np.array([[[0, 1]]])
    tally.update(none, robots, n_hits=np.zeros(1, int), n_burning=np.ones(1, int), states=states)
    assert tally.merit(0).front_distance == 4.0


def test_without_hidden_states_the_rest_is_measured() -> None:
    tally = MeritTally(1, (1, 4), target=FIRE, recent_steps=1)
    visited = np.array([[[True, True, False, False]]])
    hits, burning = np.ones(1, int), np.array([7])
    tally.update(visited, np.array([[[0, 1]]]), n_hits=hits, n_burning=burning)
    expected = Merit(
        steps_to_detection=1,
        burning_cells_at_detection=7,
        burning_seen_share=None,
        front_distance=None,
        grid_seen_share=0.5,
    )
    assert tally.merit(0) == expected
