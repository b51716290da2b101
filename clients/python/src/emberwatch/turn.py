"""One at a time: what makes or removes nodes, services or ports takes a turn (PROTOCOL.md, 1).

During its turn no other process is in the middle of making something: what is half made was left by
a dead one. The turn is a `flock`, which ends with its process.
"""

from __future__ import annotations

import errno
import fcntl
import os
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from emberwatch.errors import EmberwatchError

#: How long to wait for the turns of others, which take milliseconds each; seconds.
_LONGEST_WAIT: Final = 10.0

#: How long to wait before asking whether the process that has the turn is stopped, seconds.
_STOPPED_WAIT: Final = 0.05

#: How often to try, seconds.
_INTERVAL: Final = 500e-6


class _Held(threading.local):
    #: Whether this thread has a turn alone; None: it has none.
    alone: bool | None = None


_held: Final = _Held()
_locks: Final[set[int]] = set()


@contextmanager
def turn(directory: Path) -> Generator[bool]:
    """Takes a turn; turns of one thread may nest. Yields whether no other process has it.

    It does not wait for a stopped process.
    """
    if _held.alone is not None:
        yield _held.alone
        return
    lock = _wait(directory / "lock")
    _held.alone = lock is not None
    try:
        yield _held.alone
    finally:
        _held.alone = None
        if lock in _locks:
            _locks.discard(lock)
            # Not by closing alone: a child of a fork may have a copy.
            fcntl.flock(lock, fcntl.LOCK_UN)
            os.close(lock)


def process_state(pid: int) -> str | None:
    """A process's state, such as `R` or `Z`; None if there is none of that id."""
    try:
        # After its name, which may hold anything, in brackets.
        return Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(") ")[2][:1]
    except OSError:
        return None


def cannot_create(path: Path, error: OSError) -> EmberwatchError:
    """The error of a file or folder that the system does not let be used."""
    remedy = (
        ": channels need a /dev/shm that can be written to; as root, "
        "`mount -o remount,rw /dev/shm`, or mount a tmpfs there"
    )
    remedy = remedy if error.errno == errno.EROFS else ""
    return EmberwatchError(f"create {path}: {error.strerror}{remedy}", "channel")


def _wait(path: Path) -> int | None:
    start = time.monotonic()
    try:
        while True:
            lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.path.samestat(os.fstat(lock), path.stat()):
                    _locks.add(lock)
                    return lock
            except (BlockingIOError, FileNotFoundError):
                waited = time.monotonic() - start
                holder = _holder(lock) if waited > _STOPPED_WAIT else None
                if holder is not None and process_state(holder) == "T":
                    return None
                if waited > _LONGEST_WAIT:
                    raise EmberwatchError(
                        f"{path}: expected the lock within {_LONGEST_WAIT} s, got it held by "
                        f"pid {holder}",
                        "channel",
                    ) from None
                time.sleep(_INTERVAL)
            finally:
                if lock not in _locks:
                    os.close(lock)
    except OSError as error:
        raise cannot_create(path, error) from None


def _holder(lock: int) -> int | None:
    """The process that has the lock, as the kernel says."""
    found = os.fstat(lock)
    inode = f"{os.major(found.st_dev):02x}:{os.minor(found.st_dev):02x}:{found.st_ino}"
    # "1: FLOCK  ADVISORY  WRITE 4711 00:1a:5678 0 EOF"; a process that waits has an arrow in front.
    for line in Path("/proc/locks").read_text().splitlines():
        words = line.split()
        if words[1] == "FLOCK" and words[3] == "WRITE" and words[5] == inode:
            return int(words[4])
    return None


def _forget() -> None:
    for lock in _locks:
        os.close(lock)
    _locks.clear()
    _held.alone = None


os.register_at_fork(after_in_child=_forget)
