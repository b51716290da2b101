"""The observation parts `local` and `recent`: what belief or memory says around the robot."""

from typing import Final

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from emberwatch._native import Flights
from emberwatch.belief import Filters, entropy
from emberwatch.model import Model
from emberwatch.settings import WorldSpec

#: Channels of `local` about the world.
N_OF_BELIEF: Final = 2

#: The last channels of every window, after those about the world.
_VISITED, _OFF, _LEFT = -3, -2, -1
N_OF_PATH: Final = 3


class Windows:
    """A square of cells around each robot, cut out of maps with a margin."""

    def __init__(self, spec: WorldSpec, n_rows: int, side: int, n_of_world: int) -> None:
        """`n_of_world`: channels about the world, which come first."""
        margin = side // 2
        height, width = spec.height + 2 * margin, spec.width + 2 * margin
        n_channels = n_of_world + N_OF_PATH
        self._spec, self._shape = spec, (side, side, n_channels)
        self._maps = np.zeros((n_rows, height, width, n_channels), np.uint8)
        self._maps[..., _OFF] = 255
        self._inside = self._maps[:, margin : margin + spec.height, margin : margin + spec.width]
        no_fly = spec.airspace.no_fly
        self._inside[..., _OFF] = 0 if no_fly is None else 255 * no_fly.astype(np.uint8)
        reach = spec.airspace.radius if spec.airspace.pays == "seen" else 0
        #: Rows and columns from a robot to the cells that its visit has pay.
        self._near = np.arange(-reach, reach + 1)
        # By row and robot's cell: rows of a window, each contiguous in the maps.
        step, row, col, _ = self._maps.strides
        self._cut = as_strided(
            self._maps,
            (n_rows, spec.height, spec.width, side, side * n_channels),
            (step, row, col, row, 1),
            writeable=False,
        )
        self._rows = np.arange(n_rows)

    def begin(self, begun: NDArray[np.bool_], shown: NDArray[np.uint8]) -> None:
        """Shows the world, `(n_begun, H, W, n_of_world)`, to robots that have visited nothing."""
        self._inside[begun, :, :, :_VISITED] = shown
        self._inside[begun, :, :, _VISITED] = 0

    def visit(
        self, indices: NDArray[np.intp], rows: NDArray[np.int64], cols: NDArray[np.int64]
    ) -> None:
        """Nothing is left to be found where a path has been, or has seen where that pays."""
        near_rows = (rows[:, np.newaxis] + self._near).clip(0, self._spec.height - 1)
        near_cols = (cols[:, np.newaxis] + self._near).clip(0, self._spec.width - 1)
        all_rows = indices[:, np.newaxis, np.newaxis]
        found = all_rows, near_rows[:, :, np.newaxis], near_cols[:, np.newaxis]
        self._inside[*found, :_VISITED] = 0
        self._inside[indices, rows, cols, _VISITED] = 255

    def around(self, flights: Flights) -> NDArray[np.uint8]:
        """The windows of all robots, `(n_rows, side, side, channels)`; a copy."""
        robots = flights.robots
        windows = self._cut[self._rows, robots[:, 0], robots[:, 1]].reshape(-1, *self._shape)
        left = 1.0 - flights.n_made / self._spec.n_moves
        windows[..., _LEFT] = np.rint(255.0 * left)[:, np.newaxis, np.newaxis]
        return windows


def of_belief(model: Model, filters: Filters, rows: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The channels of `local` about the world: probability that pays, and entropy."""
    predictor = filters.predictor if rows.all() else filters.predictor[:, rows]
    shown = np.empty((*predictor.shape[1:], N_OF_BELIEF), np.uint8)
    channels = predictor[model.target_state], entropy(predictor) / np.log(model.n_states)
    for index, channel in enumerate(channels):
        shown[..., index] = np.rint(255.0 * channel)
    return shown
