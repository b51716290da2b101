"""Beam search: paths to the most valuable cells, in many worlds at once."""

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
    """Paths whose distinct cells are worth most together, as far as a beam of this width finds.

    Args:
        values: What a visit to each cell is worth, `(n, H, W)`; counts in single precision.
        robots: Row and column of each robot, `(n, 2)`; its cell counts only if it is flown over.
        n_moves: Moves of a path.
        rng: Breaks ties: one number of it for each world.
        visited: Cells that are worth nothing any more, where not 0, `(n, H, W)`.
        width: Paths kept after each move, 1 to 65,536, fewer where they need over 4 GiB; of those
            that end in one cell and have visited the same cells, one.
        airspace: Where the robots may fly, such as `env.world_spec.airspace`; None: everywhere. If
            it pays what is seen, each cell counts that is in sight of the path.

    Returns:
        The moves, `(n, n_moves)`: 0 up, 1 down, 2 left, 3 right.
    """
    given, cells = np.asarray(values), np.asarray(robots)
    n_moves = as_count(n_moves, "n_moves", 1, _native.MAX_MOVES)
    width = as_count(width, "width", 1, 65536)
    _check(given, cells, visited)
    if airspace is not None and airspace.no_fly is not None:
        _check_free(airspace.no_fly, cells, given.shape[1:])
    with np.errstate(over="ignore"):
        worth = given.astype(np.float32)
    if not np.isfinite(worth).all():
        raise invalid("values", "finite numbers in single precision", "others")
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
        raise invalid("values", "finite numbers (n, H, W), some of each", f"shape {values.shape}")
    if robots.shape != (len(values), 2) or robots.dtype.kind not in "iu":
        got = f"{robots.dtype} of shape {robots.shape}"
        raise invalid("robots", f"integers of shape ({len(values)}, 2)", got)
    if ((robots < 0) | (robots >= values.shape[1:])).any():
        raise invalid("robots", f"cells of a {values.shape[1]} x {values.shape[2]} grid", "others")
    if visited is not None and np.shape(visited) != values.shape:
        raise invalid("visited", f"shape {values.shape}", np.shape(visited))


def _check_free(
    no_fly: NDArray[np.bool_], robots: NDArray[np.integer], shape: tuple[int, ...]
) -> None:
    if no_fly.shape != shape:
        raise invalid("airspace: no_fly", f"shape {shape}", no_fly.shape)
    if no_fly[robots[:, 0], robots[:, 1]].any():
        raise invalid("robots", "cells where they may fly", "others")
