"""Beam search in NumPy: paths to the most valuable cells, in many worlds at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import invalid
from emberwatch.view import DIRECTIONS


def beam_search(
    values: NDArray[np.floating],
    robots: NDArray[np.integer],
    n_moves: int,
    *,
    rng: np.random.Generator,
    visited: NDArray[np.generic] | None = None,
    width: int = 50,
) -> NDArray[np.uint8]:
    """Paths whose distinct cells are worth most together, as far as a beam of this width finds.

    Args:
        values: What a visit to each cell is worth, `(n, H, W)`.
        robots: Row and column of each robot, `(n, 2)`; its cell counts only if it is flown over.
        n_moves: Moves of a path, at least 1.
        rng: Breaks ties, between paths that differ by less than 1e-6 for each move.
        visited: Cells that are worth nothing any more, where not 0, `(n, H, W)`.
        width: Paths kept after each move, at least 1.

    Returns:
        The moves, `(n, n_moves)`: 0 up, 1 down, 2 left, 3 right.
    """
    values, cells = np.asarray(values), np.asarray(robots)
    _check(values, cells, visited, n_moves=n_moves, width=width)
    n, n_rows, n_columns = values.shape
    reached_from = _neighbours(n_rows, n_columns)
    flat, worlds = values.reshape(n, -1), np.arange(n, dtype=np.int64)[:, np.newaxis]
    cells = cells.astype(np.int64)
    cells = (cells[:, 0] * n_columns + cells[:, 1])[:, np.newaxis]
    seen = np.zeros((n, 1, n_rows * n_columns), np.bool_)
    if visited is not None:
        seen |= np.asarray(visited).reshape(seen.shape) != 0
    scores, paths = np.zeros((n, 1)), np.empty((n, 1, 0), np.uint8)
    for _ in range(n_moves):
        reached = reached_from[cells].reshape(n, -1)
        parents = np.arange(4 * cells.shape[1], dtype=np.int64)[np.newaxis] // 4
        found = ~seen[worlds, parents, reached] * flat[worlds, reached]
        longer = scores[worlds, parents] + found + 1e-6 * rng.random(reached.shape)
        n_kept = min(width, longer.shape[1])
        kept = np.argpartition(-longer, n_kept - 1, axis=1)[:, :n_kept]
        parents, moves = np.divmod(kept, 4)
        cells, scores = reached[worlds, kept], longer[worlds, kept]
        last = moves[..., np.newaxis].astype(np.uint8)
        paths = np.concatenate((paths[worlds, parents], last), axis=2)
        seen = seen[worlds, parents]
        seen[worlds, np.arange(n_kept)[np.newaxis], cells] = True
    return paths[np.arange(n), scores.argmax(axis=1)]


def _check(
    values: NDArray[np.floating],
    robots: NDArray[np.integer],
    visited: NDArray[np.generic] | None,
    **numbers: int,
) -> None:
    for name, number in numbers.items():
        if not isinstance(number, int | np.integer) or number < 1:  # pyright: ignore[reportUnnecessaryIsInstance]
            raise invalid(name, "an integer from 1 on", repr(number))
    if values.ndim != 3 or values.size == 0 or not np.isfinite(values).all():
        raise invalid("values", "finite numbers (n, H, W), some of each", f"shape {values.shape}")
    if robots.shape != (len(values), 2) or robots.dtype.kind not in "iu":
        got = f"{robots.dtype} of shape {robots.shape}"
        raise invalid("robots", f"integers of shape ({len(values)}, 2)", got)
    if ((robots < 0) | (robots >= values.shape[1:])).any():
        raise invalid("robots", f"cells of a {values.shape[1]} x {values.shape[2]} grid", "others")
    if visited is not None and np.shape(visited) != values.shape:
        raise invalid("visited", f"shape {values.shape}", np.shape(visited))


def _neighbours(n_rows: int, n_columns: int) -> NDArray[np.int64]:
    """The cell that each move leads to, `(H * W, 4)`: the same one at the edge."""
    cells = np.moveaxis(np.indices((n_rows, n_columns)), 0, -1).reshape(-1, 1, 2)
    reached = (cells + DIRECTIONS).clip(0, (n_rows - 1, n_columns - 1))
    return reached[..., 0] * n_columns + reached[..., 1]
