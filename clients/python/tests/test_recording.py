"""Recordings: reading them in Python, and messages about missing records."""

import json
import os
import re
import struct
import zlib
from pathlib import Path

import document
import numpy as np
import pytest
from failures import fails
from headers import header

from emberwatch.client import recording, wire
from emberwatch.client.observer import Frame, Truth
from emberwatch.client.recording import Record, RecordingCutWarning, RecordingDamagedWarning
from emberwatch.model import Model
from emberwatch.model.airspace import Airspace

INFO = document.examples()[1] | {"n_robots": 2, "deadline_millis": 0}
TOTALS = {"n_servers": 1, "n_frames": 2, "n_truths": 1, "n_lost_frames": 3, "n_lost_truths": 0}
#: A recording of protocol version 2.
OLD = Path(__file__).parents[3] / "tests/data/version-2.recording"
FILE_HEADER = struct.pack("=8sII", b"EMBERREC", 3, 0)


def deflated(body: bytes) -> bytes:
    compressor = zlib.compressobj(wbits=-15)
    return compressor.compress(body) + compressor.flush()


def packed(kind: int, stored: bytes, n_lost: int = 0, nanos: int = 1_500_000_000) -> bytes:
    head = struct.pack("=QIII", nanos, kind, len(stored), n_lost)
    return head + struct.pack("=I", zlib.crc32(head + stored)) + stored


def frame(sequence: int, n_lost: int = 0, n_moves: int = 4, **changes: int) -> bytes:
    """Makes a frame: robot 0 was late; robot 1 flew and found something in its last cell."""
    sizes = {"height": 3, "width": 5, "n_robots": 2} | changes
    result = wire.WORLD.pack(7, 0, 0, 1.0, 0, 1, 0, 4, 1, 0, 0)
    head = header("FrameHeader", sequence=sequence, result=result, **sizes)
    robots = wire.ROBOT.pack(0, 0, 0, 0, 1, 1, 1, 1, 0, 0)
    robots += wire.ROBOT.pack(1, 1, 4, 1, 0, 0, 2, 4, 1, n_moves)
    frames = b"\xff" * 15 + b"\xff" * 14 + b"\2"
    return packed(2, deflated(head + robots + frames + b"\0\1\2\3"), n_lost)


SERVER = packed(1, deflated(json.dumps(INFO).encode()), nanos=0)
HIDDEN = packed(3, deflated(header("TruthHeader", height=3, width=5, step=7) + bytes(15)))
END = packed(4, deflated(json.dumps(TOTALS).encode()))
PARTS = [FILE_HEADER, SERVER, frame(0), HIDDEN, frame(4, n_lost=3), END]
GOOD = b"".join(PARTS)


def read(path: Path, content: bytes, *, strict: bool = False) -> list[Record]:
    path.write_bytes(content)
    return list(recording.read(path, strict=strict))


def refused(path: Path, content: bytes, words: str) -> None:
    with fails("recording", match=re.escape(words)):
        read(path, content, strict=True)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "test.recording"


def test_a_recording_is_read_in_order_with_lost_samples(path: Path) -> None:
    first, hidden, last = read(path, GOOD)
    assert isinstance(first.sample, Frame) and isinstance(hidden.sample, Truth)
    assert first.seconds == 1.5 and first.server.n_moves == 4
    assert (first.sample.n_lost, last.sample.n_lost) == (0, 3)
    late, flew = first.sample.robots
    assert (first.sample.result.late, first.sample.result.hovered) == (1, 0)
    assert flew.frame.tolist() == [[255] * 5, [255] * 5, [255] * 4 + [2]]
    assert (first.sample.frame == flew.frame).all() and (late.frame == 255).all()
    assert late.path.tolist() == [] and flew.path.tolist() == [0, 1, 2, 3]
    assert (late.result.start, flew.result.cell) == ((1, 1), (2, 4))
    assert hidden.sample.step == 7 and not hidden.sample.states.any()
    flew.frame[:] = 1  # the caller may write to it
    assert list(recording.read(path, world=1)) == []


def test_recordings_of_version_2_are_read_unless_their_sensor_has_rings(path: Path) -> None:
    good = OLD.read_bytes()
    frames = [it for it in read(path, good, strict=True) if isinstance(it.sample, Frame)]
    assert len(frames) == 10 and frames[-1].sample.result.step == 8
    server = frames[0].server
    assert server.airspace == Airspace(radius=1) and server.protocol == 2
    assert server.model is not None and Model.from_toml(server.model).sensor_radius == 1
    (length,) = struct.unpack_from("=I", good, 28)
    info = json.loads(zlib.decompress(good[40 : 40 + length], -15))
    for change in ({"n_rings": 2}, {"pays": "seen"}):
        changed = info | {"airspace": info["airspace"] | change}
        record = packed(1, deflated(json.dumps(changed).encode()), nanos=0)
        words = "expected a sensor with one observation matrix, and rewards for visited cells, got"
        refused(path, good[:16] + record + good[40 + length :], words)


def test_damaged_recordings_are_read_to_the_last_good_record(path: Path) -> None:
    ends = np.cumsum([len(part) for part in PARTS])
    for length in (0, ends[1] + 1, ends[4], len(GOOD) - 1):
        whole = int((ends <= length).sum())
        offset = ends[whole - 1] if whole else 0
        words = f"cut short: expected a whole record at byte {offset}, got {length - offset} bytes"
        with pytest.warns(RecordingCutWarning, match=words):
            assert len(read(path, GOOD[:length])) == max(0, whole - 2)
        refused(path, GOOD[:length], words)
    damaged = bytearray(GOOD)
    offset = sum(map(len, PARTS[:4]))
    damaged[offset + 30] ^= 0x10
    words = rf"damaged at byte {offset}: checksum: .*; good before it: 1 steps"
    with pytest.warns(RecordingDamagedWarning, match=words):
        first, hidden = read(path, bytes(damaged))
    assert isinstance(first.sample, Frame) and isinstance(hidden.sample, Truth)
    refused(path, bytes(damaged), f"damaged at byte {offset}: checksum")


def test_files_that_are_not_recordings_are_refused(path: Path, tmp_path: Path) -> None:
    for content, words in (
        (b"PK\3\4 and so on, at length", 'expected it to begin with "EMBERREC", got "PK'),
        (FILE_HEADER + SERVER + frame(0, n_moves=3), "payload bytes: expected 129, got 130"),
    ):
        refused(path, content, words)
    os.mkfifo(fifo := tmp_path / "fifo")
    for path in (fifo, tmp_path):
        with fails("recording", match=f"expected a regular file, got {path}"):
            next(recording.read(path))
