"""Containers: a `/dev/shm` that fills up, is small, or allows few files.

Each test runs in its own mount namespace, and is skipped where none can be made.
"""

import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from failures import fails
from processes import isolated, server

#: Runs Python code, followed by its arguments, in a mount namespace with a private `/dev/shm`.
Run = Callable[..., subprocess.CompletedProcess[str]]

#: Prints an error's code and message.
HEAD = f"""
import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})
import os, subprocess, time
import emberwatch
from emberwatch.errors import EmberwatchError
from processes import Program, find
"""
HEAD += """
def start(*flags):
    server = Program("emberwatch-server", "--instance=lab", *flags)
    return server, emberwatch.connect("lab", wait=20)
def fill(left=0):
    with open("/dev/shm/filler", "wb") as file:
        while True:
            found = os.statvfs("/dev/shm")
            try: return os.posix_fallocate(file.fileno(), 0, found.f_bavail * found.f_frsize - left)
            except OSError: time.sleep(0.01)  # A program took a page in between.
def tell(what, call):
    try: print(what, call(), flush=True)
    except EmberwatchError as error: print(what, error.code, error, flush=True)
"""


@pytest.fixture
def apart() -> Run:
    def python(code: str, options: str = "size=64m") -> subprocess.CompletedProcess[str]:
        run = isolated(options, pids=True)
        return run(sys.executable, "-W", "ignore", "-c", HEAD + code)

    return python


def test_full_shared_memory_does_not_end_an_observed_server(apart: Run) -> None:
    code = """
server, client = start("--worlds=8", "--publish-truth=true", "--burn-in=5")
lease = client.acquire(0, 8)
others = [emberwatch.connect("lab") for _ in range(4)]
observers = [emberwatch.observe("lab", timeout=5) for _ in range(3)]
truth = emberwatch.TruthReader("lab")
fill()
for _ in range(300): lease.step([[1] * 64] * 8)
for observer in observers: print(next(iter(observer)).world in range(8))
for other in others: print(other.observe(0, 8).first_robot, len(other.status().worlds))
tell("belief", lambda: lease.leave_belief(client.observe(0, 1).result(), "x", bytes(300000)))
print(lease.reset(range(8))[0].step, server.pid == client.status().pid)
"""
    ended = apart(code)
    assert ended.returncode == 0, ended
    lines = ended.stdout.splitlines()
    assert lines[:3] == ["True"] * 3, ended
    assert lines[3:7] == ["0 8"] * 4, ended
    assert lines[7].startswith("belief channel shared memory: expected"), ended
    assert lines[8:] == ["0 True"], ended


def test_an_observer_may_join_when_shared_memory_is_full(apart: Run) -> None:
    code = """
server, client = start("--height=200", "--width=200", "--burn-in=0", "--moves=6")
lease = client.acquire()
fill(600 * 1024)
observer = emberwatch.observe("lab", timeout=1)
for _ in range(200): lease.step([1] * 6)
print(client.status().n_steps, "expected" in server.output() and "free" in server.output())
os.unlink("/dev/shm/filler")
lease.step([1] * 6)
print(next(iter(observer)).result.step)
"""
    ended = apart(code, "size=80m")
    assert (ended.returncode, ended.stdout) == (0, "200 True\n201\n"), ended


def test_an_answer_without_memory_is_refused(apart: Run) -> None:
    code = """
small = ("--height=5", "--width=5", "--moves=4", "--burn-in=0")
server, client = start("--worlds=256", "--robots=8", *small)
fill()
tell("status", client.status)
os.unlink("/dev/shm/filler")
print(len(client.status().worlds))
"""
    ended = apart(code, "size=128m")
    refusal, n_worlds = ended.stdout.splitlines()
    assert refusal.startswith("status no_memory shared memory: expected"), ended
    assert n_worlds == "256", ended


def test_a_low_limit_on_file_sizes_is_named() -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    started = server()
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, before[1]))
    try:
        words = "expected a limit on file sizes of at least 512 KiB, got 1 KiB"
        with fails("channel", match=words):
            started.connect()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_server_too_large_for_shared_memory_does_not_start(apart: Run) -> None:
    code = """
print(Program("emberwatch-server", "--height=512", "--width=512", "--burn-in=0").ended())
"""
    ended = apart(code)
    for words in ("/dev/shm", "MiB", "free"):
        assert words in ended.stdout, ended
    ended = apart('tell("connect", lambda: emberwatch.connect("lab"))', "size=64m,nr_inodes=30")
    assert "shared memory: expected 48 free files in /dev/shm, got" in ended.stdout, ended
