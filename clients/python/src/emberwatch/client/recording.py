"""Reads recordings, the files of `emberwatch-server record` (PROTOCOL.md section 13).

Such as `for record in emberwatch.recording.read("lab.recording", world=0): ...`. It needs no server
and opens no shared memory.
"""

import json
import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import emberwatch._native as _native
from emberwatch.client.observer import Frame, Truth, frame_of
from emberwatch.client.replies import ServerInfo
from emberwatch.client.replies import record as record_from_reply
from emberwatch.errors import EmberwatchError


class RecordingCutWarning(UserWarning):
    """A recording ends without an end. Every record before is whole."""


class RecordingDamagedWarning(UserWarning):
    """A recording has bytes that no recorder wrote. Every record before is whole."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Record:
    """A record, checked."""

    #: Time since the recording began.
    seconds: float
    server: ServerInfo
    #: Its `n_lost` counts the samples of that channel, of all worlds, that the recorder missed
    #: right before it.
    sample: Frame | Truth


def read(
    path: str | os.PathLike[str], *, world: int | None = None, strict: bool = False
) -> Iterator[Record]:
    """Reads a recording: an iterator of its frames and hidden states, in order.

    Hidden states come before the frame of their step. They are for evaluation and pictures, never
    for learners.

    Args:
        world: Only this world; None: all.
        strict: Raise an error where there would be a warning.

    Raises:
        EmberwatchError: With code `"recording"` if the file is none, naming the byte.
        OSError: If it cannot be read.

    Warns:
        RecordingCutWarning: After the last whole record of a file that was cut short.
        RecordingDamagedWarning: After the last whole record before damage.
    """
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
    file = _native.Recording(os.fspath(path))
    server = None
    while (record := file.read()) is not None:
        nanos, kind, content = record
        if kind == "server":
            server = record_from_reply(ServerInfo, json.loads(content))
        elif server is not None:  # samples come behind their server
            sample = frame_of(content) if kind == "frame" else Truth(**content)
            yield Record(seconds=nanos / 1e9, server=server, sample=sample)
