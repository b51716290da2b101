"""Writes recordings of a team byte by byte, so that tests choose what the robots do."""

import json
import struct
import zlib
from pathlib import Path

import numpy as np

HEIGHT, WIDTH = 24, 32
#: The states of robots. Robot n has state n modulo 3.
STATES = ("flew", "hovered", "late")

#: A path that goes eight cells right and four down, and the path back.
THERE, BACK = [3] * 8 + [1] * 4, [0] * 4 + [2] * 8

#: The header of a record, without its checksum (PROTOCOL.md).
_RECORD = struct.Struct("=QIII")
_FRAME = struct.Struct("=IIQIIIIQQQdQQIIIHH")
_ROBOT = struct.Struct("=ddIIIIIIII")
_MOVES = np.array([(-1, 0), (1, 0), (0, -1), (0, 1)])


def write_recording(file: Path, n_robots: int, n_steps: int, nanos: int = 0) -> None:
    """Writes steps of robots that start seven rows and ten columns apart, modulo the grid size.

    All frames are recorded `nanos` nanoseconds after the server's record.
    """
    cells = np.array([(4 + 7 * robot, 5 + 10 * robot) for robot in range(n_robots)])
    cells %= (HEIGHT, WIDTH)
    frames = [(2, _frame(step, cells)) for step in range(1, n_steps + 1)]
    totals = dict.fromkeys(["n_servers", "n_truths", "n_lost_frames", "n_lost_truths"], 0)
    end = (4, json.dumps(totals | {"n_servers": 1, "n_frames": n_steps}).encode())
    parts = [struct.pack("=8sII", b"EMBERREC", 2, 0)]
    for kind, body in [(1, json.dumps(_server(n_robots)).encode()), *frames, end]:
        compress = zlib.compressobj(wbits=-15)
        stored = compress.compress(body) + compress.flush()
        head = _RECORD.pack(nanos * (kind != 1), kind, len(stored), 0)
        parts += [head, zlib.crc32(stored, zlib.crc32(head)).to_bytes(4, "little"), stored]
    file.write_bytes(b"".join(parts))


def _server(n_robots: int) -> dict[str, object]:
    names = ["normal", "latent", "fire"]
    grid = {"height": HEIGHT, "width": WIDTH, "n_moves": len(THERE)}
    counts = {"n_worlds": 1, "n_robots": n_robots, "n_observations": 3, "max_clients": 16}
    times = {"burn_in": 0, "max_steps": 0, "lease_millis": 30_000, "deadline_millis": 50}
    rest = {"observations": names, "model": None, "coverage": "path", "publish_truth": False}
    return {"protocol": 3, "build": "0.1.0", "pid": 1} | grid | counts | times | rest


def _frame(step: int, cells: np.ndarray) -> bytes:
    """Returns the body of a frame. Also updates the cells of the robots that fly."""
    robots = [STATES[robot % 3] for robot in range(len(cells))]
    hovered, late = (sum((state == of) << i for i, state in enumerate(robots)) for of in STATES[1:])
    results, frames, paths = b"", b"", b""
    for cell, state in zip(cells, robots, strict=True):
        start = cell.tolist()
        frame = np.full((HEIGHT, WIDTH), 255, np.uint8)
        path = (THERE if step % 2 else BACK) if state == "flew" else []
        for move in path:
            cell[:] = np.clip(cell + _MOVES[move], 0, (HEIGHT - 1, WIDTH - 1))
            frame[tuple(cell)] = cell.sum() % 3
        n_visited, n_hits = np.sum(frame != 255), np.sum(frame == 2)
        places = (*start, *cell.tolist(), bool(path), len(path))
        results += _ROBOT.pack(n_hits, n_hits, n_visited, n_hits, *places)
        frames += frame.tobytes()
        paths += bytes(path)
    team = (4.5, hovered, late, 5, 12, 4, 0, 0)
    header = _FRAME.pack(2, 0, step - 1, 0, len(cells), HEIGHT, WIDTH, step, 7, 0, *team)
    return header + results + frames + paths
