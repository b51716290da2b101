"""Servers and scripts as child processes, each on its own instance and with a deadline."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from emberwatch.client.client import Client, connect
from emberwatch.client.replies import ServerStatus
from emberwatch.errors import EmberwatchError, NoServerError

#: Maximum time, in seconds, of operations that should take milliseconds.
PATIENCE = 20.0

#: Timeout, in seconds, of a wait that should end for another reason.
LONG = 5 * PATIENCE

#: A small, quick server: 5 x 7 cells, 6 moves, 20 steps of burn-in.
SMALL = {"height": 5, "width": 7, "moves": 6, "burn_in": 20}

#: Where iceoryx2 keeps the files of nodes and services.
CHANNELS = Path(f"/dev/shm/emberwatch-{os.getuid()}")

#: Closes the resources of a test, last opened first; `conftest.py` calls it.
at_the_end = ExitStack()


def find(name: str) -> str:
    path = shutil.which(name)
    assert path is not None, f"expected {name} on the PATH"
    return path


def unused_instance() -> str:
    return f"test-{secrets.token_hex(8)}"


class Program:
    """One of our programs in a child process, which never outlives this process."""

    def __init__(self, name: str, *arguments: str) -> None:
        self._output = tempfile.TemporaryFile()
        self.process = subprocess.Popen(
            [find(name), *arguments, f"--exit-with={os.getpid()}"],
            env={"RUST_LOG": "warn"} | os.environ,
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=self._output,
            process_group=0,
        )
        self.pid = self.process.pid

    def output(self) -> str:
        """Returns everything that the program has printed, without times and levels."""
        self._output.seek(0)
        return re.sub(r"(?m)^\S+Z +[A-Z]+ ", "", self._output.read().decode()).strip()

    def ended(self) -> str:
        """Waits until the program ends by itself. Returns its output."""
        self.process.wait(PATIENCE)
        return self.output()

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait(PATIENCE)
        self._output.close()


def server(instance: str | None = None, *, ready: bool = True, **flags: object) -> Server:
    """Starts a small server that ends with the test, as in `server(worlds=3)`."""
    return at_the_end.enter_context(closing(Server(instance, ready=ready, **SMALL | flags)))


def script(code: str, *arguments: object) -> Script:
    return at_the_end.enter_context(closing(Script(code, *arguments)))


class Server:
    """A running server and the connections to it."""

    def __init__(self, instance: str | None = None, *, ready: bool = True, **flags: object) -> None:
        """Waits until the server answers and its worlds are ready. Omits flags that are None."""
        self.instance = instance or unused_instance()
        arguments: list[str] = []
        for name, value in {"instance": self.instance, **flags}.items():
            if value is not None:
                word = str(value).lower() if isinstance(value, bool) else value
                arguments.append(f"--{name.replace('_', '-')}={word}")
        self.program = Program("emberwatch-server", *arguments)
        self._held = ExitStack()
        self._held.callback(self.program.stop)
        try:
            try:
                self._client = connect(self.instance, timeout=PATIENCE, wait=PATIENCE)
            except NoServerError as error:
                raise AssertionError(f"{error}: {self.program.output()}") from None
            self._held.enter_context(self._client)
            self._held.callback(self._shut_down)
            self._held.callback(self.wake_up)
            worlds = lambda: self.status().worlds  # noqa: E731
            assert not ready or eventually(lambda: not any(it.resetting for it in worlds()))
        except BaseException:
            self.close()
            raise

    def _shut_down(self) -> None:
        """Asks the server to stop. This is quicker than a signal, which the server notices late."""
        with suppress(EmberwatchError):
            self._client.shutdown(timeout=1.0)

    def connect(self) -> Client:
        return self._held.enter_context(Client(self.instance))

    def status(self) -> ServerStatus:
        return self._client.status(timeout=PATIENCE)

    def signal(self, number: int) -> None:
        os.kill(self.program.pid, number)

    def stop(self) -> None:
        self.signal(signal.SIGSTOP)
        assert eventually(lambda: _state(self.program.pid) == "T")

    def wake_up(self) -> None:
        """Continues a stopped server, if it is still alive."""
        if self.program.process.poll() is None:
            self.signal(signal.SIGCONT)

    def kill(self) -> None:
        self.signal(signal.SIGKILL)
        self.program.process.wait(PATIENCE)

    def close(self) -> None:
        self._held.close()


class Script:
    """A Python process that runs some code, and is killed at the end of the test."""

    def __init__(self, code: str, *arguments: object) -> None:
        """Starts the process, with the arguments in `sys.argv[1:]`."""
        self._process = subprocess.Popen(
            [sys.executable, "-c", code, *map(str, arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self.pid = self._process.pid

    def line(self) -> str:
        """Returns the next line that the process prints."""
        late = threading.Timer(3 * PATIENCE, self._process.kill)
        late.start()
        line = self._process.stdout.readline()
        late.cancel()
        assert line, self._process.stderr.read()
        return line.strip()

    def say(self, text: str = "") -> None:
        self._process.stdin.write(f"{text}\n")
        self._process.stdin.flush()

    def signal(self, number: int) -> None:
        os.killpg(self.pid, number)

    def end(self) -> tuple[int, str, str]:
        """Waits for the end. Returns the exit code and the rest of the output."""
        out, err = self._process.communicate(timeout=3 * PATIENCE)
        return self._process.returncode, out, err

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


#: A function that runs a command and returns its completed process.
Run = Callable[..., subprocess.CompletedProcess[str]]


def isolated(options: str, *, pids: bool = False) -> Run:
    """Runs commands with a private `/dev/shm`; skips the test if mounts are not allowed."""
    unshare = ["unshare", "-m", *([] if os.getuid() == 0 else ["-r"]), "sh", "-c"]

    def run(*command: str) -> subprocess.CompletedProcess[str]:
        shell = f'mount -t tmpfs -o {options} tmpfs /dev/shm && exec "$@"'
        words = [*unshare, shell, "sh", *command]
        return subprocess.run(words, capture_output=True, text=True, timeout=120)

    trial = ["unshare", "-p", "-f", "--mount-proc", "true"] if pids else ["true"]
    if shutil.which("unshare") is None or run(*trial).returncode != 0:
        pytest.skip("needs its own namespaces: `unshare` is not permitted here")
    return run


def eventually(holds: Callable[[], bool], limit: float = PATIENCE) -> bool:
    """Checks a condition every millisecond. Returns whether it held in time."""
    end = time.monotonic() + limit
    while not holds():
        if time.monotonic() > end:
            return False
        time.sleep(0.001)
    return True


def _state(pid: int) -> str:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return ""


def asleep(thread: threading.Thread | int | None = None) -> None:
    """Waits until a thread or process (default: the main thread) sleeps, so it is waiting."""
    thread = thread or threading.main_thread()
    number = thread if isinstance(thread, int) else thread.native_id
    place = Path(f"/proc/{number}/task/{number}/stat")
    looks = 0

    def is_asleep() -> bool:
        nonlocal looks
        sleeps = place.read_text().rpartition(")")[2].split()[0] == "S"
        looks = looks + 1 if sleeps else 0
        return looks > 20

    assert eventually(is_asleep)


@contextmanager
def ctrl_c(wait: Callable[[], object] = asleep) -> Iterator[pytest.ExceptionInfo[BaseException]]:
    """Sends Ctrl-C to the main thread inside this context, once `wait` has returned."""

    def interrupt() -> None:
        # If this fails, no Ctrl-C is sent, and the main thread's timeout fails the test.
        assert wait() is not False
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    with pytest.raises(KeyboardInterrupt) as raised:
        thread.start()
        yield raised
    thread.join()


def services(instance: str) -> list[Path]:
    found = []
    for path in (CHANNELS / "services").iterdir():
        with suppress(FileNotFoundError):  # removed by a program that ends now
            if f"/{instance}/" in path.read_text(errors="replace"):
                found.append(path)
    return found


def at_once(*calls: Callable[[], Any]) -> list[Any]:
    """Runs calls that wait for each other, each on its own thread. Returns their results."""
    results: list[Any] = [None] * len(calls)

    def run(index: int) -> None:
        results[index] = calls[index]()

    threads = [threading.Thread(target=run, args=(index,)) for index in range(len(calls))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return results
