"""The wire format agrees with PROTOCOL.md: tables, codes, limits, examples; bad bytes fail."""

import re

import document
import numpy as np
from processes import server

import emberwatch
from emberwatch import _native, errors
from emberwatch.client import wire
from emberwatch.errors import EmberwatchError

LAYOUTS = document.layouts()


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


def test_errors_name_the_python_keyword() -> None:
    (error,) = (message for message in document.examples() if message.get("reply") == "error")
    message = error["message"].replace('"takeover": true', "takeover=True")
    assert str(errors.refusal(10, error["detail"], error["message"])) == message


def test_a_server_answers_as_in_the_worked_example() -> None:
    flags = re.search(r"^`emberwatch-server (.*?)`, then hello", document.PROTOCOL, re.MULTILINE)
    assert flags
    pairs = re.findall(r"--(\S+) (\S+)", flags[1])
    started = server(**{name.replace("-", "_"): value for name, value in pairs})
    message, values = document.worked_example("StepReply")
    paths = document.worked_example("StepRequest")[0][LAYOUTS["StepRequest"].size + 8 :]
    with emberwatch.connect(started.instance) as client, client.acquire(0, 2) as lease:
        answer = lease.step(np.frombuffer(paths, np.uint8).reshape(2, -1))
    payload = message[LAYOUTS["StepReply"].size :]
    assert answer.worlds.tobytes() + answer.robots.tobytes() == payload[: 64 + 2 * 48]
    assert answer.frames.tobytes() == payload[64 + 2 * 48 :]
    (world, first), (same, second) = answer.result(0), answer.result(1)
    told = [item for it in (world, first, second) for item in it._asdict().items()]
    read = [(name, f"{value:.12g}") for name, value in told]
    for robot, row in np.ndindex(2, 3):
        cells = answer.frames[robot, row].tolist()
        shown = " ".join("-" if cell == 255 else str(cell) for cell in cells)
        read.append((f"frame {robot} row {row}", shown))
    assert world == same and read == values[len(LAYOUTS["StepReply"].fields) :]
    for each, result in zip(answer.results, (first, second), strict=True):
        assert (tuple(each["world"]), tuple(each["robot"])) == (world, result)
    assert repr(answer) == f"<StepAnswer of robots 0 to 1, the first: {answer.result()}>"
