"""A deadline for each test, and the end of what it opened."""

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

import pytest
from hypothesis import settings
from processes import at_the_end

# A busy machine is no bug: the deadline below is enough.
settings.register_profile("emberwatch", deadline=None)
settings.load_profile("emberwatch")

# A shell may start this with signals ignored, which children would inherit.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

# Programs that pip has installed next to Python.
os.environ["PATH"] += os.pathsep + str(Path(sys.executable).parent)

# Not the user's; here nothing can be kept.
os.environ["XDG_CACHE_HOME"] = "/dev/null"

# More threads would wait for each other in PyTorch's networks as small as those here.
os.environ.setdefault("OMP_NUM_THREADS", "1")

#: A whole test, seconds.
DEADLINE = 300


@pytest.fixture(autouse=True)
def deadline() -> Iterator[None]:
    """A test that hangs fails; what it opened is closed."""

    def late(_number: int, _frame: FrameType | None) -> None:
        raise TimeoutError(f"still running after {DEADLINE} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(DEADLINE)
    yield
    try:
        at_the_end.close()
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture(autouse=True)
def windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows open in memory."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("PYGAME_HIDE_SUPPORT_PROMPT", "1")
