"""Beliefs about worlds: the probability of each state in each cell, given the frames so far.

`known` makes a `Belief` from a model, `load` makes one from a checkpoint. Together they offer every
kind of belief that the Rust agent has. `score` compares a belief with recorded worlds.
`wrappers.BeliefObservation` adds a belief to an environment.

The kind ``"known"`` is the Bayes filter of a known model (paper section III.A), which corrects only
observed cells (section III.C). A frame turns the predictor ``u_k`` into the posterior ``p_k``
(eq. 5). The transition turns the posterior into the next predictor ``u_{k+1} = Phi(p_k)`` (eq. 6).
The filter treats cells as independent given the frames, so it is an approximation even with the
true model.

Beliefs have shape (S, H, W) with S states: a distribution in each cell.
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
    """Bayes filters of many worlds in double precision, for the environments' observations.

    Beliefs have shape (S, n_worlds, H, W). Environments keep double precision because their
    observations must not change from release to release. For other uses, `known` makes the agent's
    filter, in single precision.
    """

    def __init__(self, model: Model, prior: NDArray[np.floating], n_worlds: int) -> None:
        """Starts all worlds from the same `prior`, shape (S, H, W)."""
        first = distribution(prior, n_states=model.n_states)
        first /= first.sum(axis=0)
        self._prior = first[:, np.newaxis]
        _, _, height, width = self._prior.shape
        self._transition = Transition(model, height=height, width=width, n_worlds=n_worlds)
        self._likelihood = np.ascontiguousarray(model.observation_matrix)
        #: The posterior ``p_k``, given all frames so far.
        self.posterior = np.repeat(self._prior, n_worlds, axis=1)
        #: The predictor ``u_{k+1}``: the belief about the states that the next paths will observe.
        self.predictor = self.posterior

    def reset(self, indices: Sequence[int], frames: NDArray[np.uint8]) -> None:
        """Resets the worlds `indices` to the prior, then corrects them with their frames.

        `frames` has one frame per world, shape (n_worlds, H, W).
        """
        chosen = list(indices)
        belief = np.repeat(self._prior, len(chosen), axis=1)
        _native.correct(belief, self._likelihood, frames[chosen])
        self.posterior[:, chosen] = belief
        self.predictor = self._transition.apply(self.posterior)

    def update(self, frames: NDArray[np.uint8], moved: NDArray[np.bool_]) -> None:
        """Corrects the worlds `moved` with their frames, then predicts.

        `frames` has one frame per world, shape (n_worlds, H, W).
        """
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
    grid ``x`` is zero for all states, or, if the model has an `edge` state, one for that state.

    A model whose weights depend on the cell's own state ``o`` has a kernel for each ``o``.
    ``phi[m | o]`` is computed with the kernel of ``o`` and the state ``o`` at its centre. The
    result is ``u[m] = sum_o p[o] phi[m | o] / sum_m phi[m | o]``. This is a mean-field
    approximation: it treats neighbours as independent, as the filter does.

    Threads must not share an instance, because it reuses scratch memory.
    """

    def __init__(
        self, model: Model, *, height: int, width: int, n_worlds: int | None = None
    ) -> None:
        """Beliefs have shape (S, H, W), or with `n_worlds` (S, n_worlds, H, W)."""
        worlds = () if n_worlds is None else (n_worlds,)
        self._shape = (model.n_states, *worlds, height, width)
        self._operator = _native.Transition(model.toml, height, width)

    def apply(self, belief: NDArray[np.floating]) -> NDArray[np.float64]:
        """Returns ``Phi(belief)``: a new array of the same shape; each cell's sum is one."""
        if belief.shape != self._shape:
            raise invalid("belief", f"shape {self._shape}", belief.shape)
        belief = np.asarray(belief, np.float64)
        n_states, *_, height, width = self._shape
        beliefs = belief.reshape(n_states, -1, height, width)
        return self._operator.apply(beliefs).reshape(self._shape)


def entropy(belief: NDArray[np.floating]) -> NDArray[np.float64]:
    """Returns the Shannon entropy of each cell in nats (eq. 14), with ``0 log 0 = 0``; (H, W)."""
    total = np.zeros(belief.shape[1:])
    # One state at a time: temporary arrays for all states at once would take longer to allocate.
    for probability in belief:
        total += probability * np.log(np.where(probability > 0.0, probability, 1.0))
    return np.maximum(0.0, 0.0 - total)
