"""Runs the real programs as child processes. Each test has its own instance."""

import itertools
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

#: Time limit, in seconds, for operations that should take much less.
PATIENCE = 180.0

#: A limit of steps per second that no agent reaches.
FAST = 1_000_000

_numbers = itertools.count()


def unused_instance() -> str:
    return f"page-{os.getpid()}-{next(_numbers)}"


class Program:
    """A running program, which is killed when the test ends."""

    def __init__(self, path: Path, arguments: list[str], instance: str = "") -> None:
        assert path.is_file(), f"expected {path}: cargo build --workspace"
        self.instance = instance
        environment = {"RUST_LOG": "error"} | os.environ
        self._process = subprocess.Popen(
            [str(path), *arguments],
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
            start_new_session=True,
        )
        self.pid = self._process.pid

    def line(self) -> str:
        """Returns the next line that the program prints."""
        late = threading.Timer(PATIENCE, self._process.kill)
        late.start()
        line = self._process.stdout.readline()
        late.cancel()
        assert line, "the program ended without a word"
        return line.strip()

    def interrupt(self) -> None:
        self._process.send_signal(signal.SIGINT)
        self.wait()

    def suspend(self) -> None:
        """Suspends the program, as if it hung."""
        self._process.send_signal(signal.SIGSTOP)

    def wait(self) -> int:
        return self._process.wait(PATIENCE)

    def kill(self) -> None:
        """Kills the program with a signal that it cannot handle, and waits until it has ended."""
        self._process.kill()
        self._process.wait(PATIENCE)
        self._process.stdout.close()


class Dashboard(Program):
    def __init__(self, path: Path, arguments: list[str], port: int) -> None:
        super().__init__(path, [*arguments, f"--listen=127.0.0.1:{port}"])
        self.url = self.line()
        self.port = int(self.url.rstrip("/").rpartition(":")[2])


class Programs:
    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder = folder
        self._stack = stack

    def server(self, instance: str | None = None, **settings: object) -> Program:
        """Starts a server, by default with a small world that has a short burn-in."""
        instance = instance or unused_instance()
        settings = {
            "height": 24,
            "width": 32,
            "moves": 24,
            "burn_in": 500,
            "exit_with": os.getpid(),
        } | settings
        return self._keep(
            Program(self._path("server"), flags({"instance": instance} | settings), instance)
        )

    def is_serving(self, instance: str) -> bool:
        command = [self._path("server"), "status", f"--instance={instance}"]
        return subprocess.run(command, capture_output=True, timeout=PATIENCE).returncode == 0

    def agent(self, instance: str, **settings: object) -> Program:
        """Starts an agent that acts on a world for `steps` steps, or until it is stopped.

        The agent leaves processor time to the browser: its plans are cheap, and its steps are slow.
        """
        eventually(lambda: self.is_serving(instance), "a server")
        pace = {} if "steps" in settings else {"steps_per_second": 10}
        cheap = {"instance": instance, "beam_width": 5, "prior": "initial"}
        settings = cheap | pace | settings
        return self._keep(Program(self._path("agent"), ["run", *flags(settings)]))

    def record(self, out: Path, *, steps: int, **settings: object) -> None:
        """Records `steps` steps of a server, with hidden states if it publishes them."""
        server = self.server(**settings)
        eventually(lambda: self.is_serving(server.instance), "a server")
        what = flags({"instance": server.instance, "out": out, "steps": steps})
        recorder = self._keep(Program(self._path("server"), ["record", "--truth", *what]))
        agent = self.agent(server.instance, steps_per_second=FAST)
        assert recorder.wait() == 0
        agent.interrupt()

    def dashboard(
        self,
        instance: str = "",
        *,
        recording: Path | None = None,
        port: int = 0,
        name: str | None = None,
    ):
        """Starts a dashboard for an instance or a recording. `name` is an additional host name."""
        source = {"recording": recording} if recording else {"instance": instance}
        arguments = flags(source | {"exit_with": os.getpid(), "name": name})
        return self._keep(Dashboard(self._path("dashboard"), arguments, port))

    def _path(self, name: str) -> Path:
        return self._folder / f"emberwatch-{name}"

    def _keep(self, program: Program):
        self._stack.callback(program.kill)
        return program


def flags(settings: dict[str, object]) -> list[str]:
    """Returns the settings that are not None as command-line flags."""
    given = {name: value for name, value in settings.items() if value is not None}
    pairs = [(f"--{name.replace('_', '-')}", value) for name, value in given.items()]
    return [name if value is True else f"{name}={value}" for name, value in pairs]


def eventually(holds: Callable[[], object], what: str, limit: float = PATIENCE) -> None:
    """Waits until a condition holds; fails if it does not hold in time."""
    end = time.monotonic() + limit
    while not holds():
        assert time.monotonic() < end, f"expected within {limit} s: {what}"
        time.sleep(0.02)
