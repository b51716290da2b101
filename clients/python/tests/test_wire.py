"""The wire against PROTOCOL.md: tables, codes, limits, examples; and bytes that make no sense."""

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
import pytest
from failures import fails
from hypothesis import given
from hypothesis import strategies as st
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
#: What is in payloads: as bytes, as an array, as a tuple.
RESULTS = {
    "WorldResult": (wire.WORLD, wire.WORLD_DTYPE, wire.WorldResult),
    "RobotResult": (wire.ROBOT, wire.ROBOT_DTYPE, wire.RobotResult),
}
EXAMPLES = document.examples()
HELLO, *HELLOS = (message for message in EXAMPLES if message.get("reply") == "hello")
#: With all that land adds to it.
LANDED = next(message for message in HELLOS if "airspace" in message)
LEFT = next(message for message in EXAMPLES if message.get("reply") == "belief")

#: Where the world stands in that example.
RESULT = SimpleNamespace(world=SimpleNamespace(episode=1, step=2))

#: The belief of that example.
ONE = bytes([0, 0, 128, 63])


def replies(kind: str) -> list[dict[str, Any]]:
    return [message for message in EXAMPLES if message.get("reply") == kind]


class Wire:
    """In place of a native connection: keeps the requests and answers what it is told to."""

    def __init__(self, hello: dict[str, Any]) -> None:
        self.info = json.dumps(hello)
        self.sent: list[dict[str, Any]] = []
        self.answer = ""

    def control(self, text: bytes, _what: str, _seconds: float) -> str:
        self.sent.append(json.loads(text))
        return self.answer


class Wired:
    """A client of a world of two robots on such a connection."""

    def __init__(self, **hello: Any) -> None:
        sizes = {"height": 3, "width": 5, "n_moves": 4, "n_worlds": 1, "n_robots": 2}
        self.wire = Wire(HELLO | sizes | hello)
        with patch.object(emberwatch.client.connection._native, "Server", lambda *_: self.wire):
            self.client = Client("nowhere")
        notes = SimpleNamespace(note=lambda *_: None)
        self.client.lease = lambda *_: notes
        grant = SimpleNamespace(lease=5179721184253228, ttl_millis=1000)
        self.lease = Lease(self.client, grant, (), range(0, 2))

    def say(self, reply: object) -> None:
        """Lets it answer this, to whatever request."""
        self.wire.answer = reply if isinstance(reply, str) else json.dumps(reply)


WIRED = Wired()


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_is_laid_out_as_documented(name: str) -> None:
    layout, (packed, dtype, kind) = LAYOUTS[name], RESULTS[name]
    assert packed.format == layout.format
    assert packed.size == dtype.itemsize == layout.size
    kinds = {"u16": "<u2", "u32": "<u4", "u64": "<u8", "f64": "<f8"}
    fields = {field.name: (np.dtype(kinds[field.of]), field.offset) for field in layout.fields}
    assert dict(dtype.fields) == fields
    assert [*kind._fields] == list(fields)


def test_every_status_has_a_refusal_with_its_name_and_code() -> None:
    ok, *refusals = document.table("| status | code |")
    assert (ok[:2], _native.explain(0, 0)) == (["ok", "0"], None)
    for name, status, *_ in refusals:
        error = errors.refusal(int(status), 7)
        assert (error.code, error.detail) == (name, 7)


def test_a_refusal_says_the_detail_that_the_table_gives_it() -> None:
    for row in document.table("| status | code |")[1:]:
        sentence = str(errors.refusal(int(row[1]), 7531))
        tells = any(words in sentence for words in ("7531", "0 to 7530", "8 KiB"))
        assert tells == (row[2] != "0"), sentence
    assert "it expired or was released" in str(errors.refusal(9, 0))


def test_an_unknown_status_is_a_refusal() -> None:
    for code in (24, 2**32 - 1):
        error = errors.refusal(code, 3)
        assert (type(error), error.code, error.detail) == (EmberwatchError, "unknown", 3)
        assert str(code) in str(error)


def test_the_limits_are_the_documented_ones() -> None:
    limits = document.limits()
    assert wire.TRUTH_BUFFER == limits["TRUTH_BUFFER"]
    assert (_native.MAX_MOVES, _native.MAX_SIDE) == (limits["MAX_MOVES"], limits["MAX_SIDE"])


def test_the_values_are_the_documented_ones() -> None:
    rows = document.table("| kind | name | code |")
    codes = {(kind, name): int(code) for kind, name, code, _ in rows}
    operations = [codes["operation", name] for name in ("step", "observe", "recall")]
    assert operations == [wire.STEP, wire.OBSERVE, wire.RECALL]
    flags = [codes["flag", name] for name in ("full_coverage", "team_frames")]
    assert flags == [wire.FULL_COVERAGE, wire.TEAM_FRAMES]
    assert sum(kind == "move" for kind, _ in codes) == wire.N_MOVES
    assert f"**{wire.UNOBSERVED} where nothing was" in document.PROTOCOL


def test_the_worked_answer_reads_as_what_stands_beside_it() -> None:
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
    """An answer about worlds of two robots."""
    n_worlds = (n_robots + 1) // 2
    n_frames = n_worlds if flags & wire.TEAM_FRAMES else n_robots
    payload = bytearray(64 * n_worlds + 48 * n_robots) + b"\xff" * 15 * n_frames
    return presented(first, n_robots, flags, 0, np.frombuffer(payload, np.uint8))


def presented(*answer: Any) -> wire.StepAnswer:
    """An answer from worlds of two robots on 3 x 5 cells."""
    return wire.StepAnswer(_native.Answer(2, 3, 5, *answer))


def test_a_frame_is_your_own_to_write_to() -> None:
    answer = answered()
    answer.frames[:] = 7
    assert answer.result().world.step == 0 and (answer.frames == 7).all()


def test_an_answer_can_be_copied_and_pickled() -> None:
    for answer in (answered(), answered(4, flags=wire.TEAM_FRAMES)):
        for other in (copy.deepcopy(answer), pickle.loads(pickle.dumps(answer))):
            assert repr(other) == repr(answer) and (other.frames == answer.frames).all()
            assert other.results.tobytes() == answer.results.tobytes()


def test_each_robot_is_in_its_world() -> None:
    for first, n_robots, worlds in ((0, 2, [0, 0]), (1, 1, [0]), (0, 4, [0, 0, 1, 1])):
        assert answered(n_robots, first).world_of.tolist() == worlds
    answer = answered(4, flags=wire.TEAM_FRAMES)
    assert (len(answer.worlds), len(answer.robots), answer.frames.shape) == (2, 4, (2, 3, 5))


def test_an_answer_is_shown_in_short() -> None:
    answer = answered(1, 1)
    assert repr(answer) == (
        "StepAnswer(first_robot=1, simulation_nanos=0, "
        f"frames=<uint8 (1, 3, 5)>, results=[{answer.result()}])"
    )
    assert repr(answered(4)).endswith("n_moves=0)), and 3 more])") and len(repr(answered(4))) < 500


def test_the_documented_requests_are_what_a_client_sends() -> None:
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


def test_the_documented_replies_become_records() -> None:
    wired = Wired()
    hello = dataclasses.asdict(wired.client.info)
    assert hello.pop("zones") is None and hello.pop("airspace")["radius"] == 0
    assert HELLO | hello | {"observations": HELLO["observations"]} == HELLO | {
        "height": 3,
        "width": 5,
        "n_moves": 4,
        "n_worlds": 1,
        "n_robots": 2,
    }
    wired.say(replies("lease")[0])
    lease = wired.client.acquire()
    assert (lease.number, lease.ttl) == (5179721184253228, 60.0)
    robots = ((0, 0), (2, 4))
    assert lease.start == (WorldInfo(world=0, step=0, seed=0, episode=0, robots=robots),)
    wired.say(replies("reset")[0])
    assert lease.reset() == (WorldInfo(world=0, step=0, seed=42, episode=1, robots=robots),)
    wired.say(LEFT)
    assert wired.client.belief() == (LEFT["kind"], 1, 2, ONE)
    wired.say(replies("status")[0])
    status = wired.client.status()
    (told,), (world,) = replies("status")[0]["worlds"], status.worlds
    assert (status.pid, status.n_steps, world.n_paths) == (14661, 2, told["n_paths"])
    assert world.holder_pids == tuple(told["holder_pids"]) and len(world.robots) == 2


def test_a_refusal_is_in_the_words_of_python() -> None:
    (error,) = replies("error")
    message = error["message"].replace('"takeover": true', "takeover=True")
    assert str(errors.refusal(10, error["detail"], error["message"])) == message


def test_unknown_keys_of_a_reply_are_ignored() -> None:
    assert Wired(colour="red").client.info.n_worlds == 1


def test_the_documented_land_is_read() -> None:
    info = record(ServerInfo, HELLO | LANDED)
    air = info.airspace
    assert (air.radius, air.n_rings, air.pays) == (2, 2, "visited")
    assert air.no_fly is not None and air.no_fly.dtype == np.bool_
    assert np.argwhere(air.no_fly).tolist() == [[0, 2]]
    assert info.zones is not None and info.zones.map.dtype == np.uint8
    assert (info.zones.names, info.zones.colors) == (("land", "water"), ("#b7a57a", "#6aa0c8"))
    assert info.zones.map.tolist() == LANDED["zones"]["map"]


#: Changes of the documented land that no grid has.
NO_LAND: dict[str, list[Any]] = {
    "airspace": [
        [],
        *({"radius": it} for it in (9, None, 1.0)),
        *({"n_rings": it} for it in (4, 0)),
        {"pays": "sold"},
        *({"no_fly": [[0, 0, it], [0, 0, 0]]} for it in (2, 0.5)),
        *({"no_fly": it} for it in ([[0, 0, 1]], [[0, 0, 1], [0, 0]], "beside.npy")),
    ],
    "zones": [
        *({"names": it} for it in (["land"], None)),
        {"colors": ["#b7a57a", "blue"]},
        *({"map": [[0, 0, 0], [0, 1, it]]} for it in (2, -1)),
        {"map": [0, 0, 0]},
    ],
}


@pytest.mark.parametrize("key", NO_LAND)
def test_land_that_no_grid_has_is_a_bad_answer(key: str) -> None:
    for change in NO_LAND[key]:
        told = {**LANDED[key], **change} if change else change
        with fails("bad_answer", "'airspace' and 'zones' of the grid"):
            record(ServerInfo, HELLO | LANDED | {key: told})


@pytest.mark.parametrize("kind", [ServerInfo, ServerStatus, WorldInfo, WorldStatus, LeftBeliefInfo])
def test_a_record_has_every_documented_key(kind: type[Any]) -> None:
    messages = {ServerInfo: HELLO | LANDED, ServerStatus: replies("status")[0]}
    messages |= {WorldInfo: replies("reset")[0]["worlds"][0]}
    messages |= {LeftBeliefInfo: LEFT}
    messages |= {WorldStatus: replies("status")[0]["worlds"][0]}
    names = {field.name for field in dataclasses.fields(kind)}
    assert names == set(messages[kind]) - {"reply"}


def garbled_control(reply: object) -> None:
    WIRED.say(reply)
    with fails("bad_answer"):
        WIRED.client.acquire()


def test_replies_that_make_no_sense_are_refused() -> None:
    world = {"world": 0, "step": 0, "seed": None, "episode": 0, "robots": [[0, 0]]}
    granted = {"lease": 1, "ttl_millis": 1}
    for reply in ("", "{", "[" * 100_000, "[]", "null", "7", '"ok"'):
        garbled_control(reply)
    for reply in ({}, {"reply": "done"}, granted):
        garbled_control(reply)
    for worlds in ({}, [1], [{"world": 0}], [world]):
        garbled_control({**granted, "worlds": worlds})
    for change in ({"lease": "x"}, {"ttl_millis": None}):
        garbled_control({**granted, "worlds": [], **change})
    for name in ("pid", "height", "observations", "model", "coverage"):
        with fails("bad_answer", match=name):
            Wired(**{name: {}})


@given(st.text() | st.recursive(st.none() | st.integers(), st.lists).map(json.dumps))
def test_random_text_is_no_lease(reply: str) -> None:
    garbled_control(reply)


def test_the_worked_example_is_what_a_server_answers() -> None:
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
