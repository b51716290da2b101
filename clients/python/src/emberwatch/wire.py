"""The wire, as PROTOCOL.md describes it: headers, codes, payloads. No I/O.

Each header is a `ctypes.Structure`, as iceoryx2 wants it, whose fields follow the tables of
PROTOCOL.md section 3; a test compares the two.
"""

from __future__ import annotations

import ctypes
import struct
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import EmberwatchError

#: The protocol version that this package speaks.
VERSION: Final = 1

#: Byte of a frame where nothing was observed.
UNOBSERVED: Final = 255

#: Operations of `step`.
STEP: Final = 1
OBSERVE: Final = 2
RECALL: Final = 3

#: Flag of a step that asks for every cell.
FULL_COVERAGE: Final = 1

#: Number of moves: up, down, left, right.
N_MOVES: Final = 4

#: Limits of section 1.
MAX_CLIENTS: Final = 16
MAX_OBSERVERS: Final = 16
MAX_TRUTH_READERS: Final = 4
MAX_AGENT_READERS: Final = 4
FRAME_BUFFER: Final = 64
TRUTH_BUFFER: Final = 128
AGENT_BUFFER: Final = 4
MAX_NODES: Final = 64

_STEP_REQUEST: Final = "IIQQIIIIQQQ"
_CONTROL_REQUEST: Final = "IIQQQ"

#: The two request headers as bytes, field by field.
STEP_REQUEST: Final = struct.Struct("=" + _STEP_REQUEST)
CONTROL_REQUEST: Final = struct.Struct("=" + _CONTROL_REQUEST)


class Header(ctypes.Structure):
    """A user header. Subclasses list their fields; the type name carries the version."""

    @classmethod
    def type_name(cls) -> str:
        """The name by which iceoryx2 compares types of two processes."""
        return f"emberwatch.v1.{cls.__name__}"


def _fields(format: str, names: str) -> list[tuple[str, Any]]:
    """Fields by `struct`'s letters."""
    kinds = {"I": ctypes.c_uint32, "Q": ctypes.c_uint64}
    return [(name, kinds[letter]) for name, letter in zip(names.split(), format, strict=True)]


class StepRequest(Header):
    """In front of the paths: `n_worlds * n_moves` bytes."""

    _fields_ = _fields(
        _STEP_REQUEST,
        "version operation lease sequence first_world n_worlds n_moves flags listener_low "
        "listener_high step",
    )


class StepReply(Header):
    """In front of `n_worlds` results and as many frames."""

    _fields_ = [
        *_fields(
            "IIQIIIIQQ",
            "version status sequence first_world n_worlds height width simulation_nanos detail",
        ),
        ("reserved", ctypes.c_uint64 * 2),
    ]


class ControlRequest(Header):
    """In front of one JSON object."""

    _fields_ = _fields(_CONTROL_REQUEST, "version reserved sequence listener_low listener_high")


class ControlReply(Header):
    """In front of one JSON object."""

    _fields_ = _fields("IIQ", "version status sequence")


class FrameHeader(Header):
    """In front of a published frame and its path."""

    _fields_ = [
        *_fields(
            "IIQIIIIII",
            "version world sequence height width n_moves start_row start_col reserved",
        ),
        ("result", ctypes.c_ubyte * 64),
    ]


class TruthHeader(Header):
    """In front of published hidden states."""

    _fields_ = _fields("IIQQQQII", "version world sequence episode step seed height width")


class AgentHeader(Header):
    """In front of an agent's belief and what it wants."""

    _fields_ = _fields(
        "IIQQQQIIII", "version world sequence episode step seed height width n_states pid"
    )


class StepResult(NamedTuple):
    """How one world stands after a step or a reset (PROTOCOL.md, `StepResult`)."""

    #: k, the number of steps since the last reset.
    step: int
    #: Seed of the episode. With the model it gives the hidden state away: not for learners.
    seed: int
    #: Resets of this world since the server started.
    episode: int
    #: Sum of the model's rewards over the distinct cells visited.
    reward: float
    #: Cells of the whole grid in the state that pays most (fire): for reports.
    n_target_cells: int
    #: Distinct cells visited.
    n_visited: int
    #: Distinct cells visited in the state that pays most.
    n_hits: int
    #: The robot's place.
    row: int
    col: int
    #: What the frame shows: 0 nothing, 1 the path, 2 every cell.
    coverage: int
    #: 1 if the episode ended by itself.
    terminated: int
    #: 1 if the server's `max_steps` ended it.
    truncated: int

    @property
    def moment(self) -> tuple[int, int, int]:
        """Seed, episode and step."""
        return self.seed, self.episode, self.step


#: One `StepResult` as bytes; the last four are reserved.
RESULT: Final = struct.Struct("=QQQdIIIIIIHH4x")

#: The same for many at once.
RESULT_DTYPE: Final = np.dtype(
    [*zip(StepResult._fields, "QQQdIIIIIIHH", strict=True), ("reserved", "I")]
)


class StepAnswer:
    """The answer to a step or an observation: results and frames of consecutive worlds.

    Attributes:
        first_world: The first world.
        simulation_nanos: How long the server worked on it, nanoseconds.
        frames: What was seen, `(n_worlds, H, W)`: an observation, or 255 where nothing was seen.
            A copy of your own; write to it as you like.
    """

    __slots__ = ("_payload", "first_world", "frames", "simulation_nanos")

    def __init__(self, reply: StepReply, payload: bytearray, n_observations: int) -> None:
        n_worlds, height, width = reply.n_worlds, reply.height, reply.width
        if not n_worlds * height * width:
            raise bad_answer(
                f"answer to step: expected worlds, got {n_worlds} of {height} x {width} cells"
            )
        expected = n_worlds * (RESULT.size + height * width)
        if len(payload) != expected:
            raise bad_answer(f"answer to step: expected {expected} bytes, got {len(payload)}")
        self._payload = payload
        self.first_world: int = reply.first_world
        self.simulation_nanos: int = reply.simulation_nanos
        frames = np.frombuffer(payload, np.uint8, offset=n_worlds * RESULT.size)
        check_frame(frames, n_observations)
        self.frames = frames.reshape(n_worlds, height, width)

    def __repr__(self) -> str:
        others = len(self.frames) - 1
        more = f", and {others} more" if others else ""
        return (
            f"StepAnswer(first_world={self.first_world}, simulation_nanos={self.simulation_nanos}, "
            f"frames=<uint8 {self.frames.shape}>, results=[{self.result()}{more}])"
        )

    @property
    def results(self) -> NDArray[np.void]:
        """One `StepResult` per world, as a structured array `(n_worlds,)` of `RESULT_DTYPE`."""
        return np.frombuffer(self._payload, RESULT_DTYPE, count=len(self.frames))

    def result(self, index: int = 0) -> StepResult:
        return StepResult(*RESULT.unpack_from(self._payload, index * RESULT.size))


def bad_answer(message: str) -> EmberwatchError:
    """The error of an answer that makes no sense."""
    return EmberwatchError(message, "bad_answer")


def check_frame(values: NDArray[np.uint8], n_observations: int) -> None:
    """Refuses frames whole that hold anything but observations and 255."""
    # 255 wraps to 0, observation o becomes o + 1: one addition and one maximum check all.
    highest = int((values + np.uint8(1)).max(initial=0))
    if highest > n_observations:
        raise bad_answer(
            f"frame: expected observations below {n_observations} or 255, got {highest - 1}"
        )


def check_worlds(reply: StepReply, expected: tuple[int, int, int, int]) -> None:
    """Refuses an answer about other worlds, or of another size: first, number, height, width."""
    got = (reply.first_world, reply.n_worlds, reply.height, reply.width)
    if got != expected:
        raise bad_answer(
            f"answer to step: expected first world, worlds, height, width {expected}, got {got}"
        )


def check_answer(what: str, reply: Any, sequence: int) -> None:
    """Refuses an answer of another version or to another request."""
    if reply.version != VERSION:
        raise bad_answer(f"{what}: expected version {VERSION}, got {reply.version}")
    if reply.sequence != sequence:
        raise bad_answer(f"{what}: expected sequence number {sequence}, got {reply.sequence}")
