"""A lock that forked children can use."""

import os
import threading
from typing import Any

#: Number of forks between the first process and this one.
_n_forks = 0
#: Held by a thread of a forked child while it replaces a lock.
_replacing = threading.Lock()


def _count_fork() -> None:
    global _n_forks, _replacing
    _n_forks, _replacing = _n_forks + 1, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_count_fork)


class ForkLock:
    """A reentrant lock that is free in each forked child, and in each copy."""

    def __init__(self) -> None:
        """Makes a free lock."""
        self._made_after, self._lock = _n_forks, threading.RLock()

    @property
    def lock(self) -> threading.RLock:
        """The lock of this process, for `with` statements."""
        if self._made_after != _n_forks:
            with _replacing:
                if self._made_after != _n_forks:
                    # The lock's holder may be a thread that does not exist in a forked child.
                    self._lock, self._made_after = threading.RLock(), _n_forks
        return self._lock

    def __reduce__(self) -> tuple[Any, ...]:
        """Makes copies free, so that they do not wait for threads of the original."""
        return ForkLock, ()
