"""The observation part `local`: what the belief says around the robot."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from emberwatch.belief import Filters, entropy
from emberwatch.flights import Flights
from emberwatch.model import Model
from emberwatch.settings import WorldSpec

#: Channels of the part, in this order.
CHANNELS: Final = ("target", "entropy", "visited", "off", "left")
_TARGET, _ENTROPY, _VISITED, _OFF, _LEFT = range(len(CHANNELS))


class Windows:
    """A square of cells around each robot, cut out of maps with a margin."""

    def __init__(self, model: Model, spec: WorldSpec, n_rows: int, side: int) -> None:
        margin = side // 2
        height, width = spec.height + 2 * margin, spec.width + 2 * margin
        self._model, self._spec, self._side = model, spec, side
        self._maps = np.zeros((n_rows, height, width, len(CHANNELS)), np.uint8)
        self._maps[..., _OFF] = 255
        self._inside = self._maps[:, margin : margin + spec.height, margin : margin + spec.width]
        self._inside[..., _OFF] = 0
        # By row and robot's cell: rows of a window, each contiguous in the maps.
        step, row, col, _ = self._maps.strides
        self._cut = as_strided(
            self._maps,
            (n_rows, spec.height, spec.width, side, side * len(CHANNELS)),
            (step, row, col, row, 1),
            writeable=False,
        )
        self._rows = np.arange(n_rows)

    def begin(self, filters: Filters, begun: NDArray[np.bool_]) -> None:
        """Shows the predictor to some robots, which have visited nothing yet."""
        predictor = filters.predictor[:, begun]
        shown = np.empty((*predictor.shape[1:], 3))
        shown[..., _TARGET] = predictor[self._model.target_state]
        shown[..., _ENTROPY] = entropy(predictor) / np.log(self._model.n_states)
        shown[..., _VISITED] = 0.0
        self._inside[begun, :, :, :_OFF] = np.rint(255.0 * shown)

    def visit(
        self, indices: NDArray[np.intp], rows: NDArray[np.int64], cols: NDArray[np.int64]
    ) -> None:
        """Nothing is left to be found where a path has been."""
        self._inside[indices, rows, cols, :_OFF] = (0, 0, 255)

    def around(self, flights: Flights) -> NDArray[np.uint8]:
        """The windows of all robots, `(n_rows, side, side, channels)`; a copy."""
        robots = flights.robots
        windows = self._cut[self._rows, robots[:, 0], robots[:, 1]]
        windows = windows.reshape(-1, self._side, self._side, len(CHANNELS))
        left = 1.0 - flights.n_made / self._spec.n_moves
        windows[..., _LEFT] = np.rint(255.0 * left)[:, np.newaxis, np.newaxis]
        return windows
