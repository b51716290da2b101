"""The wire against PROTOCOL.md: tables, codes, limits, examples; and bytes that make no sense."""

import ctypes
import dataclasses
import json
import re
import struct
from collections.abc import Callable, Iterator
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
from processes import Server

import emberwatch.connection
from emberwatch import errors, observer, wire
from emberwatch.client import Client
from emberwatch.errors import EmberwatchError
from emberwatch.lease import Lease
from emberwatch.replies import LeftBeliefInfo, ServerInfo, ServerStatus, WorldInfo, WorldStatus

LAYOUTS = document.layouts()
SCALARS = {"u16": ctypes.c_uint16, "u32": ctypes.c_uint32, "u64": ctypes.c_uint64}
TYPES = SCALARS | {"u64[2]": ctypes.c_uint64 * 2, "StepResult": ctypes.c_ubyte * 64}
HEADERS = [
    wire.StepRequest,
    wire.StepReply,
    wire.ControlRequest,
    wire.ControlReply,
    wire.FrameHeader,
    wire.TruthHeader,
    wire.AgentHeader,
]
EXAMPLES = document.examples()
HELLO = next(message for message in EXAMPLES if message.get("reply") == "hello")
LEFT = next(message for message in EXAMPLES if message.get("reply") == "belief")

#: Where the world stands in that example.
RESULT = SimpleNamespace(episode=1, step=2)

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
    """A client on two such ports, after a handshake with the answer that PROTOCOL.md shows."""

    def __init__(self, **hello: Any) -> None:
        self.control, self.step = Port(), Port()
        self.say(HELLO | {"height": 3, "width": 5, "n_moves": 4} | hello)
        self.peer = SimpleNamespace(
            listener_low=0, listener_high=0, watch=lambda _: None, close=lambda: None
        )
        with self._in_place():
            self.client = Client("nowhere")
        self.lease = Lease(self.client, SimpleNamespace(lease=5, ttl_millis=1000), (), range(0, 1))

    def say(self, reply: object, status: int = 0) -> None:
        """Lets `control` answer this, to whatever request."""
        text = reply if isinstance(reply, bytes) else json.dumps(reply).encode()

        def answer(request: bytes) -> tuple[bytes, bytes]:
            _, _, sequence, _, _ = wire.CONTROL_REQUEST.unpack(request)
            return struct.pack("=IIQ", 1, status, sequence), text

        self.control.answer = answer

    @contextmanager
    def _in_place(self) -> Iterator[None]:
        def port(_peer: object, service: str, headers: Any) -> Port:
            made: Port = getattr(self, service)
            made.header = headers[1]
            return made

        names = ("clean_up", "check", "close", "remember_files")
        node = SimpleNamespace(**dict.fromkeys(names, lambda: None))
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
    assert {header.__name__ for header in HEADERS} | {"StepResult"} == set(LAYOUTS)


def test_the_formats_are_the_documented_ones() -> None:
    assert wire.STEP_REQUEST.format == LAYOUTS["StepRequest"].format
    assert wire.CONTROL_REQUEST.format == LAYOUTS["ControlRequest"].format
    # The reserved end is skipped, not read.
    assert wire.RESULT.format == LAYOUTS["StepResult"].format.removesuffix("I") + "4x"


def test_a_result_is_laid_out_as_documented() -> None:
    layout = LAYOUTS["StepResult"]
    assert wire.RESULT.size == wire.RESULT_DTYPE.itemsize == layout.size
    kinds = {"u16": "<u2", "u32": "<u4", "u64": "<u8", "f64": "<f8"}
    fields = {field.name: (np.dtype(kinds[field.of]), field.offset) for field in layout.fields}
    assert dict(wire.RESULT_DTYPE.fields) == fields
    assert [*wire.StepResult._fields, "reserved"] == list(fields)


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
    for code in (19, 2**32 - 1):
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
    }


def test_the_values_are_the_documented_ones() -> None:
    rows = document.table("| kind | name | code |")
    codes = {(kind, name): int(code) for kind, name, code, _ in rows}
    operations = [codes["operation", name] for name in ("step", "observe", "recall")]
    assert operations == [wire.STEP, wire.OBSERVE, wire.RECALL]
    assert sum(kind == "move" for kind, _ in codes) == wire.N_MOVES
    for sentence in (
        f"The version is {wire.VERSION}.",
        f"**{wire.UNOBSERVED} where nothing was",
        f"0, or {wire.FULL_COVERAGE}: observe every cell",
    ):
        assert sentence in document.PROTOCOL


def test_the_worked_request_is_what_a_lease_sends() -> None:
    message, values = document.worked_example("StepRequest")
    number = {name: int(text) for name, text in values.items() if text.isdigit()}
    wired = Wired()
    wired.peer.listener_low = number["listener_low"]
    wired.peer.listener_high = number["listener_high"]
    wired.client._sequence = number["sequence"] - 1
    answer, _ = document.worked_example("StepReply")
    wired.step.answer = answer[:64], answer[64:]
    lease = Lease(wired.client, SimpleNamespace(lease=number["lease"], ttl_millis=1), (), range(1))
    moves = [["up", "down", "left", "right"].index(move) for move in values["path"].split()]
    lease.step(moves)
    assert b"".join(wired.step.sent[-1]) == message


def test_the_worked_answer_reads_as_what_stands_beside_it() -> None:
    message, values = document.worked_example("StepReply")
    reply = wire.StepReply.from_buffer_copy(message[:64])
    for name, _ in wire.StepReply._fields_[:-1]:
        assert str(getattr(reply, name)) == values[name]
    answer = wire.StepAnswer(reply, bytearray(message[64:]), n_observations=3)
    result = answer.result()
    assert {name: f"{value:g}" for name, value in result._asdict().items()} == {
        name: values[name] for name in result._fields
    }
    rows = [" ".join("-" if cell == 255 else str(cell) for cell in row) for row in answer.frames[0]]
    assert rows == [values[f"frame row {row}"] for row in range(3)]
    assert answer.simulation_nanos == int(values["simulation_nanos"])
    (record,) = answer.results
    assert tuple(record)[:-1] == tuple(result)


def test_a_frame_is_your_own_to_write_to() -> None:
    message, _ = document.worked_example("StepReply")
    reply = wire.StepReply.from_buffer_copy(message[:64])
    answer = wire.StepAnswer(reply, bytearray(message[64:]), n_observations=3)
    answer.frames[:] = 7
    assert answer.result().step == 1 and (answer.frames == 7).all()


def test_an_answer_is_shown_in_short() -> None:
    message, _ = document.worked_example("StepReply")
    reply = wire.StepReply.from_buffer_copy(message[:64])
    shape = (1, reply.height, reply.width)
    answer = wire.StepAnswer(reply, bytearray(message[64:]), n_observations=3)
    assert repr(answer) == (
        f"StepAnswer(first_world={reply.first_world}, simulation_nanos={reply.simulation_nanos}, "
        f"frames=<uint8 {shape}>, results=[{answer.result()}])"
    )
    several = wire.StepReply(n_worlds=3, height=64, width=64)
    answer = wire.StepAnswer(several, bytearray(3 * (64 + 64 * 64)), n_observations=3)
    assert repr(answer).endswith("truncated=0), and 2 more])") and len(repr(answer)) < 400


def test_the_documented_requests_are_what_a_client_sends() -> None:
    def sent(call: Any, reply: object = replies("done")[0]) -> dict[str, Any]:
        wired.say(reply)
        call()
        return json.loads(wired.control.sent[-1][1])

    wired = Wired()
    lease = Lease(wired.client, SimpleNamespace(lease=5179721184253228, ttl_millis=1), (), range(1))
    got = [
        json.loads(wired.control.sent[0][1]) | {"client": "probe 0.1"},
        sent(lambda: wired.client.acquire(0, 1, ttl=60), replies("lease")[0]),
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
    }
    wired.say(replies("lease")[0])
    lease = wired.client.acquire()
    assert (lease.number, lease.ttl) == (5179721184253228, 60.0)
    assert lease.start == (WorldInfo(world=0, step=0, seed=0, episode=0, robot=(0, 0)),)
    wired.say(replies("reset")[0])
    assert lease.reset() == (WorldInfo(world=0, step=0, seed=42, episode=1, robot=(0, 0)),)
    wired.say(LEFT)
    assert wired.client.belief() == (LEFT["kind"], 1, 2, ONE)
    wired.say(replies("status")[0])
    status = wired.client.status()
    assert (status.pid, status.n_steps, status.worlds[0].holder_pid) == (14661, 2, 14683)
    (error,) = replies("error")
    wired.say(error, status=10)
    with fails("busy") as raised:
        wired.client.acquire()
    message = error["message"].replace('"takeover": true', "takeover=True")  # in Python's terms
    assert (str(raised.value), raised.value.detail) == (message, error["detail"])
    assert str(errors.refusal(10, error["detail"])) == message


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


def step_reply(**changes: int) -> bytes:
    """The header of a good answer to the step that `WIRED` is about to send, changed."""
    fields = {"version": 1, "sequence": WIRED.client._sequence + 1, "n_worlds": 1}
    return bytes(wire.StepReply(**(fields | {"height": 3, "width": 5} | changes)))


def garbled_step(header: bytes, payload: bytes, words: str | None = None) -> None:
    WIRED.step.answer = header, payload
    with fails("bad_answer", match=words):
        WIRED.lease.step([0, 1, 2, 3])


def garbled_control(reply: object) -> None:
    WIRED.say(reply)
    with fails("bad_answer"):
        WIRED.client.acquire()


GOOD = bytes(64) + b"\xff" * 15


def test_a_good_answer_is_accepted() -> None:
    WIRED.step.answer = step_reply(), GOOD
    assert WIRED.lease.step([0, 1, 2, 3]).frames.shape == (1, 3, 5)


@pytest.mark.parametrize("length", [0, 1, 63, 64, 78, 80, 158])
def test_a_step_answer_of_a_wrong_length_is_refused(length: int) -> None:
    garbled_step(step_reply(), bytes(length), f"expected 79 bytes, got {length}")


@pytest.mark.parametrize("value", [3, 4, 254])
def test_a_frame_with_an_impossible_value_is_refused(value: int) -> None:
    frame = bytes([0, 1, 2, 255, value]) + bytes(10)
    garbled_step(step_reply(), bytes(64) + frame, f"below 3 or 255, got {value}")


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"version": 2}, "expected version 1, got 2"),
        ({"version": 0}, "expected version 1, got 0"),
        ({"sequence": 0}, "expected sequence number"),
        ({"first_world": 1}, "first world"),
        ({"n_worlds": 0}, "first world"),
        ({"n_worlds": 2}, "first world"),
        ({"height": 5, "width": 3}, "height, width"),
        ({"height": 2**32 - 1, "width": 2**32 - 1, "n_worlds": 2**32 - 1}, "height, width"),
    ],
)
def test_an_answer_to_something_else_is_refused(changes: dict[str, int], words: str) -> None:
    garbled_step(step_reply(**changes), GOOD, words)


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
            "worlds": [{"world": 0, "step": 0, "seed": None, "episode": 0, "robot": [0, 0]}],
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
    for header in (struct.pack("=IIQ", 1, 0, 0), struct.pack("=IIQ", 2, 0, 0)):
        WIRED.control.answer = header, b"{}"
        with fails("bad_answer", match="expected"):
            WIRED.client.status()


@pytest.mark.parametrize("name", ["pid", "height", "observations", "model", "coverage"])
def test_a_handshake_that_makes_no_sense_is_refused(name: str) -> None:
    with fails("bad_answer", match=name):
        Wired(**{name: {}})


payloads = st.binary(max_size=300) | st.integers(0, 3).map(lambda n: bytes(n * 79))
numbers = st.integers(0, 4) | st.integers(0, 2**32 - 1)


@given(st.binary(min_size=64, max_size=64), payloads)
def test_random_bytes_are_no_answer(header: bytes, payload: bytes) -> None:
    WIRED.step.answer = header, payload
    with pytest.raises(EmberwatchError):
        WIRED.lease.step([0, 1, 2, 3])


@given(numbers, numbers, numbers, numbers, payloads)
def test_any_answer_is_taken_whole_or_refused_whole(
    first: int, n_worlds: int, height: int, width: int, payload: bytes
) -> None:
    sizes = {"n_worlds": n_worlds, "height": height, "width": width}
    reply = wire.StepReply(first_world=first, **sizes)
    try:
        answer = wire.StepAnswer(reply, bytearray(payload), 3)
    except EmberwatchError:
        return
    assert answer.frames.shape == (n_worlds, height, width)
    assert len(answer.results) == n_worlds and len(payload) == n_worlds * (64 + height * width)


@given(st.binary() | st.recursive(st.none() | st.integers(), st.lists).map(json.dumps))
def test_random_text_is_no_lease(reply: bytes | str) -> None:
    garbled_control(reply if isinstance(reply, bytes) else reply.encode())


@given(numbers, numbers, numbers, payloads)
def test_random_samples_are_read_whole_or_refused_whole(
    height: int, width: int, n_moves: int, payload: bytes
) -> None:
    header = wire.FrameHeader(height=height, width=width, n_moves=n_moves)
    truth = wire.TruthHeader(height=height, width=width)
    try:
        frame = observer.frame_from_sample(header, bytearray(payload), 0)
        assert (frame.frame.shape, frame.path.shape) == ((height, width), (n_moves,))
        states = observer.truth_from_sample(truth, bytearray(payload), 0).states
        assert states.shape == (height, width)
    except EmberwatchError:
        pass


def test_the_worked_example_is_what_a_server_answers(server: Callable[..., Server]) -> None:
    flags = re.search(r"^`emberwatch-server (.*?)`, then hello", document.PROTOCOL, re.MULTILINE)
    assert flags
    pairs = re.findall(r"--(\S+) (\S+)", flags[1])
    started = server(**{name.replace("-", "_"): value for name, value in pairs})
    message, _ = document.worked_example("StepReply")
    path = document.worked_example("StepRequest")[0][ctypes.sizeof(wire.StepRequest) :]
    with emberwatch.connect(started.instance) as client, client.acquire() as lease:
        answer = lease.step(list(path))
    head = ctypes.sizeof(wire.StepReply)
    assert answer.results.tobytes() == message[head : head + wire.RESULT.size]
    assert answer.frames.tobytes() == message[head + wire.RESULT.size :]
