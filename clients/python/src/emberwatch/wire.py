"""The wire, as PROTOCOL.md describes it: headers, codes, payloads. No I/O.

Each header is a `ctypes.Structure`, as iceoryx2 wants it, whose fields follow the tables of
PROTOCOL.md section 3; a test compares the two.
"""

import ctypes
import struct
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import bad_answer

#: The protocol version that this package speaks.
VERSION: Final = 2

#: Byte of a frame where nothing was observed.
UNOBSERVED: Final = 255

#: Operations of `step`.
STEP: Final = 1
OBSERVE: Final = 2
RECALL: Final = 3

#: Flags: a step that observes every cell; an answer with the team's frame of each world.
FULL_COVERAGE: Final = 1
TEAM_FRAMES: Final = 2

#: Number of moves: up, down, left, right.
N_MOVES: Final = 4

#: Limits of section 1.
MAX_CLIENTS: Final = 16
MAX_ROBOTS: Final = 64
MAX_OBSERVERS: Final = 16
MAX_TRUTH_READERS: Final = 4
MAX_AGENT_READERS: Final = 4
FRAME_BUFFER: Final = 64
TRUTH_BUFFER: Final = 128
AGENT_BUFFER: Final = 4
MAX_NODES: Final = 64

_STEP_REQUEST: Final = "IIQQIIIIQQ"
_CONTROL_REQUEST: Final = "IIQQQ"

#: The two request headers as bytes, field by field.
STEP_REQUEST: Final = struct.Struct("=" + _STEP_REQUEST)
CONTROL_REQUEST: Final = struct.Struct("=" + _CONTROL_REQUEST)


class Header(ctypes.Structure):
    """A user header. Subclasses list their fields; the type name carries the version."""

    @classmethod
    def type_name(cls) -> str:
        """The name by which iceoryx2 compares types of two processes."""
        return f"emberwatch.v2.{cls.__name__}"


def _fields(format: str, names: str) -> list[tuple[str, Any]]:
    """Fields by `struct`'s letters."""
    kinds = {"I": ctypes.c_uint32, "Q": ctypes.c_uint64}
    return [(name, kinds[letter]) for name, letter in zip(names.split(), format, strict=True)]


class StepRequest(Header):
    """In front of the step k of each world, and of a step then `n_robots` paths."""

    _fields_ = _fields(
        _STEP_REQUEST,
        "version operation lease sequence first_robot n_robots n_moves flags listener_low "
        "listener_high",
    )


class StepReply(Header):
    """In front of `n_worlds` results, `n_robots` results, and the frames."""

    _fields_ = _fields(
        "IIQIIIIIIQQ",
        "version status sequence first_robot n_robots n_worlds flags height width "
        "simulation_nanos detail",
    )


class ControlRequest(Header):
    """In front of one JSON object."""

    _fields_ = _fields(_CONTROL_REQUEST, "version reserved sequence listener_low listener_high")


class ControlReply(Header):
    """In front of one JSON object."""

    _fields_ = _fields("IIQ", "version status sequence")


class FrameHeader(Header):
    """In front of what a world's robots saw and flew."""

    _fields_ = [
        *_fields("IIQIIII", "version world sequence first_robot n_robots height width"),
        ("result", ctypes.c_ubyte * 64),
    ]


class TruthHeader(Header):
    """In front of published hidden states."""

    _fields_ = _fields("IIQQQQII", "version world sequence episode step seed height width")


class AgentHeader(Header):
    """In front of an agent's belief and what it wants."""

    _fields_ = _fields(
        "IIQQQQIIIIII",
        "version world sequence episode step seed height width n_states pid first_robot n_robots",
    )


class WorldResult(NamedTuple):
    """How one world stands after a step or a reset (PROTOCOL.md, `WorldResult`)."""

    #: k, the number of steps since the last reset.
    step: int
    #: Seed of the episode. With the model it gives the hidden state away: not for learners.
    seed: int
    #: Resets of this world since the server started.
    episode: int
    #: The team's: the sum of the model's rewards over the distinct cells that any robot visited.
    reward: float
    #: Bit r: nobody held robot r.
    hovered: int
    #: Bit r: robot r was held, and its path came too late.
    late: int
    #: Cells of the whole grid in the state that pays most (fire): for reports.
    n_target_cells: int
    #: Distinct cells that the team visited.
    n_visited: int
    #: Of these, those in the state that pays most.
    n_hits: int
    #: 1 if the episode ended by itself.
    terminated: int
    #: 1 if the server's `max_steps` ended it.
    truncated: int

    @property
    def moment(self) -> tuple[int, int, int]:
        """Seed, episode and step."""
        return self.seed, self.episode, self.step


class RobotResult(NamedTuple):
    """How one robot stands after a step or a reset (PROTOCOL.md, `RobotResult`)."""

    #: Its share: a cell that v robots visited pays 1 / v of its reward.
    reward: float
    #: What the team's reward would lack without it.
    marginal: float
    #: Distinct cells that it visited.
    n_visited: int
    #: Of these, those in the state that pays most.
    n_hits: int
    #: Where its path began.
    start_row: int
    start_col: int
    #: Where it is.
    row: int
    col: int
    #: What its frame shows: 0 nothing, 1 the path, 2 every cell.
    coverage: int
    #: Moves flown: 0 after a reset, or if it hovered or was late.
    n_moves: int

    @property
    def start(self) -> tuple[int, int]:
        """The cell where its path began."""
        return self.start_row, self.start_col

    @property
    def cell(self) -> tuple[int, int]:
        """The cell where it is."""
        return self.row, self.col


class StepResult(NamedTuple):
    """How one robot and its world stand after a step or a reset."""

    world: WorldResult
    robot: RobotResult


#: The results as bytes.
WORLD: Final = struct.Struct("=QQQdQQIIIHH")
ROBOT: Final = struct.Struct("=ddIIIIIIII")

#: The same for many at once, and a `StepResult` for each robot.
WORLD_DTYPE: Final = np.dtype([*zip(WorldResult._fields, WORLD.format[1:], strict=True)])
ROBOT_DTYPE: Final = np.dtype([*zip(RobotResult._fields, ROBOT.format[1:], strict=True)])
RESULT_DTYPE: Final = np.dtype([("world", WORLD_DTYPE), ("robot", ROBOT_DTYPE)])


class Shape(NamedTuple):
    """What the length and the values of an answer depend on, as `hello` tells it."""

    #: Robots of a world, R.
    n_robots: int
    n_moves: int
    n_observations: int

    def n_worlds(self, first_robot: int, n_robots: int) -> int:
        """How many worlds some consecutive robots are in."""
        last_robot = first_robot + n_robots - 1
        return last_robot // self.n_robots - first_robot // self.n_robots + 1


class StepAnswer:
    """The answer to a step or an observation: results and frames of consecutive robots.

    Attributes:
        first_robot: The number of the first robot; robot r of world w has number w R + r.
        simulation_nanos: How long the server worked on it, nanoseconds.
        worlds: A `WorldResult` per world, `(n_worlds,)` of `WORLD_DTYPE`.
        robots: A `RobotResult` per robot, `(n_robots,)` of `ROBOT_DTYPE`.
        frames: What each robot saw, `(n_robots, H, W)`: an observation, or 255 where nothing was
            seen. If team frames were asked for: what all robots of each world saw,
            `(n_worlds, H, W)`. A copy of your own; write to it as you like.
    """

    __slots__ = (
        "_payload",
        "_shape",
        "first_robot",
        "frames",
        "robots",
        "simulation_nanos",
        "worlds",
    )

    def __init__(self, reply: StepReply, payload: bytearray, shape: Shape) -> None:
        n_worlds, n_robots, n_cells = reply.n_worlds, reply.n_robots, reply.height * reply.width
        if not n_robots * n_cells or n_worlds != shape.n_worlds(reply.first_robot, n_robots):
            got = f"{n_robots} in {n_worlds} of {reply.height} x {reply.width} cells"
            raise bad_answer("answer to step", "robots and their worlds", got)
        n_frames = n_worlds if reply.flags & TEAM_FRAMES else n_robots
        head = n_worlds * WORLD.size + n_robots * ROBOT.size
        expected = head + n_frames * n_cells
        if len(payload) != expected:
            raise bad_answer("answer to step", f"{expected} bytes", len(payload))
        self._payload, self._shape = payload, shape
        self.first_robot: int = reply.first_robot
        self.simulation_nanos: int = reply.simulation_nanos
        self.worlds: NDArray[np.void] = np.frombuffer(payload, WORLD_DTYPE, n_worlds)
        self.robots: NDArray[np.void] = np.frombuffer(
            payload, ROBOT_DTYPE, n_robots, n_worlds * WORLD.size
        )
        stayed = max(self.worlds["hovered"].tolist() + self.worlds["late"].tolist())
        check_stayed(stayed, shape.n_robots)
        n_moves = set(self.robots["n_moves"].tolist())
        if not n_moves <= {0, shape.n_moves}:
            raise bad_answer("n_moves", f"0 or {shape.n_moves}", n_moves)
        frames = np.frombuffer(payload, np.uint8, offset=head)
        check_frame(frames, shape.n_observations)
        self.frames = frames.reshape(n_frames, reply.height, reply.width)

    def __repr__(self) -> str:
        others = len(self.robots) - 1
        more = f", and {others} more" if others else ""
        return (
            f"StepAnswer(first_robot={self.first_robot}, simulation_nanos={self.simulation_nanos}, "
            f"frames=<uint8 {self.frames.shape}>, results=[{self.result()}{more}])"
        )

    @property
    def world_of(self) -> NDArray[np.intp]:
        """The position in `worlds` of each robot's world, `(n_robots,)`."""
        robots = np.arange(self.first_robot, self.first_robot + len(self.robots))
        worlds = robots // self._shape.n_robots
        return worlds - worlds[0]

    @property
    def results(self) -> NDArray[np.void]:
        """One `StepResult` per robot, `(n_robots,)` of `RESULT_DTYPE`; a new array."""
        results = np.empty(len(self.robots), RESULT_DTYPE)
        results["world"], results["robot"] = self.worlds[self.world_of], self.robots
        return results

    def result(self, index: int = 0) -> StepResult:
        """The results of one robot and its world; `index` counts from the first."""
        world = self._shape.n_worlds(self.first_robot, index + 1) - 1
        offset = len(self.worlds) * WORLD.size + index * ROBOT.size
        return StepResult(
            WorldResult(*WORLD.unpack_from(self._payload, world * WORLD.size)),
            RobotResult(*ROBOT.unpack_from(self._payload, offset)),
        )


def check_frame(values: NDArray[np.uint8], n_observations: int) -> None:
    """Refuses frames whole that hold anything but observations and 255."""
    # 255 wraps to 0, observation o becomes o + 1: one addition and one maximum check all.
    highest = int((values + np.uint8(1)).max(initial=0))
    if highest > n_observations:
        raise bad_answer("frame", f"observations below {n_observations} or 255", highest - 1)


def check_stayed(stayed: int, n_robots: int) -> None:
    """Refuses bits of robots that a world does not have."""
    if stayed >> n_robots:
        raise bad_answer("robots that stayed", f"bits below {n_robots}", f"{stayed:#x}")


def check_asked(reply: StepReply, expected: tuple[int, int, int, int, int]) -> None:
    """Refuses an answer to another question: first robot, number, flags, height, width."""
    got = (reply.first_robot, reply.n_robots, reply.flags, reply.height, reply.width)
    if got != expected:
        what = f"first robot, robots, flags, height, width {expected}"
        raise bad_answer("answer to step", what, got)


def check_answer(what: str, reply: Any, sequence: int) -> None:
    """Refuses an answer of another version or to another request."""
    if reply.version != VERSION:
        raise bad_answer(what, f"version {VERSION}", reply.version)
    if reply.sequence != sequence:
        raise bad_answer(what, f"sequence number {sequence}", reply.sequence)
