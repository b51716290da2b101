"""Times in files, such as `hours since 2020-08-01`, and the step that first shows each layer."""

import math
import string
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.libraries import library

SECONDS: Final = {
    "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9
}  # fmt: skip
"""The length of each unit in seconds."""
SINCE_1970: Final = "seconds since 1970-01-01"

_EVEN: Final = 1e-3  # tolerance for times, share of a step, because decimal fractions are rounded
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
        except (OverflowError, TypeError, ValueError):  # not a day of the calendar
            return None

    def date(self, seconds: float) -> str | None:
        """Returns the date `seconds` after time 0; None if it is unknown, or beyond all dates."""
        epoch = self.epoch()
        if epoch is None:
            return None
        try:
            date = library("cftime", "times").num2date(epoch + seconds, SINCE_1970, self.calendar)
        except OverflowError:
            return None
        words = "" if self.calendar == "standard" else f" ({self.calendar} calendar)"
        return f"{date:%Y-%m-%d %H:%M:%S} UTC{words}"


class Time(NamedTuple):
    """The time of a layer."""

    name: str
    """The layer, for errors."""
    value: float
    clock: Clock
    rounding: float = 0.0
    """Distance to the next number that the file can store."""


class Schedule(NamedTuple):
    """The first step that shows each layer, and the date of step 0 if the files have it."""

    steps: NDArray[np.float64]
    begin: str | None = None


def schedule(
    names: list[str], times: list[Time], *, step: float, every: int, unit: str | None
) -> Schedule:
    """Computes the steps of layers, whose times must increase.

    `step` is in seconds. `unit` is the unit of the times; None for the files' unit. Layers without
    a unit of times are evenly spaced, and make a step of `every` layers, which shows the last.
    """
    without = Schedule(steps_at(np.arange(len(names)), every))
    if not times and unit is None:
        return without
    if len(times) < len(names):
        untimed = next(name for name in names if name not in {time.name for time in times})
        got = f"none, unlike {times[0].name}" if times else f"none; leave out --unit {unit}"
        raise invalid(untimed, "the time of the layer", got)
    first = times[0]
    for time in times:
        _check_clock(time.name, time.clock, first.name, first.clock)
    units = [unit_of(time.clock, unit, time.name) for time in times]
    has_unit = units[0] is not None
    lengths = [SECONDS[each or "s"] for each in units]
    after = [time.value * length for time, length in zip(times, lengths, strict=True)]
    seconds = np.array(after) + [time.clock.epoch() or 0.0 for time in times]
    gaps: list[float] = np.diff(seconds).tolist()
    for k, gap in enumerate(gaps, start=1):
        if gap <= 0:
            before, got = (
                times[i].clock.date(after[i]) or f"{times[i].value:.6g}" for i in (k - 1, k)
            )
            raise invalid(times[k].name, f"a later time than {before}", got)
        if not has_unit and abs(gap - gaps[0]) > _EVEN * gaps[0]:
            got = f"{gap:.6g}; to allow this, give the unit of times with --unit"
            expected = f"times {gaps[0]:.6g} apart, like the first ones"
            raise invalid(times[k].name, expected, got)
    if not has_unit:
        return without
    if every != 1:
        got = f"{every}: {first.name} has times, and --step chooses among them"
        raise invalid("--every", "only with layers without times", got)
    rounding = max(time.rounding for time in times) * lengths[0]
    steps = steps_at(seconds - seconds[0], step, rounding, first.name)
    return Schedule(steps, first.clock.date(after[0]))


def length(text: str) -> float:
    """Parses a length of time such as `10 min` to seconds."""
    number = text.rstrip(string.ascii_letters + " ")
    try:
        seconds = float(number) * SECONDS[_unit(text[len(number) :])]
    except (KeyError, ValueError):
        seconds = 0.0
    if not 0.0 < seconds < math.inf:
        raise invalid("--step", "a number and s, min, h or d, such as '10 min'", f"'{text}'")
    return seconds


def steps_at(
    times: NDArray[Any], step: float, rounding: float = 0.0, name: str = ""
) -> NDArray[np.float64]:
    """Returns the first step at or after each time, from 0; infinite times stay infinite.

    `rounding` is the distance between numbers that the file `name` can store.
    """
    if rounding > _COARSE * step:
        expected = f"times stored to a tenth of a --step, {_COARSE * step:.6g}"
        remedy = "store times in double precision, or count them from a later date"
        raise invalid(name, expected, f"floating-point numbers {rounding:.6g} apart; {remedy}")
    with np.errstate(over="ignore"):
        steps = np.ceil(times / step - max(_EVEN, rounding / step))
    if (np.isinf(steps) & np.isfinite(times)).any():
        most = times[np.isfinite(times)].max()
        raise InvalidArgumentError(f"--step: too short for times up to {most:.6g}, got {step:.6g}")
    return steps


def unit_of(clock: Clock, wanted: str | None, name: str) -> str | None:
    """Returns the unit of times from the flag or the file; refuses two different units."""
    in_file, words = clock.unit(), clock.words.strip()
    if "%" in words:
        raise invalid(name, "times in a unit, or 'day as %Y%m%d.%f'", f"'{words}'")
    if None not in (wanted, in_file) and wanted != in_file:
        raise invalid("--unit", f"{in_file}, as in {name}", wanted)
    if wanted is None and in_file is None and words not in ("", "1"):
        got = f"'{words}'; give the unit with --unit"
        raise invalid(name, "times in days or smaller units", got)
    return wanted or in_file


def _check_clock(name: str, clock: Clock, first_name: str, first: Clock) -> None:
    """Refuses times that cannot be compared with the first layer's time."""
    dated = [each for each in (clock, first) if each.unit() and each.epoch() is not None]
    if clock != first and (len(dated) < 2 or clock.calendar != first.calendar):
        expected, got = (f"times in '{each.words}' ({each.calendar})" for each in (first, clock))
        raise invalid(name, f"{expected} as in {first_name}", got)


def _unit(text: str) -> str:
    word = text.strip().lower()
    word = word if word in SECONDS else word.removesuffix("s")
    return _SPELLINGS.get(word, word)
