"""All kinds of belief that the Rust agent has, with bit-identical results.

`known` makes a `Belief` from a model, `load` makes one from a checkpoint.
"""

from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Final, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

import emberwatch._native as _native
from emberwatch.common.arguments import as_array, as_count, as_flag
from emberwatch.common.paths import utf8
from emberwatch.errors import invalid, repr_of
from emberwatch.model import Model

_Number = TypeVar("_Number", np.float32, np.float64, np.uint8)

#: Maximum number of worlds of one belief.
_MAX_WORLDS = 1 << 20


#: The default kind where a model is known; ``"known"`` is the paper's filter.
RECOMMENDED: Final = _native.RECOMMENDED


class Kind(NamedTuple):
    """The properties of a kind of belief."""

    #: Short description.
    about: str
    #: Whether it uses the worlds' model.
    knows_model: bool
    #: Whether `load` makes it, from a checkpoint, instead of `known`.
    needs_checkpoint: bool
    #: Whether `WildfireObjectiveEnv` can plan on it.
    has_options: bool


def kinds() -> dict[str, Kind]:
    """Returns the kinds of belief, such as ``"known"`` and ``"learned"``."""
    return {name: Kind(*facts) for name, facts in _native.belief_kinds()}


def known(
    model: Model | str | Path,
    *,
    prior: ArrayLike,
    kind: str = RECOMMENDED,
    n_worlds: int | None = None,
) -> "Belief":
    """Makes a belief that predicts with a known model.

    Args:
        model: A `Model`, the name of a built-in one, or the path of a model file.
        prior: The belief before the first frame: a distribution over the states in each cell, shape
            (S, H, W), from `initial_prior` or `prior.simulated_prior` for example. It is stored in
            single precision.
        kind: A kind of `kinds` that needs no checkpoint. ``"known"`` is the paper's Bayes filter.
            With `+cavities`, it predicts models of hazards more accurately.
            With `+spatial`, a frame also corrects the neighbours of the observed cells.
        n_worlds: Number of worlds, at least 1. None: a single world, and arrays without an axis
            for worlds.

    Raises:
        InvalidArgumentError: If the prior does not have the model's states, or is not a
            distribution in some cell; if the kind does not exist or is a learned one; or if the
            weights of all next states of a cell can be 0 at once.
        NotEnoughMemoryError: If beliefs about `n_worlds` worlds do not fit in memory.
    """
    model = Model.named(model)
    expected = f"numbers of shape ({model.n_states}, H, W)"
    given = as_array(prior, "prior", expected)
    if given.ndim != 3 or len(given) != model.n_states or given.dtype.kind not in "fiu":
        raise invalid("prior", expected, f"{given.dtype} of shape {given.shape}")
    with np.errstate(over="ignore"):  # infinity is refused
        numbers = given.astype(np.float32, order="C")
    return Belief(_native.Estimators.known(model.toml, numbers, kind, _n_worlds(n_worlds)))


def load(
    checkpoint: str | PathLike[str],
    *,
    height: int | None = None,
    width: int | None = None,
    kind: str | None = None,
    model: Model | str | Path | None = None,
    n_worlds: int | None = None,
) -> "Belief":
    """Loads a learned belief from a checkpoint of `emberwatch-agent train`, or a saved belief.

    A file of `Belief.save` is loaded by its path alone, and continues in the state in which it was
    saved: ``load("noon.belief")``. Everything below is about checkpoints.

    A learned belief has its own order of states: `Belief.state_names` are ``"state 0"`` and so on,
    and `Belief.target_state` is the number of the state that pays most. A neural belief predicts
    observed values instead of states, so S = O.

    Args:
        checkpoint: Path of the file. Filters and neural beliefs fit any grid, an autoencoder only
            the grid that it was trained on. A checkpoint requires `height` and `width`.
        height: Rows of the grid.
        width: Columns of the grid.
        kind: A learned kind of `kinds`, such as ``"learned+spatial"``. None: the kind that the
            checkpoint was trained for.
        model: The model of the worlds. If given, the checkpoint must have the same number of
            observed values.
        n_worlds: Number of worlds, at least 1. None: a single world, and arrays without an axis
            for worlds.

    Raises:
        InvalidArgumentError: If the file is not a complete checkpoint, does not fit the kind, the
            grid or the model, or contains decisions trained on the belief of a known model. If the
            file is a damaged saved belief, or a saved belief is given other arguments.
        NotEnoughMemoryError: If beliefs about `n_worlds` worlds do not fit in memory.
    """
    grid = None
    if height is not None or width is not None:
        rows = as_count(height, "height", 1, _native.MAX_SIDE)
        grid = rows, as_count(width, "width", 1, _native.MAX_SIDE)
    toml = None if model is None else Model.named(model).toml
    path, n = utf8("checkpoint", checkpoint), _n_worlds(n_worlds)
    return Belief(_native.Estimators.load(path, grid, kind, toml, n))


class Belief:
    """A belief about one world or several; `known` and `load` make one.

    At step k, `correct` the belief with the frame of X_k, read `belief`, then `predict` X_{k+1}.

    - Frames have shape (H, W), beliefs (S, H, W). With `n_worlds`, frames have shape
      (n_worlds, H, W) and beliefs (S, n_worlds, H, W). Methods then accept `worlds`: a mask,
      indices, or a slice. None selects all worlds.
    - Values are single precision, bit-identical to the Rust agent's. Outputs of networks may
      differ between processors.
    - Kinds with `+spatial` learn correlations between cells while they run, separately for each
      world, so that earlier frames improve later corrections. `reset` discards these correlations,
      unless `keep_correlations` is true. It never discards correlations that were loaded from a
      checkpoint.

    - `copy.copy`, `copy.deepcopy` and `pickle` make independent copies, as `copy` does. A pickle
      has everything that the belief needs: the model or the checkpoint, the first belief, and the
      state. An autoencoder's belief cannot be copied or saved: `InvalidArgumentError`.
    - Signals such as Ctrl-C end every call about many worlds, between two worlds. After an
      unfinished `correct` or `predict`, the belief refuses all calls with an `EmberwatchError`,
      code ``"interrupted"``, until a `reset` of all worlds.

    Only one thread at a time may use a belief.
    """

    def __init__(self, native: _native.Estimators) -> None:
        """Wraps a native object; call `known` or `load` instead."""
        self._native, self._is_single = native, native.is_single
        self._shape = native.shape

    def __repr__(self) -> str:
        """Shows kind, shape, worlds and step: the number of predictions since the first belief."""
        steps = self._native.steps()
        ends = None if steps is None else dict.fromkeys((min(steps), max(steps)))
        step = "unfinished" if ends is None else " to ".join(map(str, ends))
        return f"Belief({self.kind!r}, shape={self.shape}, worlds={self._shape[0]}, step={step})"

    def __copy__(self) -> "Belief":
        return self.copy()

    def __deepcopy__(self, memo: object) -> "Belief":
        return self.copy()

    def __reduce__(self) -> tuple[Callable[[bytes], "Belief"], tuple[bytes]]:
        return _from_bytes, (self._native.to_bytes(),)

    def copy(self) -> "Belief":
        """Returns an independent copy in the same state.

        Raises:
            InvalidArgumentError: If the kind cannot be copied, as ``"autoencoder"``.
            NotEnoughMemoryError: If the copy does not fit in memory.
        """
        return Belief(self._native.copy())

    def save(self, path: str | PathLike[str]) -> None:
        """Writes the belief to a file for `load`, completely or not at all.

        Raises:
            InvalidArgumentError: If the kind cannot be saved, as ``"autoencoder"``, or the file
                cannot be written.
        """
        self._native.save(utf8("path", path))

    def sample(self, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Draws the state of each cell from the cell's own distribution.

        Draws one integer from `rng`, so equal generators give equal samples. Correlations between
        cells are not sampled.

        Returns:
            Indices of states, shape (H, W), or (n_worlds, H, W).

        Raises:
            InvalidArgumentError: If the belief is about observations instead of states
                (``"neural"``), or `rng` is not a NumPy generator.
        """
        if not isinstance(cast("object", rng), np.random.Generator):
            raise invalid("rng", "a numpy.random.Generator", repr_of(rng))
        seed = int(rng.integers(2**64, dtype=np.uint64))
        return self._of_worlds(self._native.sample(seed))

    @property
    def kind(self) -> str:
        """The kind of this belief, a key of `kinds`."""
        return self._native.kind

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the S states, in the order of the first axis."""
        return tuple(self._native.state_names)

    @property
    def target_state(self) -> int:
        """Index of the state that pays most, along the first axis."""
        return self._native.target_state

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the frames: (H, W), or (n_worlds, H, W)."""
        return self._shape[1:] if self._is_single else self._shape

    @property
    def n_observations(self) -> int:
        """Number O of observed values: frames contain 0 to O - 1, and 255 for unobserved cells."""
        return self._native.n_observations

    @property
    def belief(self) -> NDArray[np.float32]:
        """The posterior after `correct`, the predictor after `predict`; a copy."""
        beliefs = self._native.belief()
        return beliefs[:, 0] if self._is_single else beliefs

    def entropy(self) -> NDArray[np.float32]:
        """Returns the Shannon entropy of each cell in nats (eq. 14): 0 to log S, up to rounding.

        Shape (H, W), or (n_worlds, H, W).
        """
        return self._of_worlds(self._native.entropy())

    def reset(
        self, worlds: ArrayLike | slice | None = None, *, keep_correlations: bool = False
    ) -> None:
        """Resets the belief to its state before the first frame.

        Args:
            worlds: The worlds to reset.
            keep_correlations: Whether kinds with `+spatial` keep the learned correlations
                between cells. No effect on other kinds.
        """
        keeps = as_flag(keep_correlations, "keep_correlations")
        self._native.reset(self._chosen(worlds), keeps)

    def correct(self, frames: NDArray[np.uint8], worlds: ArrayLike | slice | None = None) -> None:
        """Corrects the belief with frames (eq. 5).

        Two robots over one cell in the same step read the same value. So merge the frames of a team
        before you correct, with `numpy.minimum`, as 255 is unobserved: two corrections would count
        one reading twice.

        Args:
            frames: Observed values, type uint8, 255 in unobserved cells. One frame for each world,
                even if `worlds` selects only some.
            worlds: The worlds to correct.

        Raises:
            InvalidArgumentError: If the frames have another shape, type or range of values than
                the belief expects. No belief changes.
            EmberwatchError: Code ``"impossible_frame"``, if a frame has probability 0 under the
                belief. That world keeps its belief; the other worlds are corrected. The error's
                attribute `worlds` lists all refused worlds.
        """
        self._native.correct(self._frames(frames, "frame"), self._chosen(worlds))

    def predict(self, worlds: ArrayLike | slice | None = None) -> None:
        """Predicts: moves the belief from X_k to X_{k+1} (eq. 6)."""
        self._native.predict(self._chosen(worlds))

    def score_states(
        self, states: NDArray[np.uint8], *, target: int | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Scores the belief against hidden states: log loss, Brier score and accuracy.

        `BeliefScores` defines the scores. Each score is a number, or with `n_worlds` an array of
        shape (n_worlds,). `states` has the shape and type of frames, and values below S. `target`
        is the value in `states` of the state that pays most; None: `target_state`.
        """
        if target is None:
            target = self.target_state
        target = as_count(target, "target", 0, len(self.state_names) - 1)
        figures = self._native.scores(self._frames(states, "states"), target)
        losses, briers, accuracies = (self._of_worlds(figure) for figure in figures)
        return losses, briers, accuracies

    def score_frames(
        self, frames: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the log-likelihood of frames under the belief, and the number of observed cells.

        The log-likelihood is a sum over the observed cells. Each result is a number, or with
        `n_worlds` an array of shape (n_worlds,).
        """
        sums, n_seen = self._native.score_frames(self._frames(frames, "frame"))
        return self._of_worlds(sums), self._of_worlds(n_seen)

    def _frames(self, frames: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
        """Checks frames or states, and adds an axis for worlds if they have none."""
        given = as_array(frames, name, "an array")
        if given.shape != self.shape or given.dtype != np.uint8:
            got = f"{given.shape} and {given.dtype}"
            raise invalid(name, f"shape {self.shape} and type uint8", got)
        return given[np.newaxis] if self._is_single else given

    def _chosen(self, worlds: ArrayLike | slice | None) -> NDArray[np.bool_]:
        """Returns the mask of the chosen worlds."""
        chosen = np.zeros(self._shape[0], np.bool_)
        n = len(chosen)
        expected = f"a mask of {n} worlds, indices from 0 to {n - 1}, or a slice"
        index = slice(None) if worlds is None else worlds
        if not isinstance(index, slice):
            index = as_array(index, "worlds", expected)
            if not index.size and index.dtype != np.bool_:
                index = index.astype(np.intp)  # NumPy reads [] as float64
            if index.ndim > 1 or index.shape == () and index.dtype == np.bool_:
                raise invalid("worlds", expected, repr_of(worlds))
        try:
            chosen[index] = True
        except (IndexError, TypeError, ValueError):
            raise invalid("worlds", expected, repr_of(worlds)) from None
        return chosen

    def _of_worlds(self, values: NDArray[_Number]) -> NDArray[_Number]:
        return values[0] if self._is_single else values


def _n_worlds(n_worlds: int | None) -> int | None:
    return None if n_worlds is None else as_count(n_worlds, "n_worlds", 1, _MAX_WORLDS)


def _from_bytes(saved: bytes) -> Belief:
    """Restores a pickled belief."""
    return Belief(_native.Estimators.from_bytes(saved))
