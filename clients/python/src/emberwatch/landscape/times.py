"""Units of time, and the step that first shows each layer."""

import math
import string
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.layers import SINCE_1970, Layer

SECONDS: Final = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
"""The length of each unit in seconds."""

_EVEN: Final = 1e-3  # tolerance for times, share of a step, because decimal fractions are rounded
_SPELLINGS: Final = {
    "millisecond": "ms", "msec": "ms", "second": "s", "sec": "s", "minute": "min", "hour": "h",
    "hr": "h", "day": "d",
}  # fmt: skip


def length(text: str) -> float:
    """Parses a length of time such as `10 min` to seconds."""
    number = text.rstrip(string.ascii_letters + " ")
    try:
        seconds = float(number) * SECONDS[_key(text[len(number) :])]
    except (KeyError, ValueError):
        seconds = 0.0
    if not 0.0 < seconds < math.inf:
        raise invalid("--step", "a number and s, min, h or d, such as '10 min'", f"'{text}'")
    return seconds


def unit_of(words: str, wanted: str | None, name: str) -> str | None:
    """Returns the unit of times from the file or the flag; refuses two different units."""
    in_file = "s" if words == SINCE_1970 else _key(words)
    if in_file in SECONDS:
        if wanted not in (None, in_file):
            raise invalid("--unit", f"{in_file}, as in {name}", wanted)
        return in_file
    if wanted is None and words not in ("", "1"):
        got = f"'{words}'; give the unit with --unit"
        raise invalid(name, "times in days or smaller units", got)
    return wanted


def date(seconds: float, words: str) -> str | None:
    """Returns the date of a time; None if the file has no dates."""
    if words != SINCE_1970 or not math.isfinite(seconds):
        return None
    day, _, time = str(np.datetime64(round(seconds), "s")).partition("T")
    return f"{day} {time} UTC"


def steps_at(times: NDArray[Any], step: float) -> NDArray[np.float64]:
    """Returns the first step at or after each time, from 0; infinite times stay infinite."""
    with np.errstate(over="ignore"):
        steps = np.ceil(times / step - _EVEN)
    if (np.isinf(steps) & np.isfinite(times)).any():
        most = times[np.isfinite(times)].max()
        raise InvalidArgumentError(f"--step: too short for times up to {most:.6g}, got {step:.6g}")
    return steps


def schedule(layers: Sequence[Layer], *, step: float, unit: str | None) -> NDArray[np.float64]:
    """Computes the first step that shows each layer. The layers' times must increase.

    `step` is in seconds. `unit` is the unit of the times; None for the files' unit. Layers without
    times, or without a unit of times, make one step each.
    """
    first = layers[0]
    for layer in layers:
        if (layer.time is None, layer.time_unit) != (first.time is None, first.time_unit):
            expected = f"a time in '{first.time_unit}', as in {first.name}"
            raise invalid(layer.name, expected, f"'{layer.time_unit}'")
    each = np.arange(len(layers), dtype=np.float64)
    if first.time is None and unit is not None:
        raise invalid(first.name, "the time of the layer", f"none; leave out --unit {unit}")
    known = unit_of(first.time_unit, unit, first.name)
    if first.time is None or known is None:
        return each
    times = np.array([layer.time for layer in layers], np.float64)
    for layer, before, after in zip(layers[1:], times, times[1:], strict=False):
        if not after > before:
            earlier, got = (date(at, first.time_unit) or f"{at:.6g}" for at in (before, after))
            raise invalid(layer.name, f"a later time than {earlier}", got)
    return steps_at((times - times[0]) * SECONDS[known], step)


def _key(words: str) -> str:
    word = words.strip().lower()
    word = word if word in SECONDS else word.removesuffix("s")
    return _SPELLINGS.get(word, word)
