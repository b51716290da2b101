"""Beliefs about worlds: what the frames so far say about every cell.

`known` and `load` make a `Belief` of any kind that the Rust agent has; `score` says how well one
fits recorded worlds. `wrappers.BeliefObservation` runs one beside an environment.

The plain one is the Bayes filter of a known model (paper section III.A, masked as in section
III.C): a frame turns the predictor ``u_k`` into the posterior ``p_k`` (eq. 5), and the transition
turns that into the next predictor ``u_{k+1} = Phi(p_k)`` (eq. 6). Cells are treated as independent
given the frames, so this is an approximation even with the true model.

Beliefs have shape (S, H, W): one probability per state and cell, a distribution in each cell.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

import emberwatch._native as _native
from emberwatch.belief.estimators import Belief as Belief
from emberwatch.belief.estimators import kinds as kinds
from emberwatch.belief.estimators import known as known
from emberwatch.belief.estimators import load as load
from emberwatch.belief.prior import distribution
from emberwatch.belief.prior import initial_prior as initial_prior
from emberwatch.belief.prior import uniform_prior as uniform_prior
from emberwatch.belief.scoring import BeliefScores as BeliefScores
from emberwatch.belief.scoring import score as score
from emberwatch.common.codes import UNOBSERVED as UNOBSERVED
from emberwatch.errors import invalid
from emberwatch.model import Model


class Filters:
    """The plain filters of many worlds in double precision, for the environments' observations.

    Beliefs have shape (S, n_worlds, H, W). The recorded bytes of observations depend on these
    numbers; for anything else, `known` makes the agent's, which are single precision.
    """

    def __init__(self, model: Model, prior: NDArray[np.floating], n_worlds: int) -> None:
        """`prior`, shape (S, H, W), is that of each world."""
        first = distribution(prior, n_states=model.n_states)
        first /= first.sum(axis=0)
        self._prior = first[:, np.newaxis]
        _, _, height, width = self._prior.shape
        self._transition = Transition(model, height=height, width=width, n_worlds=n_worlds)
        self._likelihood = np.ascontiguousarray(model.observation_matrix)
        #: The posterior ``p_k`` given the last frames.
        self.posterior = np.repeat(self._prior, n_worlds, axis=1)
        #: The predictor ``u_{k+1}`` of what the next paths will meet.
        self.predictor = self.posterior

    def reset(self, indices: Sequence[int], frames: NDArray[np.uint8]) -> None:
        """Begins with the prior in some worlds, and corrects it; `frames` are those of all."""
        chosen = list(indices)
        belief = np.repeat(self._prior, len(chosen), axis=1)
        _native.correct(belief, self._likelihood, frames[chosen])
        self.posterior[:, chosen] = belief
        self.predictor = self._transition.apply(self.posterior)

    def update(self, frames: NDArray[np.uint8], moved: NDArray[np.bool_]) -> None:
        """One step of the worlds `moved`; `frames`, `(n_worlds, H, W)`, are those of all."""
        if moved.all():
            belief = self.predictor
            _native.correct(belief, self._likelihood, frames)
            self.posterior = belief
        else:
            belief = np.ascontiguousarray(self.predictor[:, moved])
            _native.correct(belief, self._likelihood, frames[moved])
            self.posterior[:, moved] = belief
        self.predictor = self._transition.apply(self.posterior)


class Transition:
    """The operator ``Phi`` on beliefs (eqs. 2-4) for one model on one grid.

    ``phi[m, i, j] = b[m] + sum_n sum_{a,c} w[m, n, a, c] x[n, i + a - A, j + c - C]`` with
    (A, C) the centre of the kernel (eq. 2), then divided by its sum over ``m`` (eq. 3). Outside the
    grid ``x`` is zero, or one in the model's `edge` state.

    Where the weights see the cell's own state ``o``, ``phi[m | o]`` has the weights of ``o``, its
    centre tap sees ``o`` itself, and ``u[m] = sum_o p[o] phi[m | o] / sum_m phi[m | o]``: a mean
    field, which takes neighbours for independent, as the filter does.

    It keeps work space: share none between threads.
    """

    def __init__(
        self, model: Model, *, height: int, width: int, n_worlds: int | None = None
    ) -> None:
        """Beliefs have shape (S, H, W), or with `n_worlds` (S, n_worlds, H, W)."""
        worlds = () if n_worlds is None else (n_worlds,)
        self._shape = (model.n_states, *worlds, height, width)
        self._operator = _native.Transition(model.toml, height, width)

    def apply(self, belief: NDArray[np.floating]) -> NDArray[np.float64]:
        """``Phi(belief)``, a new array of the same shape; each cell's sum is one."""
        if belief.shape != self._shape:
            raise invalid("belief", f"shape {self._shape}", belief.shape)
        belief = np.asarray(belief, np.float64)
        n_states, *_, height, width = self._shape
        beliefs = belief.reshape(n_states, -1, height, width)
        return self._operator.apply(beliefs).reshape(self._shape)


def entropy(belief: NDArray[np.floating]) -> NDArray[np.float64]:
    """Shannon entropy of each cell in nats (eq. 14), with ``0 log 0 = 0``; shape (H, W)."""
    total = np.zeros(belief.shape[1:])
    # State by state, as memory for all is got and given back in each call, which takes most time.
    for probability in belief:
        total += probability * np.log(np.where(probability > 0.0, probability, 1.0))
    return np.maximum(0.0, 0.0 - total)
