"""The paper's equations in NumPy, with which the tests compare the filter."""

import re
import tomllib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Parameters(NamedTuple):
    #: ``w[own, to, from, row, col]``: one kernel, or one per state of the cell itself, per zone.
    kernels: Array
    bias: Array
    #: ``P(observed value | state)``: one row per state.
    observed: Array
    initial: Array
    #: The zone of each cell, if the model has zones.
    zones: NDArray[np.uint8] | None


def parameters(text: str) -> Parameters:
    file: dict[str, Any] = tomllib.loads(text)
    states, entries = file["states"], file["kernel"]
    names = [state["name"] for state in states]
    zones = [zone["name"] for zone in file.get("zones", ())]
    n_own = len(names) if any("own" in entry for entry in entries) else 1
    n_kernels = n_own * max(1, len(zones))
    kernels = np.zeros((n_kernels, len(names), len(names), *file["kernel_size"]))
    for entry in entries:
        own = names.index(entry["own"]) if "own" in entry else 0
        own += n_own * (zones.index(entry["zone"]) if zones else 0)
        weights = entry.get("scale", 1.0) * np.array(entry["weights"], float)
        kernels[own, names.index(entry["to"]), names.index(entry["from"])] = weights
    observed = np.array([state["observed_as"] for state in states], float)
    initial = np.array([state["initial"] for state in states], float)
    return Parameters(
        kernels,
        np.array([state.get("bias", 0.0) for state in states]),
        observed / observed.sum(axis=1, keepdims=True),
        initial / initial.sum(),
        np.array(file["zone_map"], np.uint8) if zones else None,
    )


def with_fourth_observation(text: str) -> str:
    """Adds an observation that no state shows to the text of a model with three observations."""
    text = re.sub(r"(observed_as = \[.*)\]", r"\1, 0.0]", text)
    return f'{text}\n[[observations]]\nname = "none"\ncolor = "#000000"\n'


def phi(model: Parameters, belief: Array) -> Array:
    """Predicts (eqs. 2-4). Kernels for own states are averaged over the belief about the cell."""
    if model.zones is not None:
        of_zones = np.split(model.kernels, int(model.zones.max()) + 1)
        parts = [phi(model._replace(kernels=of, zones=None), belief) for of in of_zones]
        return np.take_along_axis(np.stack(parts), model.zones[np.newaxis, np.newaxis], 0)[0]
    if len(model.kernels) == 1:
        return _phi_of(model.kernels[0], model.bias, belief)
    parts = (_phi_of(w, model.bias, belief, own) for own, w in enumerate(model.kernels))
    return np.sum([belief[own] * part for own, part in enumerate(parts)], axis=0)


def _phi_of(kernel: Array, bias: Array, belief: Array, own: int | None = None) -> Array:
    n_states, height, width = belief.shape
    above, left = kernel.shape[2] // 2, kernel.shape[3] // 2
    padded = np.pad(belief, ((0, 0), (above, above), (left, left)))
    weights = np.tile(bias[:, np.newaxis, np.newaxis], (1, height, width))
    for row, col in np.ndindex(kernel.shape[2:]):
        neighbour = padded[:, row : row + height, col : col + width]
        if own is not None and (row, col) == (above, left):
            neighbour = np.zeros_like(belief)
            neighbour[own] = 1.0
        weights += np.einsum("mn,nij->mij", kernel[:, :, row, col], neighbour)
    return weights / weights.sum(axis=0)


def bayes(model: Parameters, belief: Array, frame: NDArray[np.uint8]) -> Array:
    """Corrects the observed cells (eq. 5); 255 marks the other cells."""
    posterior = belief.copy()
    for row, col in np.argwhere(frame != 255):
        joint = model.observed[:, frame[row, col]] * belief[:, row, col]
        posterior[:, row, col] = joint / joint.sum()
    return posterior
