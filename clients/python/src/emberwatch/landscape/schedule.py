"""Times in files, such as `hours since 2020-08-01`, and the step that first shows each layer."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.libraries import library

SECONDS: Final = {
    "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9
}  # fmt: skip
"""The length of each unit in seconds."""
EVEN: Final = 1e-3
"""Tolerance for times, as a share of a step, because decimal fractions are rounded."""
SINCE_1970: Final = "seconds since 1970-01-01"

_COARSE: Final = 0.1  # maximum distance between numbers that the file can store, share of a step
_SPELLINGS: Final = {
    "sec": "s", "second": "s", "minute": "min", "hr": "h", "hour": "h", "day": "d",
    "msec": "ms", "millisecond": "ms", "microsecond": "us", "nanosecond": "ns",
}  # fmt: skip


class Clock(NamedTuple):
    """The unit and origin of times, as the file writes them."""

    words: str = ""
    calendar: str = "standard"

    def unit(self) -> str | None:
        """Returns the unit, a key of `SECONDS`; None if the file does not state it."""
        unit = _unit(self.words.partition(" since ")[0])
        return unit if unit in SECONDS else None

    def epoch(self) -> float | None:
        """Returns time 0 in seconds since 1970 in the calendar; None if the file has no date."""
        _, since, date = self.words.partition(" since ")
        if not since:
            return None
        cftime = library("cftime", f"times in '{self.words}'")
        try:
            start = cftime.num2date(0, f"seconds since {date}", self.calendar)
            return float(cftime.date2num(start, SINCE_1970, self.calendar))
        except (OverflowError, ValueError):  # not a day of the calendar
            return None

    def date(self, seconds: float) -> str | None:
        """Returns the date `seconds` after time 0; None if the date of time 0 is unknown."""
        epoch = self.epoch()
        if epoch is None:
            return None
        date = library("cftime", "times").num2date(epoch + seconds, SINCE_1970, self.calendar)
        words = "" if self.calendar == "standard" else f" ({self.calendar} calendar)"
        return f"{date:%Y-%m-%d %H:%M:%S} UTC{words}"


class Time(NamedTuple):
    """The time of a layer."""

    value: float
    clock: Clock
    rounding: float = 0.0
    """Distance to the next number that the file can store."""


class Schedule(NamedTuple):
    """The steps of the layers of one fire."""

    steps: NDArray[np.float64]
    """The first step that shows each layer."""
    begin: str | None
    """The date of step 0, if the files have it."""


def schedule(
    names: list[str], times: list[Time | None], *, step: float, every: int, unit: str | None
) -> Schedule:
    """Computes the steps of layers, by their times if they have any, otherwise by their numbers.

    `step` is in seconds. `unit` is the unit of the times; None for the files' unit. Refuses layers
    that are not in order.
    """
    first = times[0]
    for name, time in zip(names, times, strict=True):
        _check_clock(name, time, names[0], first)
    in_layers = np.arange(len(times)) / every
    if first is None:
        if unit is not None:
            raise InvalidArgumentError(
                f"--unit: {names[0]} has no times, got --unit {unit}; leave the flag out"
            )
        return Schedule(steps_at(in_layers, 1.0), None)
    stated = [
        unit_of(time.clock, unit, name) for name, time in zip(names, times, strict=True) if time
    ]
    seconds = np.array(
        [
            time.value * SECONDS[each or "s"] + (time.clock.epoch() or 0.0 if each else 0.0)
            for time, each in zip(times, stated, strict=True)
            if time
        ]
    )
    begin = None if stated[0] is None else first.clock.date(first.value * SECONDS[stated[0]])
    _check_order(names, times, seconds, is_in_unit=stated[0] is not None)
    if stated[0] is None:
        return Schedule(steps_at(in_layers, 1.0), None)
    if every != 1:
        raise InvalidArgumentError(
            f"--every: applies only to layers without times, got --every {every}: {names[0]} has "
            "the time of each layer, and --step chooses among them"
        )
    rounding = max(time.rounding for time in times if time) * SECONDS[stated[0]]
    return Schedule(steps_at(seconds - seconds[0], step, rounding, names[0]), begin)


def length(text: str) -> float:
    """Parses a length of time such as `10 min` to seconds."""
    number, _, unit = text.strip().partition(" ")
    try:
        seconds = float(number) * SECONDS[_unit(unit)]
    except (KeyError, ValueError):
        seconds = 0.0
    if not 0.0 < seconds < math.inf:
        raise invalid("--step", "a number and s, min, h or d, such as '10 min'", f"'{text}'")
    return seconds


def steps_at(
    times: NDArray[np.floating[Any]], step: float, rounding: float = 0.0, name: str = ""
) -> NDArray[np.float64]:
    """Returns the first step at or after each time, from 0; infinite times stay infinite.

    `rounding` is the distance between numbers that the file `name` can store.
    """
    if rounding > _COARSE * step:
        raise invalid(
            name,
            f"times stored to a tenth of a --step, {_COARSE * step:.6g} s",
            f"floating-point numbers {rounding:.6g} s apart; store times in double precision, or "
            "count them from a later date",
        )
    with np.errstate(over="ignore"):
        steps = np.ceil(times / step - max(EVEN, rounding / step))
    if (np.isinf(steps) & np.isfinite(times)).any():
        raise InvalidArgumentError(
            f"--step: too short for times up to {times[np.isfinite(times)].max():.6g}, got "
            f"{step:.6g}"
        )
    return steps


def unit_of(clock: Clock, wanted: str | None, name: str) -> str | None:
    """Returns the unit of times from the flag or the file; refuses two different units."""
    in_file, words = clock.unit(), clock.words.strip()
    if "%" in words:
        raise invalid(name, "times in a unit, or 'day as %Y%m%d.%f'", f"'{words}'")
    if None not in (wanted, in_file) and wanted != in_file:
        raise invalid("--unit", f"{in_file}, as in {name}", wanted)
    if wanted is None and in_file is None and words not in ("", "1"):
        raise invalid(
            name, "times in days or smaller units", f"'{words}'; give the unit with --unit"
        )
    return wanted or in_file


def _check_clock(name: str, time: Time | None, first_name: str, first: Time | None) -> None:
    """Refuses a time that cannot be compared with the first layer's time."""
    clocks = [each and each.clock for each in (first, time)]
    if clocks[0] == clocks[1]:
        return
    both = [each for each in clocks if each and each.unit() and each.epoch() is not None]
    if len(both) < 2 or both[0].calendar != both[1].calendar:
        expected, got = (
            "no time" if each is None else f"times in '{each.words}' ({each.calendar})"
            for each in clocks
        )
        raise invalid(name, f"{expected} as in {first_name}", got)


def _check_order(
    names: list[str], times: list[Time | None], seconds: NDArray[np.float64], *, is_in_unit: bool
) -> None:
    """Refuses times that do not increase, or that are uneven and have no unit."""
    gaps = np.diff(seconds)
    for k, gap in enumerate(gaps.tolist(), start=1):
        if gap <= 0:
            before, got = (_shown(times[i], is_in_unit=is_in_unit) for i in (k - 1, k))
            raise invalid(names[k], f"a later time than {before}", got)
        if not is_in_unit and abs(gap - gaps[0]) > EVEN * gaps[0]:
            raise InvalidArgumentError(
                f"{names[k]}: expected times {gaps[0]:.6g} apart, like the first ones, got "
                f"{gap:.6g}; to allow this, give the unit of times with --unit"
            )


def _shown(time: Time | None, *, is_in_unit: bool) -> str:
    if time is None:
        return "none"
    unit = SECONDS[time.clock.unit() or "s"]
    return (time.clock.date(time.value * unit) if is_in_unit else None) or f"{time.value:.6g}"


def _unit(text: str) -> str:
    word = text.strip().lower()
    word = word if word in SECONDS else word.removesuffix("s")
    return _SPELLINGS.get(word, word)
