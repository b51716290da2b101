"""Gives each test a deadline, and closes what the test opened."""

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

import pytest
from processes import at_the_end

# A shell may start pytest with signals ignored, and children would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

# Finds programs that pip installed next to Python.
os.environ["PATH"] += os.pathsep + str(Path(sys.executable).parent)

# Replaces the user's cache folder with one that cannot be written to.
os.environ["XDG_CACHE_HOME"] = "/dev/null"

# PyTorch's networks are so small here that more threads would only wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")

#: Deadline of a whole test, in seconds.
DEADLINE = 300


@pytest.fixture(autouse=True)
def deadline() -> Iterator[None]:
    """Fails a test that hangs, and closes what the test opened."""

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
    """Opens windows in memory instead of on a screen."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("PYGAME_HIDE_SUPPORT_PROMPT", "1")
