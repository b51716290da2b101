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

import numpy as np
from numpy.typing import NDArray

from emberwatch.belief.estimators import RECOMMENDED as RECOMMENDED
from emberwatch.belief.estimators import Belief as Belief
from emberwatch.belief.estimators import Kind as Kind
from emberwatch.belief.estimators import kinds as kinds
from emberwatch.belief.estimators import known as known
from emberwatch.belief.estimators import load as load
from emberwatch.belief.prior import initial_prior as initial_prior
from emberwatch.belief.prior import uniform_prior as uniform_prior
from emberwatch.belief.scoring import BeliefScores as BeliefScores
from emberwatch.belief.scoring import score as score
from emberwatch.common.codes import UNOBSERVED as UNOBSERVED


def entropy(belief: NDArray[np.floating]) -> NDArray[np.float64]:
    """Returns the Shannon entropy of each cell in nats (eq. 14), with ``0 log 0 = 0``; (H, W)."""
    total = np.zeros(belief.shape[1:])
    # One state at a time: temporary arrays for all states at once would take longer to allocate.
    for probability in belief:
        total += probability * np.log(np.where(probability > 0.0, probability, 1.0))
    return np.maximum(0.0, 0.0 - total)
