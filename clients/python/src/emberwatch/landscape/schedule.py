"""Times in files, such as `hours since 2020-08-01`, and the step that first shows each layer."""

import math
import re
from datetime import UTC, datetime, timedelta, timezone
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid

SECONDS: Final = {
    "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9
}  # fmt: skip
"""The length of each unit in seconds."""
EVEN: Final = 1e-3
"""Tolerance for times, as a share of a step, because 32-bit numbers are rounded."""

_SPELLINGS: Final = {
    "sec": "s", "second": "s", "minute": "min", "hr": "h", "hour": "h", "day": "d",
    "msec": "ms", "millisecond": "ms", "microsecond": "us", "nanosecond": "ns",
}  # fmt: skip
#: Calendars whose dates are Gregorian from the year `_GREGORIAN` on.
_CALENDARS: Final = ("standard", "gregorian", "proleptic_gregorian")
_GREGORIAN: Final = 1583  # the first year in which these calendars agree
_DATE: Final = re.compile(
    r"(\d{4})-(\d{1,2})-(\d{1,2})(?:[T ]+(\d{1,2})(?::(\d{1,2}))?(?::(\d{1,2})(?:\.\d*)?)?)?"
    r"\s*(?:Z|UTC|GMT|([+-])(\d{1,2})(?::?(\d{2}))?)?"
)


class Clock(NamedTuple):
    """The unit and origin of times, as the file writes them."""

    words: str = ""
    calendar: str = "standard"

    def unit(self) -> str | None:
        """Returns the unit, a key of `SECONDS`; None if the file does not state it."""
        unit = _unit(self.words.partition(" since ")[0])
        return unit if unit in SECONDS else None

    def date(self, seconds: float) -> datetime | None:
        """Returns the date `seconds` after time 0; None if the date of time 0 is unknown."""
        epoch = self.epoch()
        try:
            return None if epoch is None else epoch + timedelta(seconds=seconds)
        except OverflowError:  # beyond the year 9999
            return None

    def epoch(self) -> datetime | None:
        """Returns the date of time 0; None if it is missing or in another calendar."""
        parts = _DATE.fullmatch(self.words.partition(" since ")[2].strip())
        if parts is None or self.calendar.lower() not in _CALENDARS:
            return None
        *digits, sign, hours, minutes = parts.groups(default="0")
        numbers = [int(part) for part in digits]
        if numbers[0] < _GREGORIAN:
            return None
        try:
            ahead = timedelta(hours=int(hours), minutes=int(minutes))
            zone = timezone(-ahead if sign == "-" else ahead)
            return datetime(*numbers, tzinfo=zone).astimezone(UTC)
        except (OverflowError, ValueError):  # not a day, or outside the years 1 to 9999
            return None


class Time(NamedTuple):
    """The time of a layer."""

    value: float
    clock: Clock


class Schedule:
    """The times of the layers of one fire, in order."""

    def __init__(self, *, step: float, every: int, unit: str | None) -> None:
        """Starts without layers. `step` is in seconds; `unit` is the unit, None for the file's."""
        self._step, self._every, self._wanted = step, every, unit
        self._first_name, self._clock = "", None
        self._unit: str | None = None
        self._last_time = ""
        self._times = list[float]()
        self.begin: datetime | None = None
        """The date of step 0, if the files have it."""

    def add(self, name: str, time: Time | None) -> None:
        """Adds a layer; refuses one that is not later than the previous layers."""
        unit = None if time is None else unit_of(time.clock, self._wanted, name)
        clock = None if time is None else time.clock
        if not self._times:
            self._first_name, self._clock, self._unit = name, clock, unit
            self._check_flags()
        elif clock != self._clock:
            self._check_clock(name, clock)
        if time is None:
            self._times.append(len(self._times))
            return
        seconds = time.value * SECONDS.get(unit or "", 1.0)
        date = None if unit is None else time.clock.date(seconds)
        self._times.append(seconds if date is None else date.timestamp())
        if len(self._times) == 1:
            self.begin = date
        shown_time = str(date or f"{time.value:.6g}")
        self._check_order(name, shown_time)
        self._last_time = shown_time

    def steps(self) -> tuple[NDArray[np.float64], int]:
        """Returns the first step that shows each layer, and the number of steps."""
        if self._unit is None:
            after, step = np.arange(len(self._times), dtype=np.float64), self._every
        else:
            after, step = np.array(self._times) - self._times[0], self._step
        steps = steps_at(after, step)
        return steps, int(steps[-1]) + 1

    def _check_flags(self) -> None:
        if self._unit is not None and self._every != 1:
            raise InvalidArgumentError(
                f"--every: applies only to layers without times, got --every {self._every}: "
                f"{self._first_name} has the time of each layer, and --step chooses among them"
            )
        if self._clock is None and self._wanted is not None:
            raise InvalidArgumentError(
                f"--unit: {self._first_name} has no times, got --unit {self._wanted}; leave the "
                "flag out"
            )

    def _check_clock(self, name: str, clock: Clock | None) -> None:
        """Refuses times that cannot be compared with the first layer's time."""
        both = clock, self._clock
        if any(one is None or one.unit() is None or one.epoch() is None for one in both):
            first, got = (
                "no time" if one is None else f"times in '{one.words}' ({one.calendar})"
                for one in (self._clock, clock)
            )
            raise invalid(name, f"{first} as in {self._first_name}", got)

    def _check_order(self, name: str, shown_time: str) -> None:
        if len(self._times) < 2:
            return
        step, first = self._times[-1] - self._times[-2], self._times[1] - self._times[0]
        if step <= 0:
            raise invalid(name, f"a later time than {self._last_time}", shown_time)
        if self._unit is None and abs(step - first) > EVEN * first:
            raise InvalidArgumentError(
                f"{name}: expected times {first:.6g} apart, like the first ones, got {step:.6g}; "
                "to allow this, give the unit of times with --unit"
            )


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


def steps_at(times: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Returns the first step at or after each time, from 0; infinite times stay infinite."""
    with np.errstate(over="ignore"):
        steps = np.ceil(times / step - EVEN)
    if (np.isinf(steps) & np.isfinite(times)).any():
        raise InvalidArgumentError(
            f"--step: too short for times up to {times[np.isfinite(times)].max():.6g}, got "
            f"{step:.6g}"
        )
    return steps


def unit_of(clock: Clock, wanted: str | None, name: str) -> str | None:
    """Returns the unit of times from the flag or the file; refuses two different units."""
    in_file = clock.unit()
    if None not in (wanted, in_file) and wanted != in_file:
        raise invalid("--unit", f"{in_file}, as in {name}", wanted)
    if wanted is None and in_file is None and clock.words.strip() not in ("", "1"):
        got = f"'{clock.words}'; give the unit with --unit"
        raise invalid(name, "times in days or smaller units", got)
    return wanted or in_file


def _unit(text: str) -> str:
    word = text.strip().lower()
    word = word if word in SECONDS else word.removesuffix("s")
    return _SPELLINGS.get(word, word)
