"""A deadline for each test; servers and scripts that end with it."""

import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from types import FrameType

import pytest
from environments import at_the_end
from hypothesis import settings
from processes import SMALL, Script, Server

from emberwatch.programs import unused_instance

# A busy machine is no bug: the deadline below is enough.
settings.register_profile("emberwatch", deadline=None)
settings.load_profile("emberwatch")

# A shell may start this with signals ignored, which children would inherit.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

#: A whole test, seconds.
DEADLINE = 300


@pytest.fixture(autouse=True)
def deadline() -> Iterator[None]:
    """A test that hangs fails."""

    def late(_number: int, _frame: FrameType | None) -> None:
        raise TimeoutError(f"still running after {DEADLINE} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(DEADLINE)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(autouse=True)
def environments(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Windows open in memory; environments are closed when a test ends."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    yield
    at_the_end.close()


@pytest.fixture
def server() -> Iterator[Callable[..., Server]]:
    """Starts a small server, `server(worlds=3, coverage="client")`, that ends with the test."""
    with ExitStack() as stack:

        def start(instance: str | None = None, *, ready: bool = True, **settings: object) -> Server:
            started = Server(instance or unused_instance(), SMALL | settings, ready=ready)
            stack.callback(started.close)
            return started

        yield start


@pytest.fixture
def script() -> Iterator[Callable[..., Script]]:
    """Runs Python code in a process of its own, `script(code, argument)`."""
    with ExitStack() as stack:

        def start(code: str, *arguments: object) -> Script:
            started = Script(code, *arguments)
            stack.callback(started.close)
            return started

        yield start
