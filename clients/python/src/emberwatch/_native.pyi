"""The part of the package that is written in Rust."""

from typing import Any, final

import numpy as np
from numpy.typing import NDArray

_Doubles = NDArray[np.float64]

def read_model(text: str) -> dict[str, Any]:
    """The fields of `Model` but `toml`; raises `ValueError` for what is no model file."""

def read_description(text: str) -> dict[str, Any]:
    """The same of `Description`."""

@final
class Transition:
    """``Phi`` for a model file's text on one grid; it keeps work space."""

    def __new__(cls, model: str, height: int, width: int) -> Transition: ...
    def apply(self, beliefs: _Doubles) -> _Doubles:
        """Of `(S, n, H, W)`, a new array."""

    def __getnewargs__(self) -> tuple[str, int, int]: ...

def correct(beliefs: _Doubles, likelihood: _Doubles, frames: NDArray[np.uint8]) -> None:
    """Bayes' rule in place: `(S, n, H, W)`, `(S, O)` and `(n, H, W)`."""

def entropy(belief: _Doubles) -> _Doubles:
    """In nats, along the first axis."""

def simulated_prior(model: str, height: int, width: int, burn_in: int) -> NDArray[np.float32]:
    """How often each cell of 64 simulated worlds is in each state, `(S, H, W)`."""

def beam_search(
    values: NDArray[np.float32],
    robots: NDArray[np.int64],
    keys: NDArray[np.uint64],
    n_moves: int,
    width: int,
) -> NDArray[np.uint8]:
    """A path for each world: `(n, H, W)`, `(n, 2)` and `(n,)` give `(n, n_moves)`."""

@final
class MeritTally:
    """The figures of merit of some worlds while they go on."""

    def __new__(
        cls, n_worlds: int, height: int, width: int, target: int, recent_steps: int
    ) -> MeritTally: ...
    def update(
        self,
        visited: NDArray[np.bool_],
        robots: NDArray[np.int64],
        n_hits: NDArray[np.uint32],
        n_burning: NDArray[np.uint32],
        states: NDArray[np.uint8] | None,
    ) -> None:
        """One step: `(n, H, W)`, `(n, R, 2)`, `(n,)`, `(n,)` and `(n, H, W)`."""

    def merit(self, world: int) -> tuple[int | None, int | None, float | None, float | None, float]:
        """The fields of `Merit`."""
