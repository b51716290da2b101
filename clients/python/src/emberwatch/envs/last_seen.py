"""What frames alone tell: which value was last observed in each cell, and how long ago."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.client import wire

#: Age of a cell that was not seen for this many steps or more.
MAX_AGE: Final = 255

#: Steps after which an observation in the part `recent` has half its strength.
HALF_LIFE: Final = 16

#: By age.
_STRENGTHS: Final = np.rint(255 * 0.5 ** (np.arange(MAX_AGE + 1) / HALF_LIFE)).astype(np.uint8)


class LastSeen:
    """The memory of some robots, in rows."""

    def __init__(self, n_rows: int, height: int, width: int, n_observations: int) -> None:
        self._known = np.arange(n_observations, dtype=np.uint8)
        self._values = np.full((n_rows, height, width), wire.UNOBSERVED, np.uint8)
        #: Steps since each cell was seen, to `MAX_AGE`.
        self.ages = np.full((n_rows, height, width), MAX_AGE, np.uint8)

    def reset(self, begun: NDArray[np.bool_], frames: NDArray[np.uint8]) -> None:
        """Knows nothing in some rows but their frame; `frames` are those of all rows."""
        seen = frames[begun]
        self._values[begun] = seen
        self.ages[begun] = np.where(seen != wire.UNOBSERVED, np.uint8(0), np.uint8(MAX_AGE))

    def update(self, moved: NDArray[np.bool_], frames: NDArray[np.uint8]) -> None:
        """One step of the rows `moved`."""
        self.ages[moved] += self.ages[moved] < MAX_AGE
        seen = moved[:, np.newaxis, np.newaxis] & (frames != wire.UNOBSERVED)
        self.ages[seen] = 0
        self._values[seen] = frames[seen]

    def fading(self, rows: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """A channel for each observation, `(n, H, W, n_observations)`: 255 where seen just now."""
        is_value = self._values[rows][..., np.newaxis] == self._known
        return is_value * _STRENGTHS[self.ages[rows]][..., np.newaxis]
