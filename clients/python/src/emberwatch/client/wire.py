"""Names and types of PROTOCOL.md: codes, limits, results and answers."""

import struct
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emberwatch._native import Answer
from emberwatch.common.codes import N_MOVES as N_MOVES
from emberwatch.common.codes import UNOBSERVED as UNOBSERVED

#: Operations of the service `step`.
STEP: Final = 1
OBSERVE: Final = 2
RECALL: Final = 3

#: Flags of a request: observe every cell; answer with one frame for each world's team.
FULL_COVERAGE: Final = 1
TEAM_FRAMES: Final = 2

#: Maximum number of samples by which a reader of hidden states can lag behind.
TRUTH_BUFFER: Final = 128


class WorldResult(NamedTuple):
    """The result of one world after a step or a reset (PROTOCOL.md, `WorldResult`)."""

    #: k, the number of steps since the last reset.
    step: int
    #: Seed of the episode. Learners must not use it, because seed and model determine the hidden
    #: states.
    seed: int
    #: Number of resets of this world since the server started.
    episode: int
    #: Reward of the team: the sum of the model's rewards over all distinct cells that its robots
    #: visited.
    reward: float
    #: Bit r is 1 if robot r hovered, because no client held it.
    hovered: int
    #: Bit r is 1 if robot r was held, but its path came too late.
    late: int
    #: Number of cells of the whole grid in the state that pays most (fire); for reports.
    n_target_cells: int
    #: Number of distinct cells that the team visited.
    n_visited: int
    #: Number of distinct visited cells that were in the state that pays most.
    n_hits: int
    #: 1 if the episode ended by itself.
    terminated: int
    #: 1 if the server's `max_steps` ended the episode.
    truncated: int

    @property
    def moment(self) -> tuple[int, int, int]:
        """Seed, episode and step."""
        return self.seed, self.episode, self.step


class RobotResult(NamedTuple):
    """The result of one robot after a step or a reset (PROTOCOL.md, `RobotResult`)."""

    #: The robot's share of the team's reward: a cell that v robots visited pays each of them 1 / v.
    reward: float
    #: The robot's marginal reward: how much lower the team's reward would be without it.
    marginal: float
    #: Number of distinct cells that the robot visited.
    n_visited: int
    #: Number of distinct visited cells that were in the state that pays most.
    n_hits: int
    #: The cell where the robot's path began.
    start_row: int
    start_col: int
    #: The robot's current cell.
    row: int
    col: int
    #: The observed cells of the robot's frame: 0 none, 1 the path, 2 every cell.
    coverage: int
    #: Number of moves flown: 0 after a reset, or if the robot hovered or was late.
    n_moves: int

    @property
    def start(self) -> tuple[int, int]:
        """Row and column where the robot's path began."""
        return self.start_row, self.start_col

    @property
    def cell(self) -> tuple[int, int]:
        """Current row and column of the robot."""
        return self.row, self.col


class StepResult(NamedTuple):
    """The results of one robot and its world after a step or a reset."""

    world: WorldResult
    robot: RobotResult


#: Byte layouts of the results.
WORLD: Final = struct.Struct("=QQQdQQIIIHH")
ROBOT: Final = struct.Struct("=ddIIIIIIII")

#: The same layouts for NumPy; `RESULT_DTYPE` is a `StepResult`.
WORLD_DTYPE: Final = np.dtype([*zip(WorldResult._fields, WORLD.format[1:], strict=True)])
ROBOT_DTYPE: Final = np.dtype([*zip(RobotResult._fields, ROBOT.format[1:], strict=True)])
RESULT_DTYPE: Final = np.dtype([("world", WORLD_DTYPE), ("robot", ROBOT_DTYPE)])


class Shape(NamedTuple):
    """The sizes that determine the layout of answers, from the reply to `hello`."""

    #: Number of robots in a world, R.
    n_robots: int
    height: int
    width: int

    def n_worlds(self, first_robot: int, n_robots: int) -> int:
        """Returns the number of worlds that the given consecutive robots are in."""
        last_robot = first_robot + n_robots - 1
        return last_robot // self.n_robots - first_robot // self.n_robots + 1


class StepAnswer:
    """The answer to a step or an observation: results and frames of consecutive robots.

    Attributes:
        first_robot: The number of the first robot; robot r of world w has number w R + r.
        simulation_nanos: Nanoseconds that the simulation took.
        frames: The frame of each robot, `(n_robots, H, W)`: observed values, 255 in unobserved
            cells. If team frames were requested: the frame of each world's team,
            `(n_worlds, H, W)`. The array is a copy that you may write to.
    """

    __slots__ = ("first_robot", "frames", "native", "simulation_nanos")

    def __init__(self, native: Answer) -> None:
        """Wraps an answer of the native module."""
        self.native: Final = native
        self.first_robot, self.simulation_nanos = native.first_robot, native.simulation_nanos
        self.frames = native.frames

    @property
    def worlds(self) -> NDArray[np.void]:
        """One `WorldResult` for each world, `(n_worlds,)` of `WORLD_DTYPE`."""
        return self.native.worlds.view(WORLD_DTYPE)

    @property
    def robots(self) -> NDArray[np.void]:
        """One `RobotResult` for each robot, `(n_robots,)` of `ROBOT_DTYPE`."""
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
        """The index in `worlds` of each robot's world, `(n_robots,)`."""
        return self.native.world_of_robots

    @property
    def results(self) -> NDArray[np.void]:
        """One `StepResult` for each robot, `(n_robots,)` of `RESULT_DTYPE`; a new array."""
        return self.native.results.view(RESULT_DTYPE)

    def result(self, index: int = 0) -> StepResult:
        """Returns the results of one robot and its world; `index` 0 is the first robot."""
        world, robot = self.native.result(index)
        return StepResult(WorldResult(*world), RobotResult(*robot))
