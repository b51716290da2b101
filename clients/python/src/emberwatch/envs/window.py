"""The channels of the observation part `local` that come from a belief."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.belief import Filters, entropy
from emberwatch.model import Model

#: Number of channels of `local` that come from the belief.
N_OF_BELIEF: Final = 2

#: Number of the other channels, the last ones of every window: visited cells, cells off the grid or
#: no-fly, share of the moves that remain.
N_OF_PATH: Final = 3


def of_belief(model: Model, filters: Filters, rows: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Returns the first channels of `local`, times 255, for the rows `rows`.

    These are the probability of the state that pays most, and the entropy divided by log S. Shape
    (n, H, W, 2).
    """
    predictor = filters.predictor if rows.all() else filters.predictor[:, rows]
    shown = np.empty((*predictor.shape[1:], N_OF_BELIEF), np.uint8)
    channels = predictor[model.target_state], entropy(predictor) / np.log(model.n_states)
    for index, channel in enumerate(channels):
        shown[..., index] = np.rint(255.0 * channel)
    return shown
