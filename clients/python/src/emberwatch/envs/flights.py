"""Paths that robots fly move by move."""

from emberwatch._native import Flights
from emberwatch.envs.settings import WorldSpec
from emberwatch.errors import InvalidArgumentError


def flights_of(
    spec: WorldSpec, n_rows: int, windows: list[tuple[int, int]], *, pays: bool
) -> Flights:
    """Makes the state of the current paths of `n_rows` robots.

    `windows`: of each square of cells around the robots, its side, and its number of channels about
    the world. With `pays`, moves are rewarded: each cell pays the reward of its hidden state when
    the path first visits it.
    """
    if pays and spec.described is None:
        raise InvalidArgumentError("reward='move': expected a server that reveals its model")
    reward = spec.described.reward.tolist() if pays and spec.described else None
    grid = spec.height, spec.width
    return Flights(n_rows, *grid, spec.n_moves, reward, spec.airspace, windows)
