"""Scores of a belief on recorded sequences of frames and hidden states."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emberwatch.belief.estimators import Belief
from emberwatch.errors import invalid


@dataclass(frozen=True, slots=True, kw_only=True)
class BeliefScores:
    """Scores of each step: shape (K,), or (K, n_worlds) for a belief about several worlds."""

    #: Mean over all cells of ``-log p`` in nats, with `p` the posterior probability of the cell's
    #: true state. 0 is perfect; infinite if the belief ruled out the true state of a cell.
    log_loss: NDArray[np.float64]
    #: Mean over all cells of ``(p - 1[state is the target])**2``, with `p` the posterior
    #: probability of the target state. 0 is perfect, 1 is the worst.
    brier: NDArray[np.float64]
    #: Share of the cells whose most probable state is the true state, 0 to 1.
    accuracy: NDArray[np.float64]
    #: Mean over the observed cells of ``-log P(y)`` in nats, with ``P(y)`` the probability of the
    #: observation `y` under the predictor. NaN in steps without an observed cell.
    predicted_log_loss: NDArray[np.float64]
    #: Number of observed cells.
    n_seen: NDArray[np.int64]

    def mean(self) -> dict[str, Any]:
        """Returns the mean of each score over the steps, by name.

        Each mean is a number, or an array of shape (n_worlds,) for a belief about several worlds.
        All steps have the same weight, except in `predicted_log_loss`, where all observed cells
        have the same weight.
        """
        figures = ("log_loss", "brier", "accuracy")
        means: dict[str, Any] = {name: getattr(self, name).mean(axis=0) for name in figures}
        sums = np.nansum(self.predicted_log_loss * self.n_seen, axis=0)
        means["predicted_log_loss"] = _per_cell(sums, self.n_seen.sum(axis=0))[()]
        return means


def score(
    belief: Belief,
    observations: NDArray[np.uint8],
    states: NDArray[np.uint8],
    *,
    target: int | None = None,
    keep_correlations: bool = False,
) -> BeliefScores:
    """Scores a belief on a recorded sequence, or on one sequence for each of its worlds.

    Resets the belief first. In each step k it scores the prediction of frame k, corrects the belief
    with this frame, scores the posterior against state k, and predicts step k + 1. The posterior is
    scored in all cells, observed or not.

    A learned belief has its own order of states. Its `log_loss` and `accuracy` are meaningful only
    if this order agrees with `states`. `brier` compares the probability of the belief's
    `target_state` with the cells where `states` equals `target`.

    Args:
        belief: A belief from `known` or `load`, for one world, or for one world per sequence.
        observations: Frames, type uint8, shape (K, H, W) or (K, n_worlds, H, W), 255 in unobserved
            cells. K is at least 1.
        states: Hidden states of the same shape and type, below S.
        target: The value in `states` of the state that pays most; None: `belief.target_state`.
        keep_correlations: Whether kinds with `+spatial` keep the correlations that they have
            learned on earlier sequences, as in `Belief.reset`.

    Raises:
        InvalidArgumentError: If an array does not have the belief's shape, type or values, or
            `target` is not a state. The belief is then at the step before.
        EmberwatchError: Code ``"impossible_frame"``, if a frame has probability 0 under the belief.
    """
    if not 0 < len(observations) == len(states):
        expected = f"{len(observations)} steps, as in observations, at least 1"
        raise invalid("states", expected, len(states))
    belief.reset(keep_correlations=keep_correlations)
    rows = list[tuple[Any, ...]]()
    for frame, truth in zip(observations, states, strict=True):
        predicted = belief.score_frames(frame)
        belief.correct(frame)
        rows.append((*predicted, *belief.score_states(truth, target=target)))
        belief.predict()
    sums, n_seen, losses, briers, accuracies = (
        np.stack(column) for column in zip(*rows, strict=True)
    )
    return BeliefScores(
        log_loss=losses,
        brier=briers,
        accuracy=accuracies,
        predicted_log_loss=_per_cell(-sums, n_seen),
        n_seen=n_seen.astype(np.int64),
    )


def _per_cell(sums: NDArray[np.float64], n_seen: NDArray[Any]) -> NDArray[np.float64]:
    """Divides sums by numbers of seen cells; NaN where no cell was seen."""
    return np.where(n_seen > 0, sums / np.maximum(n_seen, 1), np.nan)
