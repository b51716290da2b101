"""Paths flown move by move by many robots, in rows."""

from emberwatch._native import Flights
from emberwatch.envs.settings import WorldSpec
from emberwatch.errors import InvalidArgumentError


def flights_of(spec: WorldSpec, n_rows: int, *, pays: bool) -> Flights:
    """The present path of each robot, as far as it is flown.

    `pays`: each cell pays when it is first visited, or seen where that pays, what its hidden state
    pays.
    """
    if pays and spec.described is None:
        raise InvalidArgumentError("reward='move': expected a server that reveals its model")
    reward = spec.described.reward.tolist() if pays and spec.described else None
    grid = spec.height, spec.width
    return Flights(n_rows, *grid, spec.n_moves, reward, spec.airspace)
