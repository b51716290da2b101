"""The wire format agrees with PROTOCOL.md: tables, codes, limits, examples; bad bytes fail."""

import copy
import pickle
import re
import struct
from typing import Any

import document
import numpy as np
from processes import server

import emberwatch
from emberwatch import _native, errors
from emberwatch.client import wire
from emberwatch.errors import EmberwatchError

LAYOUTS = document.layouts()

#: A flag of requests.
TEAM_FRAMES = 2


def test_every_status_has_an_error_with_name_code_and_detail() -> None:
    ok, *refusals = document.table("| status | code |")
    assert (ok[:2], _native.explain(0, 0)) == (["ok", "0"], None)
    for name, status, detail, *_ in refusals:
        error = errors.refusal(int(status), 7531)
        assert (error.code, error.detail) == (name, 7531)
        tells = any(words in str(error) for words in ("7531", "0 to 7530", "8 KiB"))
        assert tells == (detail != "0"), error
    assert "it expired or was released" in str(errors.refusal(9, 0))
    error = errors.refusal(24, 3)
    assert (type(error), error.code, error.detail) == (EmberwatchError, "unknown", 3)
    assert "24" in str(error)


def test_limits_and_values_match_the_document() -> None:
    limits = document.limits()
    assert wire.TRUTH_BUFFER == limits["TRUTH_BUFFER"]
    assert (_native.MAX_MOVES, _native.MAX_SIDE) == (limits["MAX_MOVES"], limits["MAX_SIDE"])
    rows = document.table("| kind | name | code |")
    codes = {(kind, name): int(code) for kind, name, code, _ in rows}
    assert sum(kind == "move" for kind, _ in codes) == wire.N_MOVES
    assert f"**{wire.UNOBSERVED} where nothing was" in document.PROTOCOL


def test_the_worked_answer_parses_to_its_annotations() -> None:
    message, values = document.worked_example("StepReply")
    reply = LAYOUTS["StepReply"]
    numbers = struct.unpack_from(reply.format, message)
    told = [(it.name, number) for it, number in zip(reply.fields, numbers, strict=True)]
    payload = np.frombuffer(message, np.uint8, offset=reply.size)
    answer = presented(0, 2, 0, dict(told)["simulation_nanos"], payload)
    (world, first), (same, second) = answer.result(0), answer.result(1)
    assert world == same and answer.simulation_nanos == dict(told)["simulation_nanos"]
    for result in (world, first, second):
        told += result._asdict().items()
    read = [(name, f"{value:.12g}") for name, value in told]
    for robot, row in np.ndindex(2, 3):
        cells = answer.frames[robot, row].tolist()
        shown = " ".join("-" if cell == 255 else str(cell) for cell in cells)
        read.append((f"frame {robot} row {row}", shown))
    assert read == values
    for each, result in zip(answer.results, (first, second), strict=True):
        assert (tuple(each["world"]), tuple(each["robot"])) == (world, result)


def answered(n_robots: int = 2, first: int = 0, flags: int = 0) -> wire.StepAnswer:
    n_worlds = (n_robots + 1) // 2
    n_frames = n_worlds if flags & TEAM_FRAMES else n_robots
    payload = bytearray(64 * n_worlds + 48 * n_robots) + b"\xff" * 15 * n_frames
    return presented(first, n_robots, flags, 0, np.frombuffer(payload, np.uint8))


def presented(*answer: Any) -> wire.StepAnswer:
    return wire.StepAnswer(2, 3, 5, *answer)


def test_answers_can_be_copied_pickled_and_printed() -> None:
    for answer in (answered(), answered(4, flags=TEAM_FRAMES)):
        for other in (copy.deepcopy(answer), pickle.loads(pickle.dumps(answer))):
            assert repr(other) == repr(answer) and (other.frames == answer.frames).all()
            assert other.results.tobytes() == answer.results.tobytes()
    answer = answered(1, 1)
    assert repr(answer) == (
        "StepAnswer(first_robot=1, simulation_nanos=0, "
        f"frames=<uint8 (1, 3, 5)>, results=[{answer.result()}])"
    )
    assert repr(answered(4)).endswith("n_moves=0)), and 3 more])") and len(repr(answered(4))) < 500


def test_errors_name_the_python_keyword() -> None:
    (error,) = (message for message in document.examples() if message.get("reply") == "error")
    message = error["message"].replace('"takeover": true', "takeover=True")
    assert str(errors.refusal(10, error["detail"], error["message"])) == message


def test_a_server_answers_as_in_the_worked_example() -> None:
    flags = re.search(r"^`emberwatch-server (.*?)`, then hello", document.PROTOCOL, re.MULTILINE)
    assert flags
    pairs = re.findall(r"--(\S+) (\S+)", flags[1])
    started = server(**{name.replace("-", "_"): value for name, value in pairs})
    message, _ = document.worked_example("StepReply")
    paths = document.worked_example("StepRequest")[0][LAYOUTS["StepRequest"].size + 8 :]
    with emberwatch.connect(started.instance) as client, client.acquire(0, 2) as lease:
        answer = lease.step(np.frombuffer(paths, np.uint8).reshape(2, -1))
    payload = message[LAYOUTS["StepReply"].size :]
    assert answer.worlds.tobytes() + answer.robots.tobytes() == payload[: 64 + 2 * 48]
    assert answer.frames.tobytes() == payload[64 + 2 * 48 :]
