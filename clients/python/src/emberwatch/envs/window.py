"""The channels of the observation part `local` that come from a belief."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.belief import Belief

#: Number of channels of `local` that come from the belief.
N_OF_BELIEF: Final = 2

#: Number of the other channels, the last ones of every window: visited cells, cells off the grid or
#: no-fly, share of the moves that remain.
N_OF_PATH: Final = 3


def of_belief(belief: Belief, rows: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Returns the first channels of `local`, times 255, for the rows `rows`.

    These are the probability of the state that pays most, and the entropy divided by log S. Shape
    (n, H, W, 2).
    """
    target = belief.belief[belief.target_state]
    entropy = belief.entropy() / np.log(len(belief.state_names))
    channels = np.stack((target[rows], entropy[rows]), axis=-1)
    return np.rint(255.0 * channels).astype(np.uint8)
