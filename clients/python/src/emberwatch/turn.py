"""One at a time: what makes or removes nodes, services or ports takes a turn (PROTOCOL.md, 1).

During its turn no other process is in the middle of making something: what is half made was left by
a dead one. The turn is a `flock`, which ends with its process.
"""

import errno
import fcntl
import os
import re
import threading
import time
import weakref
from collections.abc import Generator
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import Final

from emberwatch.errors import EmberwatchError

#: How long to wait for the turns of others, which take milliseconds each; seconds.
LONGEST_WAIT: Final = 10.0

#: The same for what can also be done without one, or by the next program: closing, cleaning up.
SHORT_WAIT: Final = 1.0

#: How long to wait before asking which process has the turn, and whether it is stopped, seconds.
_STOPPED_WAIT: Final = 0.05

#: A process that has had it for so long does not run: a frozen one does not look stopped; seconds.
_FROZEN_WAIT: Final = 2.0

#: How often to try, seconds.
_INTERVAL: Final = 500e-6


class _Held(threading.local):
    #: Whether this thread has a turn alone; None: it has none.
    alone: bool | None = None


_held: Final = _Held()
_locks: Final[weakref.WeakSet[FileIO]] = weakref.WeakSet()


@contextmanager
def turn(directory: Path, limit: float = LONGEST_WAIT) -> Generator[bool]:
    """Takes a turn; turns of one thread may nest. Yields whether no other process has it.

    It waits `limit` seconds at most, and not for a stopped or frozen process.
    """
    if _held.alone is not None:
        yield _held.alone
        return
    lock = None
    try:
        lock = _wait(directory / "lock", limit)
        _held.alone = lock is not None
        yield _held.alone
    finally:
        _held.alone = None
        if lock is not None and not lock.closed:
            # Not by closing alone: a child of a fork may have a copy.
            fcntl.flock(lock, fcntl.LOCK_UN)
            lock.close()


def process_state(pid: int) -> str | None:
    """A process's state, such as `R` or `Z`; None if there is none of that id."""
    try:
        # After its name, which may hold anything, in brackets.
        return Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(") ")[2][:1]
    except (FileNotFoundError, ProcessLookupError):
        return None


def pid_namespace() -> int | None:
    """The PID namespace of this process, by its number; None if the system does not say."""
    with suppress(OSError):
        found = re.fullmatch(r"pid:\[(\d+)\]", os.readlink("/proc/self/ns/pid"))
        return int(found[1]) if found else None
    return None


def cannot_create(path: Path, error: OSError) -> EmberwatchError:
    """The error of a file or folder that the system does not let be used."""
    remedies = {
        errno.EROFS: ": channels need a /dev/shm that can be written to; as root, "
        "`mount -o remount,rw /dev/shm`, or mount a tmpfs there",
        errno.ENOSPC: ": free some, or give the container more (docker: --shm-size)",
    }
    remedy = remedies.get(error.errno or 0, "")
    return EmberwatchError(f"create {path}: {error.strerror}{remedy}", "channel")


def _wait(path: Path, limit: float) -> FileIO | None:
    """The lock, which ends with its last reference; None if a stopped or frozen process has it."""
    start = time.monotonic()
    holder, since = None, start
    lock = None
    try:
        while True:
            lock = _open(path)
            _locks.add(lock)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.path.samestat(os.fstat(lock.fileno()), path.stat()):
                    return lock
            except (BlockingIOError, FileNotFoundError):
                now = time.monotonic()
                if now - start > _STOPPED_WAIT:
                    before, holder = holder, _holder(lock)
                    since = since if holder == before else now
                    if holder is not None and (
                        now - since > _FROZEN_WAIT or process_state(holder) in ("T", "t")
                    ):
                        lock.close()
                        return None
                # Not ">": "not a number" would never end.
                if not now - start < limit:
                    holder = holder or _holder(lock)
                    lock.close()
                    who = f"pid {holder}" if holder else "another process"
                    problem = f"expected the lock within {limit} s, got it held by {who}"
                    raise EmberwatchError(f"{path}: {problem}", "channel") from None
                time.sleep(_INTERVAL)
            lock.close()
    except BaseException as error:
        if lock is not None:
            lock.close()  # the error's traceback would keep it
        # One without a number is not the system's: a signal's handler may raise a TimeoutError.
        if isinstance(error, OSError) and error.errno is not None:
            raise cannot_create(path, error) from None
        raise


def _open(path: Path) -> FileIO:
    def opener(name: str, _flags: int) -> int:
        return os.open(name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)

    return open(path, "rb+", buffering=0, opener=opener)


def _holder(lock: FileIO) -> int | None:
    """The process that has the lock, as the kernel says."""
    found = os.fstat(lock.fileno())
    inode = f"{os.major(found.st_dev):02x}:{os.minor(found.st_dev):02x}:{found.st_ino}"
    # "1: FLOCK  ADVISORY  WRITE 4711 00:1a:5678 0 EOF"; a process that waits has an arrow in front.
    for line in Path("/proc/locks").read_text().splitlines():
        words = line.split()
        if words[1] == "FLOCK" and words[3] == "WRITE" and words[5] == inode:
            return int(words[4])
    return None


def _forget() -> None:
    for lock in _locks:
        lock.close()
    _locks.clear()
    _held.alone = None


os.register_at_fork(after_in_child=_forget)
