"""Limits of the system: memory, threads, file descriptors, and calls that a container refuses.

Each test runs in its own process. Tests that need root or a kind of cgroup are skipped without it.
"""

import errno
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import pytest
from processes import eventually, find, server, unused_instance

import emberwatch

#: Prints an error's type, code and message.
HEAD = """
import ctypes, os, resource, struct, sys
import emberwatch, gymnasium
def tell(call):
    try: print("made", call())
    except emberwatch.EmberwatchError as error: print(type(error).__name__, error.code, error)
def refuse(number, errno):  # a seccomp filter: this system call fails, all others pass
    libc = ctypes.CDLL(None)
    fails, passes = (6, 0, 0, 0x50000 | errno), (6, 0, 0, 0x7FFF0000)
    lines = (0x20, 0, 0, 0), (0x15, 0, 1, number), fails, passes
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *line) for line in lines))
    program = ctypes.create_string_buffer(struct.pack("@HP", len(lines), ctypes.addressof(code)))
    assert libc.prctl(38, 1, 0, 0, 0) == 0 and libc.prctl(22, 2, program, 0, 0) == 0
LARGE = {"worlds": 256, "height": 1024, "width": 1024, "burn_in": 0}
"""

#: Numbers of x86-64 system calls.
CALLS = {"flock": 73, "fallocate": 285, "pidfd_open": 434, "socket": 41, "clone3": 435}

as_root = pytest.mark.skipif(os.getuid() != 0, reason="needs root")
on_x86 = pytest.mark.skipif(platform.machine() != "x86_64", reason="numbers of x86-64's calls")


def run(*command: str | Path, limit: str = "true") -> subprocess.CompletedProcess[str]:
    shell = ["bash", "-c", f'ulimit -c 0; {limit} && exec "$@"', "bash", *map(str, command)]
    few = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    return subprocess.run(shell, capture_output=True, text=True, timeout=60, env=few)


def python(code: str, *arguments: object, limit: str = "true") -> str:
    words = [sys.executable, "-W", "ignore", "-c", HEAD + code, *map(str, arguments)]
    ended = run(*words, limit=limit)
    assert ended.returncode == 0, ended
    return ended.stdout


@contextmanager
def cgroup(kind: str, names: list[str], value: str) -> Iterator[tuple[Path, str]]:
    """Makes a cgroup with a limit, by one of the names that versions of cgroups use for it.

    Yields the cgroup, and a shell command that enters another group within it.
    """
    versions = [Path("/sys/fs/cgroup", kind), Path("/sys/fs/cgroup")]
    base = next((it for it in versions if (it / "cgroup.procs").exists()), None)
    if os.getuid() != 0 or base is None:
        pytest.skip("needs root, and cgroups")
    outer = base / f"emberwatch-test-{os.getpid()}"
    inner = outer / "inner"
    try:
        try:
            inner.mkdir(parents=True)
        except OSError as error:
            pytest.skip(f"no cgroup can be made: {error}")
        limit = next((outer / name for name in names if (outer / name).exists()), None)
        if limit is None:
            pytest.skip(f"the cgroup has none of {names}")
        limit.write_text(value)
        yield outer, f"echo $$ > {inner}/cgroup.procs"
    finally:
        for folder in (inner, outer):  # once their processes have ended
            assert eventually(partial(removed, folder))


def removed(folder: Path) -> bool:
    with suppress(OSError):
        folder.rmdir()
    return not folder.exists()


#: 400 MB of memory.
MEMORY = "memory", ["memory.limit_in_bytes", "memory.max"], "400M"


def test_worlds_beyond_a_ulimit_are_refused_with_numbers() -> None:
    limits = {"ulimit -v 1500000": "RLIMIT_AS", "ulimit -d 1200000": "RLIMIT_DATA"}
    for limit, name in limits.items():
        said = python("tell(lambda: emberwatch.embed(**LARGE))", limit=limit)
        assert said.startswith("NotEnoughMemoryError no_memory memory: expected "), said
        assert "MiB for 256 worlds of 1024 x 1024 cells, got " in said, said
        assert f"the limit {name}; raise it (`ulimit " in said, said


def test_a_cgroups_memory_limits_the_worlds() -> None:
    few = """
client = emberwatch.embed(worlds=32, height=512, width=512, moves=4, burn_in=0)
lease = client.acquire(0, 32)
for _ in range(5): lease.step([[1] * 4] * 32)
print(len(lease.reset(range(32))))
"""
    with cgroup(*MEMORY) as (outer, enter):
        said = python("tell(lambda: emberwatch.embed(**LARGE))", limit=enter)
        assert said.startswith("NotEnoughMemoryError no_memory memory: expected "), said
        assert f"the limit of a cgroup ({outer}/memory." in said, said
        assert python(few, limit=enter) == "32\n"


def test_beliefs_beyond_a_limit_are_refused_early() -> None:
    code = """
from emberwatch import belief
from emberwatch.model import Model
model = Model.named("wildfire-burnout")
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
# A belief alone takes 240 bytes or 3 KiB; with tables and cavities, 6 or 160 KiB.
for kind, side, n_worlds in ("known", 4, 1 << 20), ("known+cavities", 16, 40_000):
    prior, before = belief.uniform_prior(model, height=side, width=side), peak()
    tell(lambda: belief.known(model, prior=prior, kind=kind, n_worlds=n_worlds))
    assert peak() - before < 100
"""
    for n_worlds, error in zip((1 << 20, 40_000), python(code).splitlines(), strict=True):
        assert "NotEnoughMemoryError no_memory memory: expected " in error
        assert f" MiB for the beliefs about {n_worlds} worlds, got " in error


def test_memory_errors_are_also_python_memory_errors() -> None:
    with pytest.raises(MemoryError, match="for 1024 worlds of 4096 x 4096 cells"):
        emberwatch.embed(worlds=1024, height=4096, width=4096)


@as_root
def test_the_limit_on_threads_is_named() -> None:
    code = """
make = lambda: emberwatch.embed(height=5, width=5, moves=4, burn_in=0)
make().close()
resource.setrlimit(resource.RLIMIT_NPROC, (1, 1))
os.setresuid(64321, 64321, 64321)
tell(make)
"""
    said = python(code)
    assert said.startswith("EmberwatchError threads threads: expected to start 1, got: "), said
    assert "may have 1 processes and threads (RLIMIT_NPROC)" in said, said
    assert said.count("Resource temporarily unavailable") == 1, said


def test_a_cgroups_limit_on_threads_is_named() -> None:
    flags = [f"--instance={unused_instance()}", "--threads=16", "--burn-in=0"]
    with cgroup("pids", ["pids.max"], "6") as (outer, enter):
        ended = run(find("emberwatch-server"), *flags, limit=enter)
        said = python("tell(lambda: emberwatch.embed(threads=16, worlds=16))", limit=enter)
    assert ended.returncode == 1, ended
    assert "threads: expected to start 16, got: Resource temporarily" in ended.stderr, ended
    assert ended.stderr.count("Resource temporarily unavailable") == 1, ended
    assert f"({outer}/pids.max)" in ended.stderr and "--pids-limit" in ended.stderr, ended
    assert f"({outer}/pids.max)" in said, said


@on_x86
def test_a_refused_system_call_is_named() -> None:
    running = server()
    code = """
import logging
refuse(int(sys.argv[2]), int(sys.argv[3]))
tell(lambda: emberwatch.embed(height=5, width=5, moves=4, burn_in=0).acquire().robots)
def waits(record): raise AssertionError(record.getMessage())  # "waiting up to 100 s for a server"
logging.getLogger("emberwatch").addFilter(waits)
tell(lambda: emberwatch.connect(sys.argv[1], wait=100))
"""
    starts = "refuse(int(sys.argv[1]), int(sys.argv[2])); os.execv(sys.argv[3], sys.argv[3:])"
    program = [sys.executable, "-c", HEAD + starts]
    for call, number in (
        ("pidfd_open", errno.EPERM),
        ("flock", errno.EPERM),
        ("fallocate", errno.EPERM),
        ("socket", errno.EAFNOSUPPORT),
    ):
        words = f"{call}: expected the system to allow this call, got: {os.strerror(number)}"
        words = words.replace("socket:", "socket (AF_UNIX):")
        told = python(code, running.instance, CALLS[call], number).splitlines()
        assert told[0].startswith("made ") and "--security-opt seccomp" in told[1], told
        assert told[1].startswith(f"EmberwatchError channel {words}"), told
        server_flags = [find("emberwatch-server"), f"--instance={unused_instance()}"]
        ended = run(*program, str(CALLS[call]), str(number), *server_flags)
        assert ended.returncode == 1 and words in ended.stderr, ended


@on_x86
def test_calls_hidden_by_a_seccomp_profile_are_named() -> None:
    code = """
refuse(435, 1)
tell(lambda: emberwatch.embed(height=5, width=5, moves=4, burn_in=0).acquire())
"""
    said = python(code)
    assert said.startswith("EmberwatchError threads threads: ") and "`clone3`" in said, said
    code = "refuse(434, 1); os.execv(sys.argv[1], sys.argv[1:])"
    flags = [f"--instance={unused_instance()}", f"--exit-with={os.getpid()}"]
    ended = run(sys.executable, "-c", HEAD + code, find("emberwatch-server"), *flags)
    assert ended.returncode == 1, ended
    assert f"--exit-with {os.getpid()}: pidfd_open: expected the system" in ended.stderr, ended


#: Connects with ever more free file descriptors. Prints how many descriptors a connection needs.
DESCRIPTORS = """
import gc
def count():
    gc.collect()
    return len(os.listdir("/proc/self/fd")) - 1
open_one = {"connect": emberwatch.connect, "observe": emberwatch.observe}[sys.argv[2]]
open_one(sys.argv[1], timeout=2.0).close()
before = count()
for free in range(60):
    resource.setrlimit(resource.RLIMIT_NOFILE, (before + free, 4096))
    try: one, said = open_one(sys.argv[1], timeout=2.0), ""
    except emberwatch.EmberwatchError as error: one, said = None, str(error)
    resource.setrlimit(resource.RLIMIT_NOFILE, (1024, 4096))
    if one is not None: break
    assert "file descriptors, got fewer (the limit is" in said, said
    assert count() == before, f"{count() - before} left behind with {free} free: {said}"
    needed = said.partition("expected ")[2].partition(" free file")[0]
one.close()
print(free, needed, count() - before)
"""


def test_a_connection_needs_as_many_descriptors_as_reported() -> None:
    instance = server().instance
    for kind in ("connect", "observe"):
        free, needed, left = map(int, python(DESCRIPTORS, instance, kind).split())
        assert left == 0
        assert needed <= free <= needed + 1, kind
