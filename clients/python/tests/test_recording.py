"""Recordings: what Python reads of them, and what it says when something is missing."""

import json
import re
import struct
import subprocess
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import document
import numpy as np
import pytest
from failures import fails
from headers import header
from hypothesis import given
from hypothesis import strategies as st
from processes import PATIENCE, eventually, find, server, unused_instance

import emberwatch
from emberwatch.client import recording, wire
from emberwatch.client.observer import Frame, Truth
from emberwatch.client.recording import Record, RecordingCutWarning, RecordingDamagedWarning

INFO = document.examples()[1] | {"n_robots": 2, "deadline_millis": 0}
TOTALS = {"n_servers": 1, "n_frames": 2, "n_truths": 1, "n_lost_frames": 3, "n_lost_truths": 0}
FILE_HEADER = struct.pack("=8sII", b"EMBERREC", 2, 0)


def deflated(body: bytes) -> bytes:
    compressor = zlib.compressobj(wbits=-15)
    return compressor.compress(body) + compressor.flush()


def packed(kind: int, stored: bytes, n_lost: int = 0, nanos: int = 1_500_000_000) -> bytes:
    head = struct.pack("=QIII", nanos, kind, len(stored), n_lost)
    return head + struct.pack("=I", zlib.crc32(head + stored)) + stored


def frame(sequence: int, n_lost: int = 0, n_moves: int = 4, **changes: int) -> bytes:
    """Robot 0 was late; robot 1 flew and saw something in its last cell."""
    sizes = {"height": 3, "width": 5, "n_robots": 2} | changes
    result = wire.WORLD.pack(7, 0, 0, 1.0, 0, 1, 0, 4, 1, 0, 0)
    head = header("FrameHeader", sequence=sequence, result=result, **sizes)
    robots = wire.ROBOT.pack(0, 0, 0, 0, 1, 1, 1, 1, 0, 0)
    robots += wire.ROBOT.pack(1, 1, 4, 1, 0, 0, 2, 4, 1, n_moves)
    frames = b"\xff" * 15 + b"\xff" * 14 + b"\2"
    return packed(2, deflated(head + robots + frames + b"\0\1\2\3"), n_lost)


SERVER = packed(1, deflated(json.dumps(INFO).encode()), nanos=0)
SHORT = packed(1, deflated(json.dumps(INFO | {"n_moves": 3}).encode()), nanos=0)
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


def test_a_recording_is_read_in_order_with_its_losses(path: Path) -> None:
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
    flew.frame[:] = 1  # your own to write to


def test_a_recording_cut_anywhere_is_read_up_to_its_last_whole_record(path: Path) -> None:
    ends = np.cumsum([len(part) for part in PARTS])
    for length in range(len(GOOD)):
        whole = int((ends <= length).sum())
        offset = ends[whole - 1] if whole else 0
        words = f"cut short: expected a whole record at byte {offset}, got {length - offset} bytes"
        with pytest.warns(RecordingCutWarning, match=words):
            assert len(read(path, GOOD[:length])) == max(0, whole - 2)
        refused(path, GOOD[:length], words)


def test_a_changed_byte_anywhere_is_noticed(path: Path) -> None:
    for position in range(len(GOOD)):
        content = bytearray(GOOD)
        content[position] ^= 0x10
        with fails("recording"):
            read(path, bytes(content), strict=True)


def test_a_damaged_recording_is_read_up_to_the_damage(path: Path) -> None:
    damaged = bytearray(GOOD)
    offset = sum(map(len, PARTS[:4]))
    damaged[offset + 30] ^= 0x10
    words = rf"damaged at byte {offset}: checksum: .*; good before it: 1 steps"
    with pytest.warns(RecordingDamagedWarning, match=words):
        first, hidden = read(path, bytes(damaged))
    assert isinstance(first.sample, Frame) and isinstance(hidden.sample, Truth)
    refused(path, bytes(damaged), f"damaged at byte {offset}: checksum")


@pytest.mark.parametrize(
    "content, words",
    [
        (b"PK\3\4 and so on, at length", 'expected it to begin with "EMBERREC", got "PK'),
        (b"EMBERREC\1" + bytes(7), "version: expected 2, got 1"),
        (b"EMBERREC\0\0\0\2" + bytes(4), "version: expected 2, got 33554432"),
        (b"EMBERREC\2\0\0\0\1\0\0\0", "expected 0 in byte 12 to 15, got 1"),
        (FILE_HEADER + frame(0), "at byte 16: expected a server before its samples"),
        (FILE_HEADER + packed(5, deflated(b"")), "kind: expected 1 to 4, got 5"),
        (FILE_HEADER + packed(2, deflated(b"short")), "sample: expected 96 bytes, got 5"),
        (FILE_HEADER + packed(1, deflated(b"{}")), "missing field"),
        (FILE_HEADER + packed(1, deflated(b"[" * 100_000)), "at byte 16"),
        (FILE_HEADER + packed(1, b"\xff\xff"), "expected deflate"),
        (FILE_HEADER + packed(1, deflated(b"{}") + b"more"), "one deflate stream"),
        (FILE_HEADER + packed(2, deflated(bytes(50 << 20))), "at most 17042528 bytes, got more"),
        (FILE_HEADER + struct.pack("=QIIII", 0, 2, 2**32 - 1, 0, 0), "bytes, got 4294967295"),
        (FILE_HEADER + SERVER + frame(0, n_moves=3), "payload bytes: expected 129, got 130"),
        (FILE_HEADER + SERVER + frame(0, n_robots=0), "robots: expected 1 to 64, got 0"),
        (FILE_HEADER + SERVER + frame(0, n_robots=65), "robots: expected 1 to 64, got 65"),
        (FILE_HEADER + SERVER + frame(0, n_robots=1), "payload bytes: expected 63, got 130"),
        (FILE_HEADER + SERVER + frame(0, first_robot=2), "first robot: expected 0, got 2"),
        (FILE_HEADER + SHORT + frame(0), "path: expected 0 or 3 moves, got 4"),
        (FILE_HEADER + SERVER + frame(0, height=5, width=3), "grid: expected 3 x 5, got 5 x 3"),
        (FILE_HEADER + SERVER + frame(0, world=1), "world: expected one below 1, got 1"),
        (FILE_HEADER + SERVER + frame(0) + END, "totals: expected"),
        (FILE_HEADER + frame(0)[:0] + SERVER + HIDDEN + SERVER, "time: expected at least"),
        (GOOD + b"x", "nothing behind the end"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_no_recording_is_refused(path: Path, content: bytes, words: str) -> None:
    refused(path, content, words)


@given(st.binary(max_size=200), st.booleans(), st.integers(0, 5))
def test_random_bytes_are_never_read_whole(
    tmp_path_factory: pytest.TempPathFactory, noise: bytes, packs: bool, kind: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "noise.recording"
    content = FILE_HEADER + (packed(kind, deflated(noise)) if packs else noise)
    with fails("recording"):
        read(path, content, strict=True)


@contextmanager
def program(*arguments: object) -> Iterator[subprocess.Popen[bytes]]:
    """Runs `emberwatch-server` with these arguments; ends it."""
    process = subprocess.Popen([find("emberwatch-server"), *map(str, arguments)])
    try:
        yield process
    finally:
        process.kill()
        process.wait(PATIENCE)


def test_what_a_recorder_wrote_is_what_the_server_answered(path: Path) -> None:
    started = server(worlds=2, robots=2, publish_truth=True)
    flags = ("--instance", started.instance, "--out", path, "--truth", "--steps", 20)
    with program("record", *flags) as recorder:
        assert eventually(lambda: started.status().n_observers == 1)
        lease = started.connect().acquire(2, 2)
        paths = np.random.default_rng(0).integers(0, 4, (20, 2, 6))
        answers = [lease.step(moves) for moves in paths]
        assert recorder.wait(PATIENCE) == 0
    samples = [record.sample for record in recording.read(path, world=1)]
    # By step: an observer that is greeted late gets a frame twice.
    frames = {it.result.step: it for it in samples if isinstance(it, Frame)}
    truths = {it.step: it for it in samples if isinstance(it, Truth)}
    assert set(range(1, 21)) <= set(frames)
    for step, (answer, moves) in enumerate(zip(answers, paths, strict=True), 1):
        frame_ = frames[step]
        assert len(frame_.robots) == 2 and frame_.n_lost == 0
        for index, robot in enumerate(frame_.robots):
            assert (frame_.result, robot.result) == answer.result(index)
            assert (robot.frame == answer.frames[index]).all()
            assert (robot.path == moves[index]).all()
        n_fires = int((truths[frame_.result.step].states == 2).sum())
        assert n_fires == frame_.result.n_target_cells


def test_a_replay_is_observed_like_a_server_and_refuses_to_act(path: Path) -> None:
    path.write_bytes(GOOD)
    instance = unused_instance()
    with program("replay", path, "--instance", instance, "--loop") as replay:
        with emberwatch.observe(instance, timeout=PATIENCE) as observer:
            seen = [frame.n_lost for frame, _ in zip(observer, range(4), strict=False)]
            with emberwatch.connect(instance) as client:
                assert client.info.pid == replay.pid
                with fails("not_permitted", match="a recording is replayed"):
                    client.acquire()
                with fails("not_permitted", match="takes no steps"):
                    client.observe()
                client.shutdown()
        assert replay.wait(PATIENCE) == 0
    # What the recorder lost is missing here too; a smaller number is a new round.
    assert seen == [0, 3, 0, 3]
