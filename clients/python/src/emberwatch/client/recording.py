"""Reader of recordings, the files of `emberwatch-server record` (PROTOCOL.md section 13).

For example `for record in emberwatch.recording.read("lab.recording", world=0): ...`. Reading needs
no server, and opens no shared memory.
"""

import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import emberwatch._native as _native
from emberwatch.client.observer import Frame, Truth
from emberwatch.client.replies import ServerInfo
from emberwatch.common.arguments import as_count, as_flag
from emberwatch.errors import EmberwatchError


class RecordingCutWarning(UserWarning):
    """A recording was cut short. All records before the cut are complete."""


class RecordingDamagedWarning(UserWarning):
    """A recording is damaged. All records before the damage are complete."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Record:
    """A checked record of a recording."""

    #: Seconds since the recording began.
    seconds: float
    #: The server that published the sample.
    server: ServerInfo
    #: The sample. Its `n_lost` counts the samples of the same channel, of all worlds, that the
    #: recorder missed right before it.
    sample: Frame | Truth


def read(
    path: str | os.PathLike[str], *, world: int | None = None, strict: bool = False
) -> Iterator[Record]:
    """Reads a recording. Yields its frames and hidden states in order.

    The hidden states of a step come before its frame. Hidden states are for evaluation and
    pictures, never for learners.

    Args:
        path: The file.
        world: The only world to read; None: all worlds.
        strict: Whether to raise an error instead of each warning.

    Raises:
        EmberwatchError: With code `"recording"` if the file is not a recording. The message names
            the position of the first wrong byte.
        OSError: If the file cannot be read.

    Warns:
        RecordingCutWarning: After the last complete record of a file that was cut short.
        RecordingDamagedWarning: After the last complete record before the damage.
    """
    world = None if world is None else as_count(world, "world", 0, 2**32 - 1)
    strict = as_flag(strict, "strict")
    try:
        for record in _records(path):
            if world is None or record.sample.world == world:
                yield record
    except EmberwatchError as error:
        warning = _WARNINGS.get(error.code)
        error.code = "recording"
        if strict or warning is None:
            raise
        warnings.warn(str(error), warning, stacklevel=2)


_WARNINGS = {"cut": RecordingCutWarning, "damaged": RecordingDamagedWarning}


def _records(path: str | os.PathLike[str]) -> Iterator[Record]:
    server = None
    for nanos, content in _native.Recording(os.fspath(path)):
        if isinstance(content, ServerInfo):
            server = content
        elif server is not None:  # a recording names the server before its samples
            yield Record(seconds=nanos / 1e9, server=server, sample=content)
