"""Beam search for paths over the most valuable cells, in many worlds at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import emberwatch._native as _native
from emberwatch.common.arguments import as_count
from emberwatch.errors import invalid
from emberwatch.model.airspace import Airspace


def beam_search(
    values: NDArray[np.floating],
    robots: NDArray[np.integer],
    n_moves: int,
    *,
    rng: np.random.Generator,
    visited: NDArray[np.generic] | None = None,
    width: int = 50,
    airspace: Airspace | None = None,
) -> NDArray[np.uint8]:
    """Finds a path for each of n worlds that maximises the summed values of its distinct cells.

    Beam search is approximate: a larger `width` finds better paths and takes longer.

    Args:
        values: Value of visiting each cell, shape (n, H, W); converted to single precision.
        robots: Row and column of each robot, shape (n, 2). The robot's own cell counts only if the
            path returns to it.
        n_moves: Number of moves in a path.
        rng: Generator that breaks ties; one number is drawn for each world.
        visited: Nonzero in cells that have no value, because they were visited before. Shape
            (n, H, W).
        width: Number of paths kept after each move, 1 to 65,536. The maximum is lower if that
            many would need more than 4 GiB; a larger width is refused. Among paths that visited
            the same cells and end in the same cell, only one is kept.
        airspace: Where the robots may fly, such as `env.world_spec.airspace`. None: everywhere.

    Returns:
        The moves, shape (n, n_moves): 0 up, 1 down, 2 left, 3 right.
    """
    given, cells = np.asarray(values), np.asarray(robots)
    n_moves = as_count(n_moves, "n_moves", 1, _native.MAX_MOVES)
    width = as_count(width, "width", 1, 65536)
    _check(given, cells, visited)
    with np.errstate(over="ignore"):
        worth = given.astype(np.float32)
    if not np.isfinite(worth).all():
        raise invalid("values", "numbers that are finite in single precision", "larger ones")
    if visited is not None:
        worth[np.asarray(visited) != 0] = 0.0
    keys = rng.integers(2**64, size=len(worth), dtype=np.uint64)
    return _native.beam_search(worth, cells.astype(np.int64), keys, n_moves, width, airspace)


def _check(
    values: NDArray[np.floating],
    robots: NDArray[np.integer],
    visited: NDArray[np.generic] | None,
) -> None:
    if values.ndim != 3 or values.size == 0 or not np.isfinite(values).all():
        got = f"shape {values.shape}" if values.ndim != 3 or values.size == 0 else "NaN or infinity"
        raise invalid("values", "finite numbers of shape (n, H, W), at least one", got)
    if robots.shape != (len(values), 2) or robots.dtype.kind not in "iu":
        got = f"{robots.dtype} of shape {robots.shape}"
        raise invalid("robots", f"integers of shape ({len(values)}, 2)", got)
    if visited is not None and np.shape(visited) != values.shape:
        raise invalid("visited", f"shape {values.shape}", np.shape(visited))
