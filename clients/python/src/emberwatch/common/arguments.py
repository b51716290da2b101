"""Checks of arguments, such as seeds and moves, before anything is sent."""

import json
import operator
from collections.abc import Iterable, Mapping
from enum import Enum
from itertools import islice
from os import PathLike, fspath
from typing import Any, SupportsIndex, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

import emberwatch._native as _native
from emberwatch.common import codes
from emberwatch.common.paths import utf8, with_absolute_paths
from emberwatch.errors import invalid, repr_of, shortened

_Value = TypeVar("_Value")


def read_settings(settings: Mapping[str, object]) -> _native.CheckedSettings:
    """Checks settings by their names in `config/server.toml`, and reads the files that they name.

    Settings that are None are left out.

    Raises:
        InvalidArgumentError: If a server would refuse them.
    """
    given = with_absolute_paths(settings)
    given = {name: as_setting(name, it) for name, it in given.items() if it is not None}
    return _native.CheckedSettings(json.dumps(given))


def as_setting(name: str, value: object) -> bool | int | str:
    """Converts the value of a setting to its JSON form; a model becomes the text of its file."""
    if isinstance(value, np.generic):
        value = cast("object", value.item())
    if isinstance(value, bool | int):
        if value.bit_length() > 8000:  # Python refuses to print it
            raise invalid(name, "an integer below 2**64", repr_of(value))
        return value
    if name == "model" and isinstance(text := getattr(value, "toml", None), str):
        return text
    if isinstance(value, str | PathLike):
        return utf8(name, cast("str | PathLike[str]", value))
    raise invalid(name, "an integer, True or False, text or a path", repr_of(value))


def as_seed(seed: object) -> int:
    """Checks that a world's seed is an integer below 2**64, of Python, NumPy or another library."""
    number = as_integer(seed)
    if number is not None and 0 <= number < 2**64:
        return number
    raise invalid("seed", "an integer within 0 to 2**64 - 1", repr_of(seed))


def as_integer(value: object) -> int | None:
    """Converts an integer of any library to an `int`; None if the value is not one integer."""
    if isinstance(value, int | np.integer):
        return int(cast("int", value))
    try:
        return None if _is_masked(value) else operator.index(cast("SupportsIndex", value))
    except Exception:  # libraries raise different errors, for example for arrays on a GPU
        return None


def as_count(value: object, subject: str, least: int, most: int) -> int:
    """Checks that a value is an integer within `least` to `most`; refuses True and False."""
    number = None if isinstance(value, bool) else as_integer(value)
    if number is not None and least <= number <= most:
        return number
    raise invalid(subject, f"an integer within {least} to {most}", repr_of(value))


def as_flag(value: object, subject: str) -> bool:
    """Checks that a value is True or False, of Python or NumPy."""
    if isinstance(value, bool | np.bool_):
        return bool(cast("bool", value))
    raise invalid(subject, "True or False", repr_of(value))


def as_seeds(
    seeds: Iterable[int | None] | None, worlds: Iterable[int], n_worlds: int
) -> list[tuple[int, int | None]]:
    """Checks the seeds of a reset, one for each of at most `n_worlds` worlds; returns both."""
    chosen = as_list(worlds, "worlds", n_worlds)
    if len(chosen) > n_worlds:
        raise invalid("worlds", f"at most {n_worlds}", "more")
    given = [None] * len(chosen) if seeds is None else as_list(seeds, "seeds", n_worlds)
    if len(given) != len(chosen):
        raise invalid("seeds", len(chosen), "more" if len(given) > n_worlds else len(given))
    return [
        (world, None if seed is None else as_seed(seed))
        for world, seed in zip(chosen, given, strict=True)
    ]


def as_list(values: Iterable[_Value], subject: str, most: int | None = None) -> list[_Value]:
    """Converts an argument with one value for each world to a list, of at most `most` + 1."""
    try:
        return list(values if most is None else islice(values, most + 1))
    except Exception as error:  # of any type, as in `as_array`
        got = shortened(f"{type(values).__name__}: {error}")
        raise invalid(subject, "one for each world", got) from None


def as_array(value: object, subject: str, expected: str) -> NDArray[Any]:
    """Converts an array of any library to a NumPy array; refuses masked values."""
    if type(value) is np.ndarray:
        return value
    if isinstance(value, int | np.generic):
        return np.asarray(value)
    try:
        given = np.asarray(value)
    except Exception as error:  # of any type, for example for an array on a GPU
        got = shortened(f"{type(value).__name__}: {error}")
        raise invalid(subject, expected, got) from None
    is_sequence = isinstance(value, list | tuple)
    if any(map(_is_masked, cast("list[object]", value))) if is_sequence else _is_masked(value):
        raise invalid(subject, expected, "masked values")
    return given


def _is_masked(value: object) -> bool:
    return isinstance(value, np.ma.MaskedArray) and bool(np.ma.is_masked(cast("Any", value)))


def as_json(value: object) -> Any:
    """Converts a keyword's value to a form that `spec.to_json` can write, as Minari requires."""
    if isinstance(value, PathLike):
        return fspath(cast("PathLike[str]", value))
    if isinstance(text := getattr(value, "toml", None), str):  # a model
        return text
    if isinstance(value, np.generic | np.ndarray):
        return cast("NDArray[Any]", value).tolist()
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Mapping):
        return {key: as_json(kept) for key, kept in cast("Mapping[Any, object]", value).items()}
    if isinstance(value, list | tuple):
        return [as_json(part) for part in cast("list[object]", value)]
    return value


def as_choice(action: object, n_choices: int) -> int:
    """Checks an action that is one integer below `n_choices`."""
    expected = f"one integer, 0 to {n_choices - 1}"
    given = as_array(action, "action", expected)
    if given.size == 1 and given.dtype.kind in "iu" and 0 <= int(given.item()) < n_choices:
        return int(given.item())
    raise invalid("action", expected, repr_of(action))


def as_choices(actions: object, n_worlds: int, n_choices: int) -> NDArray[np.uint8]:
    """Checks actions, one integer below `n_choices` for each world; returns them as uint8."""
    chosen = _native.choices(actions, n_worlds, n_choices)
    if chosen is not None:
        return chosen
    given = as_array(actions, "action", "an array")
    if given.shape != (n_worlds,) or given.dtype.kind not in "iu":
        got = f"{given.dtype} {given.shape}"
        raise invalid("action", f"integers of shape ({n_worlds},)", got)
    if (given < 0).any() or (given >= n_choices).any():
        wrong = int(np.argmax((given < 0) | (given >= n_choices)))
        raise invalid("action", f"0 to {n_choices - 1}", f"{given[wrong]} for world {wrong}")
    return given.astype(np.uint8)


def as_moves(paths: ArrayLike, n_worlds: int, n_moves: int) -> NDArray[np.uint8]:
    """Checks paths, shape (n_worlds, T) or for one world (T,); returns them as uint8."""
    is_read = type(paths) is np.ndarray
    given = paths if is_read else as_array(paths, "action", "an array of moves")
    if given.shape != (n_worlds, n_moves) and (n_worlds != 1 or given.shape != (n_moves,)):
        one = f" or ({n_moves},)" if n_worlds == 1 else ""
        raise invalid("action", f"shape ({n_worlds}, {n_moves}){one}", given.shape)
    if given.dtype.kind not in "iu":
        raise invalid("action", "integers", given.dtype)
    # Only the moves 0 to 3 are 0 after the shift.
    if (given >> 2).any():
        where = tuple(int(i) for i in np.argwhere((given < 0) | (given >= codes.N_MOVES))[0])
        raise invalid("action", f"moves 0 to {codes.N_MOVES - 1}", f"{given[where]} at {where}")
    return given.astype(np.uint8)
