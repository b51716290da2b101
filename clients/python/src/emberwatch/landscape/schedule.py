"""In which step each layer shows first: by the files' times, or in their order."""

from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.dates import EVEN, SECONDS, Clock, Time, steps_at, unit_of


class Schedule:
    """The times of layers, one after the other."""

    def __init__(self, *, step: float, every: int, unit: str | None) -> None:
        """Before the first layer. `step`: in seconds; `unit`: None if the files say."""
        self._step, self._every, self._wanted = step, every, unit
        self._first_name, self._clock = "", None
        self._unit: str | None = None
        self._told = ""
        self._times = list[float]()
        self.begin: datetime | None = None
        """When step 0 is, if the files say."""

    def add(self, name: str, time: Time | None) -> None:
        """Refuses a layer that is not later than those before."""
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
        told = str(date or f"{time.value:.6g}")
        self._check_order(name, told)
        self._told = told

    def steps(self) -> tuple[NDArray[np.float64], int]:
        """The first step that shows each layer, and how many steps there are."""
        if self._unit is None:
            after, step = np.arange(len(self._times), dtype=np.float64), self._every
        else:
            after, step = np.array(self._times) - self._times[0], self._step
        steps = steps_at(after, step)
        return steps, int(steps[-1]) + 1

    def _check_flags(self) -> None:
        if self._unit is not None and self._every != 1:
            raise InvalidArgumentError(
                f"--every: expected none, as {self._first_name} tells the times of its layers and "
                f"--step chooses among them, got {self._every}"
            )
        if self._clock is None and self._wanted is not None:
            raise invalid("--unit", f"none, as {self._first_name} has no times", self._wanted)

    def _check_clock(self, name: str, clock: Clock | None) -> None:
        """Refuses times that cannot be compared with those of the first layer."""
        both = clock, self._clock
        if any(one is None or one.unit() is None or one.epoch() is None for one in both):
            first, got = (
                "no time" if one is None else f"times in '{one.words}' ({one.calendar})"
                for one in (self._clock, clock)
            )
            raise invalid(name, f"{first} as in {self._first_name}", got)

    def _check_order(self, name: str, told: str) -> None:
        if len(self._times) < 2:
            return
        step, first = self._times[-1] - self._times[-2], self._times[1] - self._times[0]
        if step <= 0:
            raise invalid(name, f"a later time than {self._told}", told)
        if self._unit is None and abs(step - first) > EVEN * first:
            raise InvalidArgumentError(
                f"{name}: expected steps of {first:.6g} in time, got {step:.6g}; --unit says what "
                "the times count"
            )
