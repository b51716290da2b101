"""Names and types of PROTOCOL.md: limits and results."""

import struct
from typing import Final, NamedTuple

import numpy as np

from emberwatch._native import StepAnswer as StepAnswer
from emberwatch.common.codes import N_MOVES as N_MOVES
from emberwatch.common.codes import UNOBSERVED as UNOBSERVED

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
