"""The Bayes filter for a known model, in numpy (paper section III.A, masked as in section III.C).

A frame turns the predictor ``u_k`` into the posterior ``p_k`` (eq. 5); the transition turns that
into the next predictor ``u_{k+1} = Phi(p_k)`` (eq. 6). Cells are treated as independent given the
frames, so this is an approximation even with the true model. `wrappers.BeliefObservation` runs it
beside an environment.

Beliefs have shape (S, H, W): one probability per state and cell, a distribution in each cell.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import EmberwatchError, InvalidArgumentError, invalid
from emberwatch.model import Model
from emberwatch.wire import UNOBSERVED

_SUM_TOLERANCE = 5e-5  # of a cell's probabilities, as the Rust agent's: 400 float32 roundings


class Filter:
    """Filter of one world: `correct` with each frame, and `predict` for each step of the world."""

    def __init__(self, model: Model, *, prior: NDArray[np.floating]) -> None:
        """Begins with the prior: predictor ``u_0``, shape (S, H, W), each cell a distribution."""
        self._belief = _distribution(prior, n_states=model.n_states)
        _, height, width = self._belief.shape
        self._transition = Transition(model, height=height, width=width)
        self._likelihood = np.ascontiguousarray(model.observation_matrix)

    @property
    def belief(self) -> NDArray[np.float64]:
        """A copy, shape (S, H, W): the posterior after `correct`, the predictor after `predict`."""
        return self._belief.copy()

    def correct(self, frame: NDArray[np.uint8]) -> None:
        """Bayes' rule on the observed cells (eq. 5); the others keep their belief.

        ``p = B(y) u / (b(y)' u)`` with ``b(y)`` the column of the observation matrix for ``y``, and
        ``B(y)`` the diagonal matrix of it. An impossible frame leaves the belief as it was.

        Args:
            frame: Observed values below O, 255 where nothing was observed; shape (H, W).
        """
        if frame.shape != self._belief.shape[1:] or frame.dtype != np.uint8:
            expected = f"shape {self._belief.shape[1:]} and type uint8"
            raise invalid("frame", expected, f"{frame.shape} and {frame.dtype}")
        _correct(self._belief, self._likelihood, frame)

    def predict(self) -> None:
        """The predictor of the next step, ``u_{k+1} = Phi(p_k)`` (eq. 6)."""
        self._belief = self._transition.apply(self._belief)

    def entropy(self) -> NDArray[np.float64]:
        """Shannon entropy of each cell in nats (eq. 14), shape (H, W), 0 to log S."""
        return entropy(self._belief)


class Filters:
    """The filters of many worlds, stepped together. Beliefs have shape (S, n_worlds, H, W)."""

    def __init__(self, model: Model, prior: NDArray[np.floating], n_worlds: int) -> None:
        """`prior`, shape (S, H, W), is that of each world."""
        self._prior = _distribution(prior, n_states=model.n_states)[:, np.newaxis]
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
        _correct(belief, self._likelihood, frames[chosen])
        self.posterior[:, chosen] = belief
        self.predictor = self._transition.apply(self.posterior)

    def update(self, frames: NDArray[np.uint8], moved: NDArray[np.bool_]) -> None:
        """One step of the worlds `moved`; `frames`, `(n_worlds, H, W)`, are those of all."""
        if moved.all():
            belief = self.predictor
            _correct(belief, self._likelihood, frames)
            self.posterior = belief
        else:
            belief = np.ascontiguousarray(self.predictor[:, moved])
            _correct(belief, self._likelihood, frames[moved])
            self.posterior[:, moved] = belief
        self.predictor = self._transition.apply(self.posterior)


def _correct(
    belief: NDArray[np.float64], likelihood: NDArray[np.float64], frames: NDArray[np.uint8]
) -> None:
    """Bayes' rule (eq. 5) in place; `belief` is contiguous, of shape (S, *frames.shape)."""
    values = frames.ravel()
    cells = np.flatnonzero(values != UNOBSERVED)
    observed = values[cells]
    n_observations = likelihood.shape[1]

    def cell(index: np.intp) -> tuple[int, int]:
        *_, row, col = np.unravel_index(int(cells[index]), frames.shape)
        return int(row), int(col)

    if (observed >= n_observations).any():
        first = np.argmax(observed >= n_observations)
        expected = f"a value below {n_observations}, or {UNOBSERVED}"
        raise invalid(f"frame: cell {cell(first)}", expected, observed[first])
    flat = belief.reshape(len(belief), -1)
    prior = flat[:, cells]
    joint = prior * likelihood[:, observed]
    evidence = joint.sum(axis=0)
    if not evidence.all():
        first = np.argmin(evidence)
        raise EmberwatchError(
            f"frame: cell {cell(first)}: expected an observation that the belief "
            f"{prior[:, first].tolist()} allows, got {observed[first]}",
            "impossible_frame",
        )
    flat[:, cells] = joint / evidence


class Transition:
    """The operator ``Phi`` on beliefs (eqs. 2-4) for one model on one grid.

    ``phi[m, i, j] = b[m] + sum_n sum_{a,c} w[m, n, a, c] x[n, i + a - A, j + c - C]`` with
    (A, C) the centre of the kernel and ``x`` zero outside the grid (eq. 2), then divided by its sum
    over ``m`` (eq. 3).

    Where the weights see the cell's own state ``o``, ``phi[m | o]`` has the weights of ``o``, its
    centre tap sees ``o`` itself, and ``u[m] = sum_o p[o] phi[m | o] / sum_m phi[m | o]``: a mean
    field, which takes neighbours for independent, as the filter does.

    It keeps work space: share none between threads. The beliefs lie in rows with a margin of
    zeros, end to end, so that a neighbour is a shifted slice. Taps with the same
    weights are added up before they are multiplied, and those without weight are left out.
    """

    def __init__(
        self, model: Model, *, height: int, width: int, n_worlds: int | None = None
    ) -> None:
        """Beliefs have shape (S, H, W), or with `n_worlds` (S, n_worlds, H, W)."""
        n_states, _, kernel_height, kernel_width = model.kernel.shape
        worlds = () if n_worlds is None else (n_worlds,)
        self._shape = (n_states, *worlds, height, width)
        self._stride = width + kernel_width - 1
        # Of all worlds, one above the other, with the margins between them.
        self._rows = (n_worlds or 1, height + kernel_height - 1)
        n_rows = self._rows[0] * self._rows[1]
        self._length = (n_rows - kernel_height) * self._stride + width
        kernels, biases = _scaled(model)
        # One column of weights for each tap: one kernel's after the other's.
        joined = np.moveaxis(kernels, 2, 0).reshape(n_states, -1, *kernels.shape[3:])
        self._groups = [_grouped_taps(weights) for weights in joined]
        self._bias = biases.reshape(-1, 1)
        self._n_kernels = len(kernels)
        top, left = kernel_height // 2, kernel_width // 2
        self._planes = np.zeros((n_states, *self._rows, self._stride))
        self._inside = self._planes[:, :, top : top + height, left : left + width]
        self._sums = np.empty((max(len(taps) for _, taps in self._groups), self._length))

    def apply(self, belief: NDArray[np.float64]) -> NDArray[np.float64]:
        """``Phi(belief)``, a new array of the same shape; each cell's sum is one."""
        if belief.shape != self._shape:
            raise invalid("belief", f"shape {self._shape}", belief.shape)
        _, *_, height, width = self._shape
        self._inside[:] = belief.reshape(self._inside.shape)
        n_rows = self._rows[0] * self._rows[1]
        out = np.empty((len(self._bias), n_rows * self._stride))
        weights = out[:, : self._length]
        weights[:] = self._bias
        for plane, (columns, groups) in zip(self._planes, self._groups, strict=True):
            for total, group in zip(self._sums, groups, strict=False):
                self._add_up(plane.ravel(), group, total)
            weights += columns @ self._sums[: len(groups)]
        rows = out.reshape(self._n_kernels, -1, *self._rows, self._stride)
        on_grid = rows[:, :, :, :height, :width]
        totals = on_grid.sum(axis=1)
        if not totals.all():
            *_, row, col = (int(at) for at in np.argwhere(totals == 0.0)[0])
            raise InvalidArgumentError(
                f"model: transition weights of cell ({row}, {col}): expected a positive sum"
            )
        if self._n_kernels > 1:
            shares = self._inside / totals
            return np.einsum("o...,om...->m...", shares, on_grid).reshape(self._shape)
        beliefs = np.divide(on_grid[0], totals[0], out=np.empty(on_grid.shape[1:]))
        return beliefs.reshape(self._shape)

    def _add_up(
        self, plane: NDArray[np.float64], taps: list[tuple[int, int]], total: NDArray[np.float64]
    ) -> None:
        starts = [row * self._stride + col for row, col in taps]
        first, *rest = (plane[start : start + self._length] for start in starts)
        total[:] = first
        for tap in rest:
            total += tap


def initial_prior(model: Model, *, height: int, width: int) -> NDArray[np.float64]:
    """The model's distribution at the start of the burn-in in every cell, shape (S, H, W)."""
    return np.tile(model.initial[:, None, None], (1, height, width))


def uniform_prior(model: Model, *, height: int, width: int) -> NDArray[np.float64]:
    """Every state equally likely in every cell, shape (S, H, W): the authors' demonstration."""
    return np.full((model.n_states, height, width), 1.0 / model.n_states)


def entropy(belief: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shannon entropy of each cell in nats (eq. 14), with ``0 log 0 = 0``; shape (H, W)."""
    logarithm = np.log(belief, out=np.zeros_like(belief), where=belief > 0.0)
    return np.maximum(0.0, 0.0 - (belief * logarithm).sum(axis=0))


def _grouped_taps(
    kernel: NDArray[np.float64],
) -> tuple[NDArray[np.float64], list[list[tuple[int, int]]]]:
    """Weights (S, groups) of a kernel (S, KH, KW), and the taps (row, col) that share each."""
    groups: dict[tuple[float, ...], list[tuple[int, int]]] = {}
    for row, col in np.ndindex(*kernel.shape[1:]):
        column = tuple(kernel[:, row, col].tolist())
        if any(column):
            groups.setdefault(column, []).append((row, col))
    columns = np.array(list(groups), dtype=np.float64).reshape(len(groups), len(kernel))
    return np.ascontiguousarray(columns.T), list(groups.values())


def _scaled(model: Model) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Kernels (K, S, S, KH, KW) and the biases (K, S) of each without a factor that eq. 3 cancels.

    Kernels that see the cell's own state have no weight in the centre: it is a part of the bias.
    """
    largest = np.array([max(w.max(), model.bias.max()) or 1.0 for w in model.kernels])
    kernels = model.kernels / largest[:, None, None, None, None]
    biases = model.bias / largest[:, None]
    if model.sees_own_state:
        row, col = kernels.shape[3] // 2, kernels.shape[4] // 2
        own = np.arange(len(kernels))
        biases += kernels[own, :, own, row, col]
        kernels[:, :, :, row, col] = 0.0
    return kernels, biases


def _distribution(prior: NDArray[np.floating], *, n_states: int) -> NDArray[np.float64]:
    """A copy of the prior, each cell's sum exactly one."""
    belief = np.array(prior, dtype=np.float64, order="C")
    if belief.ndim != 3 or belief.shape[0] != n_states or not belief.size:
        raise invalid("prior", f"shape ({n_states}, H, W)", belief.shape)
    total = belief.sum(axis=0)
    fine = (np.abs(total - 1.0) <= _SUM_TOLERANCE) & (belief >= 0.0).all(axis=0)
    if not fine.all():
        row, col = (int(i) for i in np.argwhere(~fine)[0])
        got = belief[:, row, col].tolist()
        raise invalid(f"prior: cell ({row}, {col})", "probabilities >= 0 with sum 1", got)
    belief /= total
    return belief
