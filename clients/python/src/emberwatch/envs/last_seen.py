"""Memory of frames, without a model: the last observed value of each cell, and its age."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.client import wire

#: Maximum age; also the age of cells that were never observed.
MAX_AGE: Final = 255

#: Steps after which an observation in the part `recent` has half its strength.
HALF_LIFE: Final = 16

#: Strength of an observation by its age, 0 to 255.
_STRENGTHS: Final = np.rint(255 * 0.5 ** (np.arange(MAX_AGE + 1) / HALF_LIFE)).astype(np.uint8)


class LastSeen:
    """The last observations of several robots, one row for each."""

    def __init__(self, n_rows: int, height: int, width: int, n_observations: int) -> None:
        self._known = np.arange(n_observations, dtype=np.uint8)
        self._values = np.full((n_rows, height, width), wire.UNOBSERVED, np.uint8)
        #: Number of steps since each cell was observed, at most `MAX_AGE`.
        self.ages = np.full((n_rows, height, width), MAX_AGE, np.uint8)

    def reset(self, begun: NDArray[np.bool_], frames: NDArray[np.uint8]) -> None:
        """Forgets everything in the rows `begun`, then stores their frames.

        `frames` has a frame for every row.
        """
        seen = frames[begun]
        self._values[begun] = seen
        self.ages[begun] = np.where(seen != wire.UNOBSERVED, np.uint8(0), np.uint8(MAX_AGE))

    def update(self, moved: NDArray[np.bool_], frames: NDArray[np.uint8]) -> None:
        """Updates the rows `moved` with a step; `frames` has a frame for every row."""
        self.ages[moved] += self.ages[moved] < MAX_AGE
        seen = moved[:, np.newaxis, np.newaxis] & (frames != wire.UNOBSERVED)
        self.ages[seen] = 0
        self._values[seen] = frames[seen]

    def fading(self, rows: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """Returns the strength of each observed value, shape (n, H, W, n_observations).

        The strength is 255 in cells that the last frame observed, and halves every `HALF_LIFE`
        steps.
        """
        is_value = self._values[rows][..., np.newaxis] == self._known
        return is_value * _STRENGTHS[self.ages[rows]][..., np.newaxis]
