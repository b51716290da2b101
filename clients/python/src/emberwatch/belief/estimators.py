"""Beliefs of every kind that the Rust agent has, with its numbers to the bit.

`known` makes one of a model, `load` one of a checkpoint. Both give a `Belief`, which is fed with
frames.
"""

from os import PathLike
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

import emberwatch._native as _native
from emberwatch.belief.prior import distribution
from emberwatch.common.arguments import as_array, as_count, as_flag, as_integer, told
from emberwatch.common.paths import utf8
from emberwatch.errors import invalid
from emberwatch.model import Model

_Number = TypeVar("_Number", np.float32, np.float64)

#: Maximum number of worlds of one belief.
_MAX_WORLDS = 1 << 20


def kinds() -> dict[str, str]:
    """The kinds of belief by name, and what each of them is: ``"known"``, ``"learned"``, ..."""
    return dict(_native.belief_kinds())


def known(
    model: Model | str | Path,
    *,
    prior: ArrayLike,
    kind: str = "known",
    n_worlds: int | None = None,
) -> "Belief":
    """A belief that predicts with a known model, before its first frame.

    Args:
        model: A `Model`, the name of a built-in one, or the path of a model file.
        prior: The first belief: a distribution over the states in each cell, shape (S, H, W), such
            as `initial_prior` or `prior.simulated_prior` give. Kept in single precision.
        kind: One of `kinds` that knows the model: ``"known"`` is the Bayes filter of the paper,
            with `+second-order` or `+cavities` its prediction is more exact, and with `+spatial` a
            frame corrects the neighbours of the seen cells, too.
        n_worlds: Number of worlds, at least 1; None: a single one, without an axis for worlds.

    Raises:
        InvalidArgumentError: If a cell of the prior is no distribution, or has another number of
            states than the model; if there is no such kind; or if the model's weights can all be 0.
    """
    model = model if isinstance(model, Model) else Model.named(model)
    numbers = distribution(prior, n_states=model.n_states).astype(np.float32)
    n = _n_worlds(n_worlds)
    native = _native.Estimators.known(model.toml, numbers, kind, n)
    return Belief(native, is_single=n_worlds is None)


def load(
    checkpoint: str | PathLike[str],
    *,
    height: int,
    width: int,
    kind: str | None = None,
    model: Model | str | Path | None = None,
    n_worlds: int | None = None,
) -> "Belief":
    """A belief that was learned, from a checkpoint of `emberwatch-agent train`.

    Its states are those that its learner found: `Belief.state_names` has numbers, and
    `Belief.target_state` is the one that pays most. A neural belief is about what cells show;
    ``"neural+sensor"`` traces that back to states with the observation matrix of `model`.

    Args:
        checkpoint: The file. Filters and neural beliefs fit any grid; an autoencoder its own.
        height: Rows of the grid.
        width: Columns of the grid.
        kind: One of `kinds` that was learned, such as ``"learned+spatial"``; None: the belief that
            the checkpoint is about.
        model: The model of the worlds, if the checkpoint should be checked against it: number of
            observed values and of observation matrices. Needed by ``"neural+sensor"``.
        n_worlds: Number of worlds, at least 1; None: a single one, without an axis for worlds.

    Raises:
        InvalidArgumentError: If the file is no whole checkpoint, lacks what the kind needs, does
            not fit the grid or the model, or holds decisions on a belief that needs a model.
    """
    if model is not None and not isinstance(model, Model):
        model = Model.named(model)
    grid = tuple(
        as_count(side, name, 1, _native.MAX_SIDE)
        for side, name in ((height, "height"), (width, "width"))
    )
    toml = None if model is None else model.toml
    path, n = utf8("checkpoint", checkpoint), _n_worlds(n_worlds)
    native = _native.Estimators.load(path, (grid[0], grid[1]), kind, toml, n)
    return Belief(native, is_single=n_worlds is None)


class Belief:
    """The belief about a world, or about several: `known` and `load` make it.

    At step k, `correct` it with the frame of X_k, read `belief`, and `predict` X_{k+1}:

    - Frames have shape (H, W), beliefs (S, H, W). With `n_worlds`, frames have shape
      (n_worlds, H, W), beliefs (S, n_worlds, H, W), and methods take `worlds`: a mask, an index or
      several, or a slice; None is all.
    - All numbers are single precision and, to the bit, those of the Rust agent; those of networks
      may depend on the processor.
    - Beliefs with `+spatial` learn while they run how cells vary together, each world for itself:
      the frames of one episode improve its later corrections. A `reset` forgets this, but for what
      a checkpoint brought, unless it is told to keep it.

    It keeps work space: one thread at a time may use it.
    """

    def __init__(self, native: _native.Estimators, *, is_single: bool) -> None:
        """See `known` and `load`."""
        self._native, self._is_single = native, is_single
        self._shape = native.shape

    @property
    def kind(self) -> str:
        """The name of its kind, one of `kinds`."""
        return self._native.kind

    @property
    def state_names(self) -> tuple[str, ...]:
        """The S states of its first axis."""
        return tuple(self._native.state_names)

    @property
    def target_state(self) -> int:
        """The state that pays most, by its number in the first axis."""
        return self._native.target_state

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of its frames: (H, W), or (n_worlds, H, W)."""
        return self._shape[1:] if self._is_single else self._shape

    @property
    def n_observations(self) -> int:
        """Number of observed values: frames have values below, or 255 where nothing was seen."""
        return self._native.n_observations

    @property
    def belief(self) -> NDArray[np.float32]:
        """A copy: the posterior after `correct`, the predictor after `predict`."""
        beliefs = self._native.belief()
        return beliefs[:, 0] if self._is_single else beliefs

    def entropy(self) -> NDArray[np.float32]:
        """Shannon entropy of each cell in nats (eq. 14), 0 to log S up to rounding."""
        return self._of_worlds(self._native.entropy())

    def reset(
        self, worlds: ArrayLike | slice | None = None, *, keep_correlations: bool = False
    ) -> None:
        """Begins again with the first belief, before a frame.

        Args:
            worlds: The worlds that begin again.
            keep_correlations: Whether beliefs with `+spatial` go on with what they have learned of
                how cells vary together.
        """
        keeps = as_flag(keep_correlations, "keep_correlations")
        self._native.reset(self._chosen(worlds), keeps)

    def correct(self, frames: NDArray[np.uint8], worlds: ArrayLike | slice | None = None) -> None:
        """Corrects the belief with frames (eq. 5).

        Args:
            frames: Observed values, 255 where nothing was observed; those of all worlds, also if
                only some are chosen.
            worlds: The worlds to correct.

        Raises:
            InvalidArgumentError: If a frame has another shape or values of another model; no belief
                has changed.
            EmberwatchError: Code ``"impossible_frame"``: the belief rules a frame out. That world
                keeps its belief; other worlds are corrected.
        """
        self._native.correct(self._frames(frames, "frame"), self._chosen(worlds))

    def predict(self, worlds: ArrayLike | slice | None = None) -> None:
        """Moves the belief one step of the world ahead (eq. 6)."""
        self._native.predict(self._chosen(worlds))

    def score_states(
        self, states: NDArray[np.uint8], *, target: int | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Log loss, Brier score and accuracy against the hidden states, see `score`.

        One number each, or one for each world, `(n_worlds,)`.
        """
        figures = self._native.scores(self._frames(states, "states"), target_of(self, target))
        losses, briers, accuracies = (self._of_worlds(figure) for figure in figures)
        return losses, briers, accuracies

    def score_frames(
        self, frames: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Log-likelihood of frames, summed over the seen cells, and the number of these cells."""
        sums, n_seen = self._native.score_frames(self._frames(frames, "frame"))
        return self._of_worlds(sums), self._of_worlds(n_seen)

    def _frames(self, frames: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
        """Frames or states with an axis for worlds."""
        given = as_array(frames, name, "an array")
        if given.shape != self.shape or given.dtype != np.uint8:
            got = f"{given.shape} and {given.dtype}"
            raise invalid(name, f"shape {self.shape} and type uint8", got)
        return given[np.newaxis] if self._is_single else given

    def _chosen(self, worlds: ArrayLike | slice | None) -> NDArray[np.bool_]:
        """The mask of the chosen worlds."""
        chosen = np.zeros(self._shape[0], np.bool_)
        expected = f"a mask or indices of {len(chosen)} worlds, or a slice"
        index = slice(None) if worlds is None else worlds
        if not isinstance(index, slice):
            index = as_array(index, "worlds", expected)
            is_mask = index.dtype == np.bool_
            if not index.size and not is_mask:
                index = index.astype(np.intp)  # NumPy reads [] as float64
            if index.ndim > 1 or (is_mask and index.shape != chosen.shape):
                raise invalid("worlds", expected, told(worlds))
        try:
            chosen[index] = True
        except (IndexError, TypeError, ValueError):
            raise invalid("worlds", expected, told(worlds)) from None
        return chosen

    def _of_worlds(self, values: NDArray[_Number]) -> NDArray[_Number]:
        return values[0] if self._is_single else values


def target_of(belief: Belief, target: int | None) -> int:
    """Checks the number of a target state; None: the belief's own."""
    names = belief.state_names
    number = belief.target_state if target is None else as_integer(target)
    if number is not None and not isinstance(target, bool) and 0 <= number < len(names):
        return number
    expected = f"an integer within 0 to {len(names) - 1} ({', '.join(names)})"
    raise invalid("target", expected, told(target))


def _n_worlds(n_worlds: int | None) -> int:
    return 1 if n_worlds is None else as_count(n_worlds, "n_worlds", 1, _MAX_WORLDS)
