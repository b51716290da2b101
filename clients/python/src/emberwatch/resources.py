"""What ports take of the system: shared memory, files, descriptors (PROTOCOL.md section 9).

Files in shared memory are sparse, and a write to a page for which there is no memory ends the
process with SIGBUS. So there must be room before ports are made, and what they may write to gets
its memory at once. If iceoryx2 fails all the same, the error names what is missing.
"""

import errno
import os
import resource
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final

from emberwatch.errors import EmberwatchError

#: Where iceoryx2 keeps shared memory: a folder that every user may write to.
SHARED_MEMORY: Final = Path("/dev/shm")

#: What the ports of a connection take beside its longest messages: 190 KiB, 25 files (measured).
_PORT_BYTES: Final = 512 << 10
_PORT_FILES: Final = 48
_PORT_DESCRIPTORS: Final = 10


def check_room(message_bytes: int = 0) -> None:
    """Raises unless there is room for the ports of a connection, and for a message of them."""
    needed = _PORT_BYTES + message_bytes
    limit, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    if limit != resource.RLIM_INFINITY and limit < needed:
        expected = f"expected a limit on file sizes of at least {_size(needed)}"
        raise EmberwatchError(
            f"shared memory: {expected}, got {_size(limit)}; raise it (`ulimit -f`)", "channel"
        )
    found = os.statvfs(SHARED_MEMORY)
    free = found.f_bavail * found.f_frsize
    if free < needed:
        raise _no_room(f"expected {_size(needed)} free in {SHARED_MEMORY}, got {_size(free)}")
    # A file system without a limit says 0 of 0.
    if found.f_files > 0 and found.f_favail < _PORT_FILES:
        got = found.f_favail
        raise EmberwatchError(
            f"shared memory: expected room for {_PORT_FILES} files in {SHARED_MEMORY}, got {got}; "
            "remove some, or allow more (mount -o nr_inodes)",
            "channel",
        )


def fill(paths: Iterable[Path]) -> None:
    """Gives files in shared memory all their memory; what is in them stays."""
    for path in paths:
        try:
            with path.open("rb+") as file:
                os.posix_fallocate(file.fileno(), 0, max(1, os.fstat(file.fileno()).st_size))
        except FileNotFoundError:  # of a process that has ended
            continue
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.ENOMEM, errno.EDQUOT):
                raise EmberwatchError(f"{path}: {error.strerror}", "channel") from None
            raise _no_room(f"no memory for {path}: {error.strerror}") from None


def cause(what: str, error: Exception, most: str) -> EmberwatchError:
    """The error of something that iceoryx2 could not do; `most`: how many may do so at a time."""
    if "ExceedsMaxSupported" in str(error) or "ExceedsMaxNumberOf" in str(error):
        problem = f"expected at most {most} at a time, got one more"
        return EmberwatchError(f"{what}: {problem}", "channel")
    try:
        _check_descriptors(what)
        check_room()
    except EmberwatchError as missing:
        return missing
    return EmberwatchError(f"{what}: {error}", "channel")


def _check_descriptors(what: str) -> None:
    opened: list[int] = []
    try:
        while len(opened) < _PORT_DESCRIPTORS:
            opened.append(os.eventfd(0))
    except OSError:
        limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        raise EmberwatchError(
            f"{what}: expected {_PORT_DESCRIPTORS} file descriptors, got fewer of the limit of "
            f"{limit}; close some, or raise the limit (`ulimit -n`; docker: --ulimit nofile)",
            "channel",
        ) from None
    finally:
        for descriptor in opened:
            with suppress(OSError):
                os.close(descriptor)


def _no_room(problem: str) -> EmberwatchError:
    remedy = "free some, or give the container more (docker: --shm-size)"
    return EmberwatchError(f"shared memory: {problem}; {remedy}", "channel")


def _size(n_bytes: int) -> str:
    kind, unit = ("KiB", 1 << 10) if n_bytes < 10 << 20 else ("MiB", 1 << 20)
    return f"{-(-n_bytes // unit)} {kind}"
