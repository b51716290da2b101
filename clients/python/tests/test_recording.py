"""Recordings: reading them in Python, and messages about missing records."""

import json
import os
import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from failures import fails

from emberwatch.client import recording
from emberwatch.client.observer import Frame, Truth
from emberwatch.client.recording import Record, RecordingCutWarning, RecordingDamagedWarning
from emberwatch.model import Model
from emberwatch.model.airspace import Airspace

#: A recording of protocol version 2: one world, 12 hidden states and 10 frames.
OLD = Path(__file__).parents[3] / "tests/data/version-2.recording"
GOOD = OLD.read_bytes()


def parts() -> list[bytes]:
    """Returns the file's header and each record."""
    found = [GOOD[:16]]
    while at := sum(map(len, found)) % len(GOOD):
        (length,) = struct.unpack_from("=I", GOOD, at + 12)
        found.append(GOOD[at : at + 24 + length])
    return found


def packed(kind: int, stored: bytes, n_lost: int = 0, nanos: int = 0) -> bytes:
    head = struct.pack("=QIII", nanos, kind, len(stored), n_lost)
    return head + struct.pack("=I", zlib.crc32(head + stored)) + stored


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
    changed = parts()
    totals = json.loads(zlib.decompress(changed[-1][24:], -15)) | {"n_lost_frames": 3}
    changed[-1] = packed(4, zlib.compress(json.dumps(totals).encode(), wbits=-15))
    changed[-2] = packed(2, changed[-2][24:], n_lost=3, nanos=5_500_000_000)
    found = read(path, b"".join(changed), strict=True)
    truths, frames = found[:1] + found[4:14], found[3:4] + found[14:]
    for step, (hidden, shown) in enumerate(zip(truths, frames, strict=False)):
        assert isinstance(hidden.sample, Truth) and isinstance(shown.sample, Frame)
        assert hidden.sample.moment == shown.sample.moment == (0, 0, step)
        assert hidden.sample.states.shape == shown.sample.frame.shape == (16, 16)
        assert shown.sample.robots[0].path.shape == ((16,) if step else (0,))
    assert [it.sample.n_lost for it in found[-2:]] == [0, 3] and found[-1].seconds == 5.5
    assert isinstance(found[-1].sample, Frame)
    found[-1].sample.robots[0].frame[:] = 1  # the caller may write to it
    assert list(recording.read(path, world=1)) == []


def test_recordings_of_version_2_are_read_unless_their_sensor_has_rings(path: Path) -> None:
    server = read(path, GOOD, strict=True)[0].server
    assert server.airspace == Airspace(radius=1) and server.protocol == 2
    assert server.model is not None and Model.from_toml(server.model).airspace.radius == 1
    header, first, *rest = parts()
    info = json.loads(zlib.decompress(first[24:], -15))
    for change in ({"n_rings": 2}, {"pays": "seen"}):
        changed = json.dumps(info | {"airspace": info["airspace"] | change}).encode()
        record = packed(1, zlib.compress(changed, wbits=-15))
        words = "expected a sensor with one observation matrix, and rewards for visited cells, got"
        refused(path, b"".join([header, record, *rest]), words)


def test_damaged_recordings_are_read_to_the_last_good_record(path: Path) -> None:
    ends = np.cumsum([len(part) for part in parts()])
    for length in (0, ends[1] + 1, ends[4], len(GOOD) - 1):
        whole = int((ends <= length).sum())
        offset = ends[whole - 1] if whole else 0
        words = f"cut short: expected a whole record at byte {offset}, got {length - offset} bytes"
        with pytest.warns(RecordingCutWarning, match=words):
            assert len(read(path, GOOD[:length])) == max(0, whole - 2)
        refused(path, GOOD[:length], words)
    damaged, offset = bytearray(GOOD), ends[4]
    damaged[offset + 30] ^= 0x10
    with pytest.warns(RecordingDamagedWarning, match=f"damaged at byte {offset}: checksum: .*"):
        assert len(read(path, bytes(damaged))) == 3
    refused(path, bytes(damaged), f"damaged at byte {offset}: checksum")


def test_files_that_are_not_recordings_are_refused(path: Path, tmp_path: Path) -> None:
    refused(path, b"PK\3\4 and so on, at length", 'expected it to begin with "EMBERREC", got "PK')
    os.mkfifo(fifo := tmp_path / "fifo")
    for path in (fifo, tmp_path):
        with fails("recording", match=f"expected a regular file, got {path}"):
            next(recording.read(path))
