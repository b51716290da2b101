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

_U16, _U32, _U64, _F64 = ctypes.c_uint16, ctypes.c_uint32, ctypes.c_uint64, ctypes.c_double


class Header(ctypes.Structure):
    """A user header. Subclasses list their fields; the type name carries the version."""

    @classmethod
    def type_name(cls) -> str:
        """The name by which iceoryx2 compares types of two processes."""
        return f"emberwatch.v1.{cls.__name__}"


class StepRequest(Header):
    """In front of the paths: `n_worlds * n_moves` bytes."""

    _fields_ = [
        ("version", _U32),
        ("operation", _U32),
        ("lease", _U64),
        ("sequence", _U64),
        ("first_world", _U32),
        ("n_worlds", _U32),
        ("n_moves", _U32),
        ("flags", _U32),
        ("listener_low", _U64),
        ("listener_high", _U64),
        ("step", _U64),
    ]


class StepReply(Header):
    """In front of `n_worlds` results and as many frames."""

    _fields_ = [
        ("version", _U32),
        ("status", _U32),
        ("sequence", _U64),
        ("first_world", _U32),
        ("n_worlds", _U32),
        ("height", _U32),
        ("width", _U32),
        ("simulation_nanos", _U64),
        ("detail", _U64),
        ("reserved", _U64 * 2),
    ]


class ControlRequest(Header):
    """In front of one JSON object."""

    _fields_ = [
        ("version", _U32),
        ("reserved", _U32),
        ("sequence", _U64),
        ("listener_low", _U64),
        ("listener_high", _U64),
    ]


class ControlReply(Header):
    """In front of one JSON object."""

    _fields_ = [("version", _U32), ("status", _U32), ("sequence", _U64)]


class FrameHeader(Header):
    """In front of a published frame and its path."""

    _fields_ = [
        ("version", _U32),
        ("world", _U32),
        ("sequence", _U64),
        ("height", _U32),
        ("width", _U32),
        ("n_moves", _U32),
        ("start_row", _U32),
        ("start_col", _U32),
        ("reserved", _U32),
        ("result", ctypes.c_ubyte * 64),
    ]


class TruthHeader(Header):
    """In front of published hidden states."""

    _fields_ = [
        ("version", _U32),
        ("world", _U32),
        ("sequence", _U64),
        ("episode", _U64),
        ("step", _U64),
        ("seed", _U64),
        ("height", _U32),
        ("width", _U32),
    ]


class AgentHeader(Header):
    """In front of an agent's belief and what it wants."""

    _fields_ = [
        ("version", _U32),
        ("world", _U32),
        ("sequence", _U64),
        ("episode", _U64),
        ("step", _U64),
        ("seed", _U64),
        ("height", _U32),
        ("width", _U32),
        ("n_states", _U32),
        ("pid", _U32),
    ]


#: The two request headers as bytes, field by field.
STEP_REQUEST: Final = struct.Struct("=IIQQIIIIQQQ")
CONTROL_REQUEST: Final = struct.Struct("=IIQQQ")


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


#: One `StepResult` as bytes; the last four are reserved.
RESULT: Final = struct.Struct("=QQQdIIIIIIHH4x")

#: The same for many at once.
RESULT_DTYPE: Final = np.dtype(
    [
        *zip(
            StepResult._fields,
            ["u8", "u8", "u8", "f8", "u4", "u4", "u4", "u4", "u4", "u4", "u2", "u2"],
            strict=True,
        ),
        ("reserved", "u4"),
    ]
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
        """Takes a payload apart."""
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
        """The first result, and the shape of the frames."""
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
        """The result of one world."""
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
