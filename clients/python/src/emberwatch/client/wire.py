"""Names and types of the wire, as PROTOCOL.md describes it: codes, limits, results, answers."""

import struct
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emberwatch._native import Answer
from emberwatch.common.codes import N_MOVES as N_MOVES
from emberwatch.common.codes import UNOBSERVED as UNOBSERVED

#: Operations of `step`.
STEP: Final = 1
OBSERVE: Final = 2
RECALL: Final = 3

#: Flags: a step that observes every cell; an answer with the team's frame of each world.
FULL_COVERAGE: Final = 1
TEAM_FRAMES: Final = 2

#: Number of samples that a reader of hidden states may be behind.
TRUTH_BUFFER: Final = 128


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
    """What the meaning of an answer depends on, as `hello` tells it."""

    #: Robots of a world, R.
    n_robots: int
    height: int
    width: int

    def n_worlds(self, first_robot: int, n_robots: int) -> int:
        """How many worlds some consecutive robots are in."""
        last_robot = first_robot + n_robots - 1
        return last_robot // self.n_robots - first_robot // self.n_robots + 1


class StepAnswer:
    """The answer to a step or an observation: results and frames of consecutive robots.

    Attributes:
        first_robot: The number of the first robot; robot r of world w has number w R + r.
        simulation_nanos: How long the simulation took, nanoseconds.
        frames: What each robot saw, `(n_robots, H, W)`: an observation, or 255 where nothing was
            seen. If team frames were asked for: what all robots of each world saw,
            `(n_worlds, H, W)`. They are your own; write to them as you like.
    """

    __slots__ = ("first_robot", "frames", "native", "simulation_nanos")

    def __init__(self, native: Answer) -> None:
        """Presents an answer of the native module."""
        self.native: Final = native
        self.first_robot, self.simulation_nanos = native.first_robot, native.simulation_nanos
        self.frames = native.frames

    @property
    def worlds(self) -> NDArray[np.void]:
        """A `WorldResult` per world, `(n_worlds,)` of `WORLD_DTYPE`."""
        return self.native.worlds.view(WORLD_DTYPE)

    @property
    def robots(self) -> NDArray[np.void]:
        """A `RobotResult` per robot, `(n_robots,)` of `ROBOT_DTYPE`."""
        return self.native.robots.view(ROBOT_DTYPE)

    def __repr__(self) -> str:
        others = len(self.robots) - 1
        more = f", and {others} more" if others else ""
        return (
            f"StepAnswer(first_robot={self.first_robot}, simulation_nanos={self.simulation_nanos}, "
            f"frames=<uint8 {self.frames.shape}>, results=[{self.result()}{more}])"
        )

    @property
    def world_of(self) -> NDArray[np.int64]:
        """The position in `worlds` of each robot's world, `(n_robots,)`."""
        return self.native.world_of_robots

    @property
    def results(self) -> NDArray[np.void]:
        """One `StepResult` per robot, `(n_robots,)` of `RESULT_DTYPE`; a new array."""
        return self.native.results.view(RESULT_DTYPE)

    def result(self, index: int = 0) -> StepResult:
        """The results of one robot and its world; `index` counts from the first."""
        world, robot = self.native.result(index)
        return StepResult(WorldResult(*world), RobotResult(*robot))
