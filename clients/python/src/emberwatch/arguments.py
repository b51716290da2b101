"""What callers hand in: seeds, choices, moves, each checked before anything is sent."""

from collections.abc import Iterable
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emberwatch import wire
from emberwatch.errors import invalid


def as_seed(seed: object) -> int:
    """Checks a world's seed."""
    if isinstance(seed, int | np.integer):
        number = int(cast("int", seed))
        if 0 <= number < 2**64:
            return number
    raise invalid("seed", "an integer within 0 to 2**64 - 1", f"{seed!r}")


def as_seeds(
    seeds: Iterable[int | None] | None, worlds: Iterable[int]
) -> list[dict[str, int | None]]:
    """Checks the seeds of a reset, one for each world, and names them as its request does."""
    chosen = list(worlds)
    given = [None] * len(chosen) if seeds is None else list(seeds)
    if len(given) != len(chosen):
        raise invalid("seeds", len(chosen), len(given))
    return [
        {"world": world, "seed": None if seed is None else as_seed(seed)}
        for world, seed in zip(chosen, given, strict=True)
    ]


def as_choice(action: object, n_choices: int) -> int:
    """Checks an action that is one integer below `n_choices`."""
    try:
        given = np.asarray(action)
    except (ValueError, OverflowError):
        given = np.empty(0)
    if given.size == 1 and given.dtype.kind in "iu" and 0 <= int(given.item()) < n_choices:
        return int(given.item())
    raise invalid("action", f"one integer, 0 to {n_choices - 1}", repr(action))


def as_choices(actions: object, n_worlds: int, n_choices: int) -> NDArray[np.uint8]:
    """Checks actions, one integer below `n_choices` for each world, and makes them bytes."""
    try:
        given = np.asarray(actions)
    except (ValueError, OverflowError) as error:
        raise invalid("action", "an array", error) from None
    if given.shape != (n_worlds,) or given.dtype.kind not in "iu":
        got = f"{given.dtype} {given.shape}"
        raise invalid("action", f"integers of shape ({n_worlds},)", got)
    if (given < 0).any() or (given >= n_choices).any():
        wrong = int(np.argmax((given < 0) | (given >= n_choices)))
        raise invalid("action", f"0 to {n_choices - 1}", f"{given[wrong]} for world {wrong}")
    return given.astype(np.uint8)


def as_moves(paths: ArrayLike, n_worlds: int, n_moves: int) -> NDArray[np.uint8]:
    """Checks paths, `(n_worlds, T)` or for one world `(T,)`, and makes them bytes."""
    try:
        given = np.asarray(paths)
    except (ValueError, OverflowError) as error:
        raise invalid("action", "an array of moves", error) from None
    if given.shape != (n_worlds, n_moves) and (n_worlds != 1 or given.shape != (n_moves,)):
        one = f" or ({n_moves},)" if n_worlds == 1 else ""
        raise invalid("action", f"shape ({n_worlds}, {n_moves}){one}", given.shape)
    if given.dtype.kind not in "iu":
        raise invalid("action", "integers", given.dtype)
    # One shift leaves something of each value below 0 or above 3.
    if (given >> 2).any():
        where = tuple(int(i) for i in np.argwhere((given < 0) | (given >= wire.N_MOVES))[0])
        raise invalid("action", f"moves 0 to {wire.N_MOVES - 1}", f"{given[where]} at {where}")
    return given.astype(np.uint8)
