"""The programs that come with the package: found, run, and started as private ones."""

import contextlib
import itertools
import os
import re
import secrets
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from types import FrameType
from typing import IO, Final, Protocol, TypeVar

from emberwatch.errors import (
    EmberwatchError,
    NoServerError,
    RequestTimeoutError,
    ServerGoneError,
)

_Connection = TypeVar("_Connection", bound="Introduced")

# Seconds that a program may take to answer, to stop before it is killed, and to end after it has
# said that it ends.
_START_TIMEOUT: Final = 20.0
_STOP_TIMEOUT: Final = 3.0
_EXIT_TIMEOUT: Final = 3.0

_numbers = itertools.count()


class _Described(Protocol):
    @property
    def pid(self) -> int: ...


class Introduced(Protocol):
    """A connection to a process that has said who it is."""

    @property
    def instance(self) -> str: ...

    @property
    def info(self) -> _Described: ...

    def close(self) -> None: ...


def find(name: str) -> Path:
    """The path of a program: where pip installed this package's programs, or on the `PATH`."""
    places = [Path(sysconfig.get_path("scripts")), Path(sys.executable).parent]
    for place in places:
        if (place / name).is_file():
            return place / name
    on_path = shutil.which(name)
    if on_path is None:
        raise EmberwatchError(
            f"{name}: expected it in {places[0]} or on the PATH; install the package with pip "
            "(`pip install ./clients/python`), or attach to a running server with instance=...",
            "program",
        )
    return Path(on_path)


def unused_instance() -> str:
    """An instance name that no other program uses."""
    # A process of this number may have one in another container that shares /dev/shm.
    return f"python-{os.getpid()}-{next(_numbers)}-{secrets.token_hex(8)}"


def _not_started(command: Sequence[str], error: OSError) -> EmberwatchError:
    return EmberwatchError(f"start {command[0]}: {error.strerror}", "program")


def _nameless_file() -> IO[bytes]:
    """A file that ends with this process; in memory where no folder can be written to."""
    try:
        return tempfile.TemporaryFile()  # noqa: SIM115
    except OSError:
        return os.fdopen(os.memfd_create("output"), "w+b")


def _cleaned(text: str) -> str:
    """A program's messages without times, levels and the hint at its flags."""
    text = re.sub(r"(?m)^\S+Z +[A-Z]+ |^error: ", "", text)
    return text.partition("\n\nFor more information")[0].strip()


@contextlib.contextmanager
def _ctrl_c_later() -> Generator[None]:
    """Postpones Ctrl-C to its end. A blocked signal would stay blocked in a program's process."""
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        yield
        return
    pressed: list[FrameType | None] = []
    signal.signal(signal.SIGINT, lambda _, frame: pressed.append(frame))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if pressed:
            handler(signal.SIGINT, pressed[0])


class Program:
    """A program of our own.

    It ends with `stop`, when it is forgotten, or with this process, however that ends.
    """

    def __init__(self, name: str, arguments: Sequence[str]) -> None:
        command = [str(find(name)), *arguments, "--exit-with", str(os.getpid())]
        self._name = name
        self._owner = os.getpid()
        stop = None
        try:
            with _ctrl_c_later():
                # For the error if it ends at once. A file, unlike a pipe, never fills up.
                self._output = _nameless_file()
                self._process = self._start(command)
                # For programs that nobody stops, such as that of a forgotten environment.
                stop = weakref.finalize(self, _stop, self._process, self._output, self._owner)
        except BaseException:
            if stop is not None:
                stop()
            raise

    def _start(self, command: Sequence[str]) -> subprocess.Popen[bytes]:
        try:
            # A process group of its own: Ctrl-C is for Python, which then stops it. Not a session:
            # each has its own share of the cores, and between shares a wake-up waits longer.
            return subprocess.Popen(
                command,
                env={"RUST_LOG": "warn"} | os.environ,
                stdin=subprocess.DEVNULL,
                stdout=self._output,
                stderr=self._output,
                process_group=0,
            )
        except OSError as error:
            self._output.close()
            raise _not_started(command, error) from None

    def wait_for(
        self, connect: Callable[[], _Connection], timeout: float | None = None
    ) -> _Connection:
        """Tries to connect until it answers, for 20 s unless `timeout` says otherwise."""
        timeout = _START_TIMEOUT if timeout is None else timeout
        deadline, pause = time.monotonic() + timeout, 0.002
        while True:
            try:
                return self._own(connect())
            except (NoServerError, ServerGoneError, RequestTimeoutError) as error:
                problem = None
                if self._process.poll() is not None:
                    code = self._process.returncode
                    problem = f"ended with code {code} before it answered: {self.output()}"
                elif time.monotonic() > deadline:
                    problem = f"did not answer within {timeout} s: {error}"
                if problem is not None:
                    self.stop()
                    raise EmberwatchError(f"{self._name} {problem}", "program") from None
                time.sleep(pause)
                pause = min(2 * pause, 0.03)
            except EmberwatchError:
                self.stop()
                raise

    def _own(self, connection: _Connection) -> _Connection:
        """A connection, if it is to this program."""
        if connection.info.pid == self.pid:
            return connection
        connection.close()
        who = f"{self._name} as pid {self.pid}, which was started"
        raise EmberwatchError(
            f"instance {connection.instance!r}: expected {who}, got pid {connection.info.pid}",
            "program",
        )

    @property
    def pid(self) -> int:
        return self._process.pid

    def exit_code(self) -> int | None:
        """Its exit code, waited for a moment; `None` if it still runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_EXIT_TIMEOUT)
        return self._process.returncode

    def has_ended(self) -> bool:
        """Whether it runs no more."""
        return self._process.poll() is not None

    def output(self) -> str:
        """What it wrote, such as warnings and errors."""
        self._output.seek(0)
        return _cleaned(self._output.read().decode(errors="replace"))

    def stop(self) -> None:
        """Stops it and waits for its end, if it still runs; does nothing in a forked child."""
        _stop(self._process, self._output, self._owner)


def _stop(process: subprocess.Popen[bytes], output: IO[bytes], owner: int) -> None:
    if os.getpid() != owner or output.closed:
        return
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(_STOP_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    output.close()
