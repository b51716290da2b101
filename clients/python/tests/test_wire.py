"""The wire format agrees with PROTOCOL.md: tables, codes, limits, examples; bad bytes fail."""

import copy
import dataclasses
import json
import pickle
import re
import struct
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import document
import numpy as np
from failures import fails
from processes import server

import emberwatch.client.connection
from emberwatch import _native, errors
from emberwatch.client import wire
from emberwatch.client.client import Client
from emberwatch.client.lease import Lease
from emberwatch.client.replies import (
    LeftBeliefInfo,
    ServerInfo,
    ServerStatus,
    WorldInfo,
    WorldStatus,
    record,
)
from emberwatch.errors import EmberwatchError

LAYOUTS = document.layouts()
EXAMPLES = document.examples()
HELLO, *HELLOS = (message for message in EXAMPLES if message.get("reply") == "hello")
SIZES = {"height": 3, "width": 5, "n_moves": 4, "n_worlds": 1, "n_robots": 2}
#: The example with all fields about land.
LANDED = next(message for message in HELLOS if "airspace" in message)
LEFT = next(message for message in EXAMPLES if message.get("reply") == "belief")

#: The state of the world in that example.
RESULT = SimpleNamespace(world=SimpleNamespace(episode=1, step=2))

#: The belief of that example.
ONE = bytes([0, 0, 128, 63])


def replies(kind: str) -> list[dict[str, Any]]:
    return [message for message in EXAMPLES if message.get("reply") == kind]


class Wire:
    """A fake native connection that keeps the requests and returns prepared answers."""

    def __init__(self, hello: dict[str, Any]) -> None:
        self.info = json.dumps(hello)
        self.sent: list[dict[str, Any]] = []
        self.answer = ""

    def control(self, text: bytes, _what: str, _seconds: float) -> str:
        self.sent.append(json.loads(text))
        return self.answer


class Wired:
    def __init__(self, **hello: Any) -> None:
        self.wire = Wire(HELLO | SIZES | hello)
        with patch.object(emberwatch.client.connection._native, "Connection", lambda *_: self.wire):
            self.client = Client("nowhere")
        notes = SimpleNamespace(note=lambda *_: None)
        self.client.lease = lambda *_: notes
        grant = SimpleNamespace(lease=5179721184253228, ttl_millis=1000)
        self.lease = Lease(self.client, grant, (), range(0, 2))

    def say(self, reply: object) -> None:
        """Prepares the answer to any request."""
        self.wire.answer = reply if isinstance(reply, str) else json.dumps(reply)


WIRED = Wired()


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
    operations = [codes["operation", name] for name in ("step", "observe", "recall")]
    assert operations == [wire.STEP, wire.OBSERVE, wire.RECALL]
    flags = [codes["flag", name] for name in ("full_coverage", "team_frames")]
    assert flags == [wire.FULL_COVERAGE, wire.TEAM_FRAMES]
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
    n_frames = n_worlds if flags & wire.TEAM_FRAMES else n_robots
    payload = bytearray(64 * n_worlds + 48 * n_robots) + b"\xff" * 15 * n_frames
    return presented(first, n_robots, flags, 0, np.frombuffer(payload, np.uint8))


def presented(*answer: Any) -> wire.StepAnswer:
    return wire.StepAnswer(_native.Answer(2, 3, 5, *answer))


def test_answers_can_be_copied_pickled_and_printed() -> None:
    for answer in (answered(), answered(4, flags=wire.TEAM_FRAMES)):
        for other in (copy.deepcopy(answer), pickle.loads(pickle.dumps(answer))):
            assert repr(other) == repr(answer) and (other.frames == answer.frames).all()
            assert other.results.tobytes() == answer.results.tobytes()
    answer = answered(1, 1)
    assert repr(answer) == (
        "StepAnswer(first_robot=1, simulation_nanos=0, "
        f"frames=<uint8 (1, 3, 5)>, results=[{answer.result()}])"
    )
    assert repr(answered(4)).endswith("n_moves=0)), and 3 more])") and len(repr(answered(4))) < 500


def test_a_client_sends_the_documented_requests() -> None:
    def sent(call: Any, reply: object = replies("done")[0]) -> dict[str, Any]:
        wired.say(reply)
        call()
        return wired.wire.sent[-1]

    wired = Wired()
    lease = wired.lease
    asked = [message for message in EXAMPLES if "op" in message]
    others = [message for message in asked if message["op"] != "hello"]
    got = [
        sent(lambda: wired.client.acquire(0, 2, ttl=60), replies("lease")[0]),
        sent(lease.renew),
        sent(lambda: lease.reset([42]), replies("reset")[0]),
        sent(wired.client.status, replies("status")[0]),
        sent(lambda: wired.client.snapshot("/tmp/lab.snapshot"), replies("snapshot")[0]),
        sent(lambda: lease.restore("/tmp/lab.snapshot"), replies("restored")[0]),
        sent(lambda: lease.fork(0, 1), replies("restored")[1]),
        sent(lambda: lease.leave_belief(RESULT, LEFT["kind"], ONE)),
        sent(wired.client.belief, LEFT),
        sent(lease.release),
        sent(wired.client.shutdown),
    ]
    assert asked[0]["op"] == "hello" and got == others


def test_errors_name_the_python_keyword() -> None:
    (error,) = replies("error")
    message = error["message"].replace('"takeover": true', "takeover=True")
    assert str(errors.refusal(10, error["detail"], error["message"])) == message


#: Changes of the documented land that make it invalid.
NO_LAND: list[tuple[str, Any]] = [
    ("airspace", []),
    *(("airspace", {"radius": it}) for it in (9, None, 1.0)),
    *(("airspace", {"no_fly": it}) for it in ([[0, 0, 2], [0, 0, 0]], [[0, 0, 1]], "beside.npy")),
]


def test_land_that_does_not_fit_the_grid_is_a_bad_answer() -> None:
    for key, change in NO_LAND:
        told = {**LANDED[key], **change} if change else change
        with fails("bad_answer", "an 'airspace' of the grid"):
            record(ServerInfo, HELLO | LANDED | {key: told})


def test_a_record_has_every_documented_key() -> None:
    status, reset = replies("status")[0], replies("reset")[0]
    for kind, message in (
        (ServerInfo, HELLO | LANDED),
        (ServerStatus, status),
        (WorldInfo, reset["worlds"][0]),
        (LeftBeliefInfo, LEFT),
        (WorldStatus, status["worlds"][0]),
    ):
        names = {field.name for field in dataclasses.fields(kind)}
        assert names == set(message) - {"reply"}
    unknown = HELLO | LANDED | {"colour": "red"}
    assert record(ServerInfo, unknown) == record(ServerInfo, HELLO | LANDED)


def test_malformed_replies_are_refused() -> None:
    world = {"world": 0, "step": 0, "seed": None, "episode": 0, "robots": [[0, 0]]}
    granted = {"lease": 1, "ttl_millis": 1, "worlds": []}
    for reply in (
        *("", "{", "[" * 100_000, "[]", "null", "7", '"ok"', {}, {"reply": "done"}),
        *({**granted, "worlds": worlds} for worlds in ({}, [1], [{"world": 0}], [world])),
        *({**granted, **change} for change in ({"lease": "x"}, {"ttl_millis": None})),
    ):
        WIRED.say(reply)
        with fails("bad_answer"):
            WIRED.client.acquire()
    for name in ("pid", "height", "observations", "model", "coverage"):
        with fails("bad_answer", match=name):
            Wired(**{name: {}})


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
