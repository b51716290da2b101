"""Decides when a wait spins, from how earlier waits ended (PROTOCOL.md section 8). Pure."""

from typing import Final

#: How long to poll before sleeping, seconds: longer than the wake-up of a process that answers at
#: once, so that two that sleep find out that spinning pays.
SPIN: Final = 100e-6

#: Time between two polls that shows that a busy process had the core, seconds.
LOST_CORE: Final = 1e-3

#: After this many waits in a row that were longer than the spin, spinning does not pay.
FAILED_SPINS: Final = 3

#: How long to sleep at once then, before one wait tries again, seconds.
PAUSE: Final = 0.1


class Spinning:
    """Decides for one process's waits, one after the other."""

    def __init__(self) -> None:
        """Before the first wait; instants are seconds of any one clock."""
        self._spins = False
        self._end = self._last = self._not_before = float("-inf")
        self._n_failed = 0

    def begin(self, now: float) -> None:
        self._spins = now >= self._not_before
        self._end = now + SPIN
        self._last = now

    def goes_on(self, now: float) -> bool:
        """Nothing has arrived yet: whether to poll again at once. If not, sleep."""
        if not self._spins:
            return False
        lost_core = now - self._last > LOST_CORE
        if now < self._end and not lost_core:
            self._last = now
            return True
        self._spins = False
        self._n_failed += 1
        if lost_core or self._n_failed >= FAILED_SPINS:
            self._n_failed = FAILED_SPINS
            self._not_before = now + PAUSE
        return False

    def arrived(self) -> None:
        """The wait is over: something has arrived."""
        if self._spins:
            self._n_failed = 0
