"""A lock that forked children can use."""

import os
import threading
from typing import Any
from weakref import WeakSet


class ForkLock:
    """A reentrant lock that is free in each forked child, and in each copy."""

    def __init__(self) -> None:
        """Makes a free lock."""
        #: The lock of this process, for `with` statements.
        self.lock = threading.RLock()
        _all.add(self)

    def __reduce__(self) -> tuple[Any, ...]:
        """Makes copies free, so that they do not wait for threads of the original."""
        return ForkLock, ()


_all = WeakSet[ForkLock]()


def _free_all() -> None:
    """Replaces all locks, as their holders may be threads that do not exist in a forked child."""
    for each in list(_all):
        each.lock = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_free_all)
