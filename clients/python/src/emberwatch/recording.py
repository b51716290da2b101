"""Reads recordings, the files of `emberwatch-server record` (PROTOCOL.md section 14).

Such as `for record in emberwatch.recording.read("lab.recording", world=0): ...`. It needs no server
and opens no shared memory.
"""

import ctypes
import json
import os
import struct
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final, NoReturn

from emberwatch import wire
from emberwatch.errors import EmberwatchError
from emberwatch.observer import Frame, Truth, frame_from_sample, truth_from_sample
from emberwatch.replies import ServerInfo
from emberwatch.replies import record as record_from_reply

#: The first bytes of every recording, and the version of the format.
MAGIC: Final = b"EMBERREC"
VERSION: Final = 2

#: Longest body, bytes: inflated, and as stored.
MAX_BODY_BYTES: Final = 17_042_528
MAX_STORED_BYTES: Final = 17_059_235

#: The beginning of a file, and of each record.
FILE_HEADER: Final = struct.Struct("=8sII")
RECORD_HEADER: Final = struct.Struct("=QIIII")

#: Kinds of records.
SERVER: Final = 1
FRAME: Final = 2
TRUTH: Final = 3
END: Final = 4

_SAMPLES: Final = {
    FRAME: (wire.FrameHeader, frame_from_sample, "frames"),
    TRUTH: (wire.TruthHeader, truth_from_sample, "truths"),
}


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
    with Path(path).open("rb") as file:
        reader = _Reader(file, os.fspath(path))
        try:
            for record in reader.records():
                if world is None or record.sample.world == world:
                    yield record
        except EmberwatchError as error:
            if strict or reader.warning is None:
                raise
            warnings.warn(str(error), reader.warning, stacklevel=2)


class _Reader:
    """What is known while reading a file."""

    def __init__(self, file: BinaryIO, name: str) -> None:
        self._file = file
        self._name = name
        self._offset = 0
        self._nanos = 0
        self._server: ServerInfo | None = None
        #: What is wrong, if every record up to there is whole.
        self.warning: type[UserWarning] | None = None
        #: World steps, and episode and step of each world's last frame.
        self._n_steps = 0
        self._last: dict[int, tuple[int, int]] = {}
        self._totals: dict[str, int] = dict.fromkeys(
            ["n_servers", "n_frames", "n_truths", "n_lost_frames", "n_lost_truths"], 0
        )

    def records(self) -> Iterator[Record]:
        head = self._file.read(FILE_HEADER.size)
        if not (head.startswith(MAGIC) or MAGIC.startswith(head)):
            start = head[: len(MAGIC)]
            raise self._error(f"not a recording: expected it to begin with {MAGIC}, got {start}")
        if len(head) < FILE_HEADER.size:
            self._cut(len(head))
        _, version, reserved = FILE_HEADER.unpack(head)
        if version != VERSION:
            raise self._error(f"recording version: expected {VERSION}, got {version}")
        if reserved != 0:
            raise self._error(f"expected 0 in byte 12 to 15, got {reserved}")
        self._offset = len(head)
        while True:
            head = self._file.read(RECORD_HEADER.size)
            if len(head) < RECORD_HEADER.size:
                self._cut(len(head))
            nanos, kind, length, n_lost, checksum = RECORD_HEADER.unpack(head)
            if length > MAX_STORED_BYTES:
                self._damaged(f"body: expected at most {MAX_STORED_BYTES} bytes, got {length}")
            stored = self._file.read(length)
            if len(stored) < length:
                self._cut(len(head) + len(stored))
            expected = zlib.crc32(stored, zlib.crc32(head[:-4]))
            if checksum != expected:
                self._damaged(f"checksum: expected {expected:#010x}, got {checksum:#010x}")
            body = self._inflate(stored)
            if kind == END:
                self._check_end(body)
                return
            if nanos < self._nanos:
                self._damaged(f"time: expected at least {self._nanos} ns, got {nanos}")
            self._nanos = nanos
            sample = self._take(kind, body, n_lost)
            self._offset += len(head) + length
            if sample is not None and self._server is not None:
                yield Record(seconds=nanos / 1e9, server=self._server, sample=sample)

    def _take(self, kind: int, body: bytearray, n_lost: int) -> Frame | Truth | None:
        """The sample in a body; `None` for a server, which it keeps."""
        if kind not in (SERVER, FRAME, TRUTH):
            self._damaged(f"kind: expected 1 to 4, got {kind}")
        try:
            if kind == SERVER:
                self._totals["n_servers"] += 1
                self._last.clear()
                self._server = record_from_reply(ServerInfo, json.loads(body))
                return None
            header_kind, decode, name = _SAMPLES[kind]
            header = header_kind.from_buffer_copy(body)
            sample = decode(header, body[ctypes.sizeof(header) :], n_lost)
        except (ValueError, RecursionError, EmberwatchError) as error:
            self._damaged(str(error))
        self._check_sample(header, sample)
        self._totals[f"n_{name}"] += 1
        self._totals[f"n_lost_{name}"] += n_lost
        if isinstance(sample, Frame):  # which may be published again
            now = (sample.result.episode, sample.result.step)
            is_new = self._last.get(sample.world) != now
            self._n_steps += is_new and sample.result.step > 0
            self._last[sample.world] = now
        return sample

    def _check_sample(self, header: Any, sample: Frame | Truth) -> None:
        server = self._server
        if server is None:
            self._damaged("expected a server before its samples, got a sample")
        if header.version != wire.VERSION:
            self._damaged(f"sample version: expected {wire.VERSION}, got {header.version}")
        grid = header.height, header.width
        if grid != (server.height, server.width):
            self._damaged(f"grid: expected {(server.height, server.width)}, got {grid}")
        if header.world >= server.n_worlds:
            self._damaged(f"world: expected one below {server.n_worlds}, got {header.world}")
        if isinstance(sample, Truth):
            return
        robots = range(header.first_robot, header.first_robot + header.n_robots)
        expected = range(header.world * server.n_robots, (header.world + 1) * server.n_robots)
        if robots != expected:
            self._damaged(f"robots: expected {expected}, got {robots}")
        for robot in sample.robots:
            if len(robot.path) not in (0, server.n_moves):
                got = len(robot.path)
                self._damaged(f"path: expected 0 or {server.n_moves} moves, got {got}")

    def _inflate(self, stored: bytes) -> bytearray:
        inflater = zlib.decompressobj(wbits=-zlib.MAX_WBITS)
        try:
            body = bytearray(inflater.decompress(stored, MAX_BODY_BYTES + 1))
        except zlib.error as error:
            self._damaged(f"body: expected deflate, got {error}")
        if len(body) > MAX_BODY_BYTES or not inflater.eof or inflater.unused_data:
            self._damaged(f"body: expected one deflate stream of at most {MAX_BODY_BYTES} bytes")
        return body

    def _check_end(self, body: bytearray) -> None:
        try:
            totals = json.loads(body)
        except (ValueError, RecursionError) as error:
            self._damaged(str(error))
        if totals != self._totals:
            self._damaged(f"totals: expected {self._totals}, got {totals}")
        if self._file.read(1):
            self._damaged("expected nothing behind the end, got more bytes")

    def _cut(self, got: int) -> NoReturn:
        self._end(
            f"was cut short: expected a whole record at byte {self._offset}, got {got} bytes",
            RecordingCutWarning,
        )

    def _damaged(self, problem: str) -> NoReturn:
        self._end(f"is damaged at byte {self._offset}: {problem}", RecordingDamagedWarning)

    def _end(self, problem: str, warning: type[UserWarning]) -> NoReturn:
        self.warning = warning
        raise self._error(f"the recording {problem}; good before it: {self._n_steps} steps")

    def _error(self, problem: str) -> EmberwatchError:
        return EmberwatchError(f"{self._name}: {problem}", "recording")
