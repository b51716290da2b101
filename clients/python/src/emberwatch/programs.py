"""The programs that come with the package, and private ones started from Python."""

from __future__ import annotations

import atexit
import contextlib
import itertools
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import time
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Final, TypeVar

from emberwatch.errors import (
    EmberwatchError,
    LaunchError,
    NoServerError,
    RequestTimeoutError,
    ServerGoneError,
)

_Connection = TypeVar("_Connection")

#: How long a program may take until it answers, seconds.
_START_TIMEOUT: Final = 20.0

#: How long it may take to stop before it is killed, seconds.
_STOP_TIMEOUT: Final = 3.0

#: How long a program that says farewell may take to end, seconds.
_FAREWELL: Final = 3.0

_numbers = itertools.count()


def find(name: str) -> Path:
    """The path of `emberwatch-server` or `emberwatch-agent`.

    Looked for where pip installed this package's programs, then on the `PATH`.

    Raises:
        LaunchError: If it is nowhere.
    """
    places = [Path(sysconfig.get_path("scripts")), Path(sys.executable).parent]
    for place in places:
        if (place / name).is_file():
            return place / name
    on_path = shutil.which(name)
    if on_path is None:
        raise LaunchError(
            f"{name}: expected it in {places[0]} or on the PATH; install the package with pip "
            "(`pip install ./clients/python`), or attach to a running server with instance=..."
        )
    return Path(on_path)


def unused_instance() -> str:
    """An instance name that no other program in this process-id namespace uses."""
    return f"python-{os.getpid()}-{next(_numbers)}"


class Program:
    """A program of our own. It ends with `stop`, or with this process, however that ends."""

    def __init__(self, name: str, arguments: Sequence[str]) -> None:
        """Starts it with the arguments and `--exit-with` this process.

        Raises:
            LaunchError: If it cannot be started.
        """
        command = [str(find(name)), *arguments, "--exit-with", str(os.getpid())]
        environment = {"RUST_LOG": "warn"} | os.environ
        self._name = name
        self._owner = os.getpid()
        # Its own words, for the error if it ends at once. A file never fills up and blocks it.
        self._words: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        try:
            # A process group of its own: Ctrl-C is for Python, which then stops it. Not a session:
            # each has its own share of the cores, and between shares a wake-up waits longer.
            self._process = subprocess.Popen(
                command,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=self._words,
                stderr=self._words,
                process_group=0,
            )
        except OSError as error:
            self._words.close()
            raise LaunchError(f"start {command[0]}: {error.strerror}") from None
        _programs.add(self)

    def wait_for(
        self, connect: Callable[[], _Connection], timeout: float | None = None
    ) -> _Connection:
        """Connects to it, again and again until it answers, for 20 s unless told otherwise.

        Raises:
            LaunchError: If it ends first, with its own words, or does not answer in time.
        """
        timeout = _START_TIMEOUT if timeout is None else timeout
        deadline, pause = time.monotonic() + timeout, 0.002
        while True:
            try:
                return connect()
            except (NoServerError, ServerGoneError, RequestTimeoutError) as error:
                if self._process.poll() is not None:
                    code, words = self._process.returncode, self.words()
                    self.stop()
                    raise LaunchError(
                        f"{self._name} ended with code {code} before it answered: {words}"
                    ) from None
                if time.monotonic() > deadline:
                    self.stop()
                    raise LaunchError(
                        f"{self._name} did not answer within {timeout} s: {error}"
                    ) from None
                time.sleep(pause)
                pause = min(2 * pause, 0.03)
            except EmberwatchError:
                self.stop()
                raise

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def ended(self) -> tuple[int | None, str]:
        """Its exit code, waited for a moment, and its words; `None` if it runs still."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_FAREWELL)
        code = self._process.returncode
        return (None, "") if code is None else (code, self.words())

    def words(self) -> str:
        """What it wrote, such as warnings and errors."""
        self._words.seek(0)
        return self._words.read().decode(errors="replace").strip()

    def stop(self) -> None:
        """Stops it and waits for its end. Again is fine; in a forked child it does nothing."""
        if os.getpid() != self._owner or self._words.closed:
            return
        _programs.discard(self)
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(_STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._words.close()


_programs: weakref.WeakSet[Program] = weakref.WeakSet()


@atexit.register
def _stop_all() -> None:
    for program in list(_programs):
        program.stop()
