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
    with np.errstate(over="ignore"):  # refused below, as infinity
        given, cells = np.asarray(values, np.float32), np.asarray(robots)
    n_moves = as_count(n_moves, "n_moves", 1, _native.MAX_MOVES)
    width = as_count(width, "width", 1, 65536)
    if given.ndim != 3 or given.size == 0 or not np.isfinite(given).all():
        got = f"shape {given.shape}" if given.ndim != 3 or given.size == 0 else "NaN or infinity"
        raise invalid("values", "finite numbers of shape (n, H, W), at least one", got)
    grid = given.shape[1:]
    if cells.shape != (len(given), 2) or cells.dtype.kind not in "iu":
        got = f"{cells.dtype} of shape {cells.shape}"
        raise invalid("robots", f"integers of shape ({len(given)}, 2)", got)
    no_fly = None if airspace is None else airspace.no_fly
    is_off = ((cells < 0) | (cells >= grid)).any(axis=1)
    if not is_off.any() and no_fly is not None and no_fly.shape == grid:
        is_off = no_fly[cells[:, 0], cells[:, 1]]
    if is_off.any():
        expected = f"cells of a {grid[0]} x {grid[1]} grid, where they may fly"
        raise invalid("robots", expected, cells[is_off][0].tolist())
    if visited is not None:
        if np.shape(visited) != given.shape:
            raise invalid("visited", f"shape {given.shape}", np.shape(visited))
        given = np.where(np.asarray(visited) != 0, np.float32(0.0), given)
    keys = rng.integers(2**64, size=len(given), dtype=np.uint64)
    return _native.beam_search(given, cells.astype(np.int64), keys, n_moves, width, airspace)
