"""The wire against PROTOCOL.md: tables, codes, limits, examples; and bytes that make no sense."""

import ctypes
import dataclasses
import json
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
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

import emberwatch.connection
from emberwatch import errors, observer, wire
from emberwatch.client import Client
from emberwatch.errors import EmberwatchError
from emberwatch.lease import Lease
from emberwatch.replies import LeftBeliefInfo, ServerInfo, ServerStatus, WorldInfo, WorldStatus
from emberwatch.turn import pid_namespace

LAYOUTS = document.layouts()
SCALARS = {"u16": ctypes.c_uint16, "u32": ctypes.c_uint32, "u64": ctypes.c_uint64}
TYPES = SCALARS | {"WorldResult": ctypes.c_ubyte * 64}
HEADERS = [
    wire.StepRequest,
    wire.StepReply,
    wire.ControlRequest,
    wire.ControlReply,
    wire.FrameHeader,
    wire.TruthHeader,
    wire.AgentHeader,
]
#: What is in payloads: as bytes, as an array, as a tuple.
RESULTS = {
    "WorldResult": (wire.WORLD, wire.WORLD_DTYPE, wire.WorldResult),
    "RobotResult": (wire.ROBOT, wire.ROBOT_DTYPE, wire.RobotResult),
}
EXAMPLES = document.examples()
HELLO = next(message for message in EXAMPLES if message.get("reply") == "hello")
LEFT = next(message for message in EXAMPLES if message.get("reply") == "belief")

#: Where the world stands in that example.
RESULT = SimpleNamespace(world=SimpleNamespace(episode=1, step=2))

#: The belief of that example.
ONE = bytes([0, 0, 128, 63])


def replies(kind: str) -> list[dict[str, Any]]:
    return [message for message in EXAMPLES if message.get("reply") == kind]


class Port:
    """In place of a server's channel: keeps the requests and answers what it is told to."""

    def __init__(self) -> None:
        self.sent: list[tuple[bytes, bytes]] = []
        self.answer: Any = None
        self.header: type[wire.Header] = wire.Header

    def exchange(self, header: bytes, payload: bytes, *_: object) -> tuple[Any, bytearray]:
        self.sent.append((header, payload))
        reply, answer = self.answer(header) if callable(self.answer) else self.answer
        return self.header.from_buffer_copy(reply), bytearray(answer)

    def create(self, **_: object) -> None:
        pass

    def close(self) -> None:
        pass


class Wired:
    """A client of a world of two robots on two such ports, after a handshake as in PROTOCOL.md."""

    def __init__(self, **hello: Any) -> None:
        self.control, self.step = Port(), Port()
        sizes = {"height": 3, "width": 5, "n_moves": 4, "n_worlds": 1, "n_robots": 2}
        self.say(HELLO | sizes | {"pid_namespace": pid_namespace()} | hello)
        self.peer = SimpleNamespace(
            listener_low=0, listener_high=0, watch=lambda _: None, close=lambda: None
        )
        with self._in_place():
            self.client = Client("nowhere")
        grant = SimpleNamespace(lease=5, ttl_millis=1000)
        self.lease = Lease(self.client, grant, (), range(0, 2))

    def say(self, reply: object, status: int = 0) -> None:
        """Lets `control` answer this, to whatever request."""
        text = reply if isinstance(reply, bytes) else json.dumps(reply).encode()

        def answer(request: bytes) -> tuple[bytes, bytes]:
            _, _, sequence, _, _ = wire.CONTROL_REQUEST.unpack(request)
            return struct.pack("=IIQ", 2, status, sequence), text

        self.control.answer = answer

    @contextmanager
    def _in_place(self) -> Iterator[None]:
        def port(_peer: object, service: str, headers: Any) -> Port:
            made: Port = getattr(self, service)
            made.header = headers[1]
            return made

        names = ("clean_up", "check", "close", "remember_files", "fill_ports")
        node = SimpleNamespace(instance="nowhere", **dict.fromkeys(names, lambda: None))
        with (
            patch.object(emberwatch.connection, "Node", lambda _: node),
            patch.object(emberwatch.connection, "Peer", lambda *_: self.peer),
            patch.object(emberwatch.connection, "RequestPort", port),
        ):
            yield


WIRED = Wired()


@pytest.mark.parametrize("header", HEADERS, ids=lambda header: header.__name__)
def test_a_header_is_laid_out_as_documented(header: type[wire.Header]) -> None:
    layout = LAYOUTS[header.__name__]
    assert header.type_name() == layout.type_name
    assert (ctypes.sizeof(header), ctypes.alignment(header)) == (layout.size, layout.alignment)
    fields = [(field.name, field.offset, field.size) for field in layout.fields]
    descriptors = [(name, getattr(header, name)) for name, _ in header._fields_]
    assert [(name, at.offset, at.size) for name, at in descriptors] == fields
    assert [kind for _, kind in header._fields_] == [TYPES[field.of] for field in layout.fields]
    assert struct.calcsize(layout.format) == layout.size


def test_every_documented_header_is_there() -> None:
    assert {header.__name__ for header in HEADERS} | set(RESULTS) == set(LAYOUTS)


def test_the_formats_are_the_documented_ones() -> None:
    assert wire.STEP_REQUEST.format == LAYOUTS["StepRequest"].format
    assert wire.CONTROL_REQUEST.format == LAYOUTS["ControlRequest"].format


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
    rows = [(row[0], int(row[1])) for row in document.table("| status | code |")]
    named = [(name, status) for status, (name, _) in enumerate(errors.STATUSES, start=1)]
    assert rows == [("ok", 0), *named]
    for name, status in named:
        error = errors.refusal(status, 7)
        assert (error.code, error.detail) == (name, 7)


def test_a_refusal_says_the_detail_that_the_table_gives_it() -> None:
    for row in document.table("| status | code |")[1:]:
        sentence = str(errors.refusal(int(row[1]), 7531))
        tells = "7531" in sentence or "0 to 7530" in sentence
        assert tells == (row[2] != "0"), sentence
    assert "it expired or was released" in str(errors.refusal(9, 0))


def test_an_unknown_status_is_a_refusal() -> None:
    for code in (24, 2**32 - 1):
        error = errors.refusal(code, 3)
        assert (type(error), error.code, error.detail) == (EmberwatchError, "unknown", 3)
        assert str(code) in str(error)


def test_the_limits_are_the_documented_ones() -> None:
    documented = {name: int(value) for name, value, _ in document.table("| limit | value |")}
    ours = {name: getattr(wire, name) for name in documented if hasattr(wire, name)}
    assert ours == {name: documented[name] for name in ours}
    # The others bind the server alone.
    assert set(documented) - set(ours) == {
        "MAX_CONTROL_BYTES",
        "MAX_MOVES",
        "MAX_SIDE",
        "MAX_ROBOT_NUMBERS",
        "MAX_TEAM_CELLS",
    }


def test_the_values_are_the_documented_ones() -> None:
    rows = document.table("| kind | name | code |")
    codes = {(kind, name): int(code) for kind, name, code, _ in rows}
    operations = [codes["operation", name] for name in ("step", "observe", "recall")]
    assert operations == [wire.STEP, wire.OBSERVE, wire.RECALL]
    flags = [codes["flag", name] for name in ("full_coverage", "team_frames")]
    assert flags == [wire.FULL_COVERAGE, wire.TEAM_FRAMES]
    assert sum(kind == "move" for kind, _ in codes) == wire.N_MOVES
    for sentence in (
        f"The version is {wire.VERSION}.",
        f"**{wire.UNOBSERVED} where nothing was",
    ):
        assert sentence in document.PROTOCOL


def test_the_worked_request_is_what_a_lease_sends() -> None:
    message, pairs = document.worked_example("StepRequest")
    values = dict(pairs)
    number = {name: int(text) for name, text in pairs if text.isdigit()}
    wired = Wired()
    wired.peer.listener_low = number["listener_low"]
    wired.peer.listener_high = number["listener_high"]
    wired.client._sequence = number["sequence"] - 1
    answer, _ = document.worked_example("StepReply")
    wired.step.answer = answer[:56], answer[56:]
    grant = SimpleNamespace(lease=number["lease"], ttl_millis=1)
    lease = Lease(wired.client, grant, (), range(2))
    names = ["up", "down", "left", "right"]
    paths = [[names.index(move) for move in values[f"path {row}"].split()] for row in range(2)]
    lease.step(paths)
    assert b"".join(wired.step.sent[-1]) == message
    assert lease.steps_of(lease.robots).tolist() == [1]


def test_the_worked_answer_reads_as_what_stands_beside_it() -> None:
    message, values = document.worked_example("StepReply")
    reply = wire.StepReply.from_buffer_copy(message[:56])
    answer = wire.StepAnswer(reply, bytearray(message[56:]), SHAPE)
    (world, first), (same, second) = answer.result(0), answer.result(1)
    assert world == same and answer.simulation_nanos == reply.simulation_nanos
    told = [(name, getattr(reply, name)) for name, _ in wire.StepReply._fields_]
    for result in (world, first, second):
        told += result._asdict().items()
    read = [(name, f"{value:.12g}") for name, value in told]
    for robot, row in np.ndindex(2, 3):
        cells = answer.frames[robot, row].tolist()
        shown = " ".join("-" if cell == 255 else str(cell) for cell in cells)
        read.append((f"frame {robot} row {row}", shown))
    assert read == values
    for record, result in zip(answer.results, (first, second), strict=True):
        assert (tuple(record["world"]), tuple(record["robot"])) == (world, result)


def answered(n_robots: int = 2, **changes: int) -> wire.StepAnswer:
    """A good answer about worlds of two robots."""
    n_worlds = (n_robots + 1) // 2
    reply = wire.StepReply(n_robots=n_robots, n_worlds=n_worlds, height=3, width=5, **changes)
    n_frames = n_worlds if reply.flags & wire.TEAM_FRAMES else n_robots
    payload = bytes(64 * n_worlds + 48 * n_robots) + b"\xff" * 15 * n_frames
    return wire.StepAnswer(reply, bytearray(payload), SHAPE)


def test_a_frame_is_your_own_to_write_to() -> None:
    answer = answered()
    answer.frames[:] = 7
    assert answer.result().world.step == 0 and (answer.frames == 7).all()


def test_each_robot_is_in_its_world() -> None:
    for first, n_robots, worlds in ((0, 2, [0, 0]), (1, 1, [0]), (0, 4, [0, 0, 1, 1])):
        assert answered(n_robots, first_robot=first).world_of.tolist() == worlds
    answer = answered(4, flags=wire.TEAM_FRAMES)
    assert (len(answer.worlds), len(answer.robots), answer.frames.shape) == (2, 4, (2, 3, 5))


def test_an_answer_is_shown_in_short() -> None:
    answer = answered(1, first_robot=1)
    assert repr(answer) == (
        "StepAnswer(first_robot=1, simulation_nanos=0, "
        f"frames=<uint8 (1, 3, 5)>, results=[{answer.result()}])"
    )
    assert repr(answered(4)).endswith("n_moves=0)), and 3 more])") and len(repr(answered(4))) < 500


def test_the_documented_requests_are_what_a_client_sends() -> None:
    def sent(call: Any, reply: object = replies("done")[0]) -> dict[str, Any]:
        wired.say(reply)
        call()
        return json.loads(wired.control.sent[-1][1])

    wired = Wired()
    lease = Lease(wired.client, SimpleNamespace(lease=5179721184253228, ttl_millis=1), (), range(2))
    got = [
        json.loads(wired.control.sent[0][1]) | {"client": "probe 0.1"},
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
    assert got == [message for message in EXAMPLES if "op" in message]


def test_the_documented_replies_become_records() -> None:
    wired = Wired()
    hello = dataclasses.asdict(wired.client.info)
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
    (error,) = replies("error")
    wired.say(error, status=10)
    with fails("busy") as raised:
        wired.client.acquire()
    message = error["message"].replace('"takeover": true', "takeover=True")  # in Python's terms
    assert (str(raised.value), raised.value.detail) == (message, error["detail"])
    assert str(errors.refusal(10, error["detail"])) == message


def test_a_server_of_another_pid_namespace_is_refused() -> None:
    with fails("pid_namespace", match="another PID namespace"):
        Wired(pid_namespace=1)


def test_unknown_keys_of_a_reply_are_ignored() -> None:
    assert Wired(colour="red").client.info.n_worlds == 1


@pytest.mark.parametrize("kind", [ServerInfo, ServerStatus, WorldInfo, WorldStatus, LeftBeliefInfo])
def test_a_record_has_every_documented_key(kind: type[Any]) -> None:
    messages = {ServerInfo: HELLO, ServerStatus: replies("status")[0]}
    messages |= {WorldInfo: replies("reset")[0]["worlds"][0]}
    messages |= {LeftBeliefInfo: LEFT}
    messages |= {WorldStatus: replies("status")[0]["worlds"][0]}
    names = {field.name for field in dataclasses.fields(kind)}
    assert names == set(messages[kind]) - {"reply"}


PATHS = [[0, 1, 2, 3]] * 2
SHAPE = wire.Shape(n_robots=2, n_moves=4, n_observations=3)


def step_reply(**changes: int) -> bytes:
    """The header of a good answer to the step that `WIRED` is about to send, changed."""
    fields = {"version": 2, "sequence": WIRED.client._sequence + 1, "n_robots": 2, "n_worlds": 1}
    return bytes(wire.StepReply(**(fields | {"height": 3, "width": 5} | changes)))


def garbled_step(header: bytes, payload: bytes, words: str | None = None) -> None:
    WIRED.step.answer = header, payload
    with fails("bad_answer", match=words):
        WIRED.lease.step(PATHS)


def garbled_control(reply: object) -> None:
    WIRED.say(reply)
    with fails("bad_answer"):
        WIRED.client.acquire()


def payload(hovered: int = 0, late: int = 0, n_moves: int = 4, cell: int = 255) -> bytes:
    world = wire.WORLD.pack(1, 0, 0, 0.0, hovered, late, 0, 0, 0, 0, 0)
    robots = [wire.ROBOT.pack(0, 0, 0, 0, 0, 0, 0, 0, 1, moves) for moves in (n_moves, 4)]
    return world + b"".join(robots) + b"\xff" * 29 + bytes([cell])


def test_a_good_answer_is_accepted() -> None:
    for good in (payload(), payload(hovered=1, n_moves=0), payload(late=3, cell=2)):
        WIRED.step.answer = step_reply(), good
        assert WIRED.lease.step(PATHS).frames.shape == (2, 3, 5)


@pytest.mark.parametrize("length", [0, 1, 63, 64, 189, 191, 380])
def test_a_step_answer_of_a_wrong_length_is_refused(length: int) -> None:
    garbled_step(step_reply(), bytes(length), f"expected 190 bytes, got {length}")


@pytest.mark.parametrize("value", [3, 4, 254])
def test_a_frame_with_an_impossible_value_is_refused(value: int) -> None:
    garbled_step(step_reply(), payload(cell=value), f"below 3 or 255, got {value}")


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"hovered": 4}, "robots that stayed: expected bits below 2, got 0x4"),
        ({"late": 2**63}, "robots that stayed: expected bits below 2, got 0x8000000000000000"),
        ({"n_moves": 3}, r"n_moves: expected 0 or 4, got \{"),
    ],
)
def test_robots_that_cannot_be_are_refused(changes: dict[str, int], words: str) -> None:
    garbled_step(step_reply(), payload(**changes), words)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"version": 3}, "expected version 2, got 3"),
        ({"version": 0}, "expected version 2, got 0"),
        ({"sequence": 0}, "expected sequence number"),
        ({"first_robot": 1}, "first robot"),
        ({"n_robots": 0}, "first robot"),
        ({"n_robots": 3}, "first robot"),
        ({"flags": 2}, "flags"),
        ({"n_worlds": 2}, "expected robots and their worlds, got 2 in 2"),
        ({"height": 5, "width": 3}, "height, width"),
        ({"height": 2**32 - 1, "width": 2**32 - 1, "n_robots": 2**32 - 1}, "height, width"),
    ],
)
def test_an_answer_to_something_else_is_refused(changes: dict[str, int], words: str) -> None:
    garbled_step(step_reply(**changes), payload(), words)


@pytest.mark.parametrize(
    "reply",
    [
        b"",
        b"{",
        b"\xff\xfe",
        b"[" * 100_000,
        b"[]",
        b"null",
        b"7",
        b'"ok"',
        {},
        {"reply": "done"},
        {"lease": "x", "ttl_millis": 1, "worlds": []},
        {"lease": 1, "ttl_millis": None, "worlds": []},
        {"lease": 1, "ttl_millis": 1},
        {"lease": 1, "ttl_millis": 1, "worlds": {}},
        {"lease": 1, "ttl_millis": 1, "worlds": [1]},
        {"lease": 1, "ttl_millis": 1, "worlds": [{"world": 0}]},
        {
            "lease": 1,
            "ttl_millis": 1,
            "worlds": [{"world": 0, "step": 0, "seed": None, "episode": 0, "robots": [[0, 0]]}],
        },
    ],
    ids=lambda reply: repr(reply)[:40],
)
def test_a_control_reply_that_makes_no_sense_is_refused(reply: object) -> None:
    garbled_control(reply)


@pytest.mark.parametrize("reply", [{}, {"detail": "x", "message": 5}, {"detail": None}])
def test_a_refusal_without_good_words_is_a_refusal_still(reply: object) -> None:
    WIRED.say(reply, status=9)
    with pytest.raises(errors.LeaseLostError, match="lease lost"):
        WIRED.client.status()


def test_a_control_reply_to_another_request_or_of_another_version_is_refused() -> None:
    for header in (struct.pack("=IIQ", 2, 0, 0), struct.pack("=IIQ", 1, 0, 0)):
        WIRED.control.answer = header, b"{}"
        with fails("bad_answer", match="expected"):
            WIRED.client.status()


@pytest.mark.parametrize("name", ["pid", "height", "observations", "model", "coverage"])
def test_a_handshake_that_makes_no_sense_is_refused(name: str) -> None:
    with fails("bad_answer", match=name):
        Wired(**{name: {}})


payloads = st.binary(max_size=300) | st.integers(0, 3).map(lambda n: bytes(n * 190))
numbers = st.integers(0, 4) | st.integers(0, 2**32 - 1)


@given(st.binary(min_size=56, max_size=56), payloads)
def test_random_bytes_are_no_answer(header: bytes, payload: bytes) -> None:
    WIRED.step.answer = header, payload
    with pytest.raises(EmberwatchError):
        WIRED.lease.step(PATHS)


@given(numbers, numbers, numbers, numbers, numbers, payloads)
def test_any_answer_is_taken_whole_or_refused_whole(
    first: int, n_robots: int, n_worlds: int, height: int, width: int, payload: bytes
) -> None:
    sizes = {"n_robots": n_robots, "n_worlds": n_worlds, "height": height, "width": width}
    reply = wire.StepReply(first_robot=first, **sizes)
    try:
        answer = wire.StepAnswer(reply, bytearray(payload), SHAPE)
    except EmberwatchError:
        return
    assert answer.frames.shape == (n_robots, height, width)
    assert (len(answer.worlds), len(answer.results)) == (n_worlds, n_robots)
    assert len(payload) == 64 * n_worlds + n_robots * (48 + height * width)


@given(st.binary() | st.recursive(st.none() | st.integers(), st.lists).map(json.dumps))
def test_random_text_is_no_lease(reply: bytes | str) -> None:
    garbled_control(reply if isinstance(reply, bytes) else reply.encode())


@given(numbers, numbers, numbers, st.lists(st.integers(0, 5), max_size=4), payloads)
def test_random_samples_are_read_whole_or_refused_whole(
    n_robots: int, height: int, width: int, moves: list[int], payload: bytes
) -> None:
    header = wire.FrameHeader(n_robots=n_robots, height=height, width=width)
    truth = wire.TruthHeader(height=height, width=width)
    results = b"".join(wire.ROBOT.pack(0, 0, 0, 0, 0, 0, 0, 0, 1, n_moves) for n_moves in moves)
    for content in (payload, results + payload):
        try:
            frame = observer.frame_from_sample(header, bytearray(content), 0)
        except EmberwatchError:
            continue
        assert len(frame.robots) == n_robots and frame.frame.shape == (height, width)
        n_moves = sum(len(robot.path) for robot in frame.robots)
        assert len(content) == n_robots * (48 + height * width) + n_moves
    try:
        states = observer.truth_from_sample(truth, bytearray(payload), 0).states
        assert states.shape == (height, width)
    except EmberwatchError:
        pass


def test_a_sample_with_robots_that_cannot_be_is_refused() -> None:
    header = wire.FrameHeader(n_robots=2, height=1, width=1)
    header.result[:] = wire.WORLD.pack(1, 0, 0, 0.0, 2, 4, 0, 0, 0, 0, 0)
    with fails("bad_answer", match="expected bits below 2, got 0x6"):
        observer.frame_from_sample(header, bytearray(98), 0)


def test_the_worked_example_is_what_a_server_answers() -> None:
    flags = re.search(r"^`emberwatch-server (.*?)`, then hello", document.PROTOCOL, re.MULTILINE)
    assert flags
    pairs = re.findall(r"--(\S+) (\S+)", flags[1])
    started = server(**{name.replace("-", "_"): value for name, value in pairs})
    message, _ = document.worked_example("StepReply")
    paths = document.worked_example("StepRequest")[0][ctypes.sizeof(wire.StepRequest) + 8 :]
    with emberwatch.connect(started.instance) as client, client.acquire(0, 2) as lease:
        answer = lease.step(np.frombuffer(paths, np.uint8).reshape(2, -1))
    payload = message[ctypes.sizeof(wire.StepReply) :]
    assert answer.worlds.tobytes() + answer.robots.tobytes() == payload[: 64 + 2 * 48]
    assert answer.frames.tobytes() == payload[64 + 2 * 48 :]
