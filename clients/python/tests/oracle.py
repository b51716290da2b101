"""The equations of models in NumPy, with which the tests compare the filter."""

import re
import tomllib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Parameters(NamedTuple):
    #: The parsed file.
    file: dict[str, Any]
    names: list[str]
    #: ``w[to, from, row, col]``; None for a model of hazards.
    kernel: Array | None
    bias: Array
    #: ``P(observed value | state)``: one row per state.
    observed: Array
    initial: Array
    #: Factors by name, for a model of hazards.
    maps: dict[str, Array]


def parameters(text: str, maps: dict[str, Array] | None = None) -> Parameters:
    file: dict[str, Any] = tomllib.loads(text)
    states, entries = file["states"], file.get("kernel", ())
    names = [state["name"] for state in states]
    kernel = None
    if entries:
        kernel = np.zeros((len(names), len(names), *file["kernel_size"]))
    for entry in entries:
        weights = entry.get("scale", 1.0) * np.array(entry["weights"], float)
        kernel[names.index(entry["to"]), names.index(entry["from"])] = weights
    observed = np.array([state["observed_as"] for state in states], float)
    initial = np.array([state["initial"] for state in states], float)
    return Parameters(
        file,
        names,
        kernel,
        np.array([state.get("bias", 0.0) for state in states]),
        observed / observed.sum(axis=1, keepdims=True),
        initial / initial.sum(),
        maps or {},
    )


def with_fourth_observation(text: str) -> str:
    """Adds an observation that no state shows to the text of a model with three observations."""
    text = re.sub(r"(observed_as = \[[^]]*)\]", r"\1, 0.0]", text)
    fourth = '    { name = "none", color = "#000000" },\n]'
    if "[[observations]]" in text:
        return f'{text}\n[[observations]]\nname = "none"\ncolor = "#000000"\n'
    head, rest = text.split("observations = [", 1)
    return f"{head}observations = [{rest.replace(']', fourth, 1)}"


def phi(model: Parameters, belief: Array) -> Array:
    """Predicts: by eqs. 2 to 4, or by hazards of independent neighbours."""
    if model.kernel is None:
        return _by_hazards(model, belief)
    n_states, height, width = belief.shape
    weights = np.tile(model.bias[:, np.newaxis, np.newaxis], (1, height, width))
    for row, col in np.ndindex(model.kernel.shape[2:]):
        neighbour = _neighbour(belief, model.kernel.shape[2:], row, col)
        weights += np.einsum("mn,nij->mij", model.kernel[:, :, row, col], neighbour)
    return weights / weights.sum(axis=0)


def _neighbour(belief: Array, size: tuple[int, ...], row: int, col: int) -> Array:
    _, height, width = belief.shape
    above, left = size[0] // 2, size[1] // 2
    padded = np.pad(belief, ((0, 0), (above, above), (left, left)))
    return padded[:, row : row + height, col : col + width]


def _by_hazards(model: Parameters, belief: Array) -> Array:
    following = np.zeros_like(belief)
    for own, name in enumerate(model.names):
        base, last = np.zeros(belief.shape[1:]), np.ones(belief.shape[1:])
        near = dict[tuple[int, int], Array]()
        for entry in (it for it in model.file["transitions"] if it["from"] == name):
            factors = [model.maps[key] for key in entry.get("times", ())]
            everywhere = np.ones(belief.shape[1:])
            for factor in (it for it in factors if it.ndim == 2):
                everywhere = everywhere * factor
            base = base - np.log1p(-entry.get("base", 0.0)) * everywhere
            for state, table in entry.get("near", {}).items():
                hazards = -np.log1p(-np.array(table, float))
                for row, col in np.ndindex(hazards.shape):
                    place = row - hazards.shape[0] // 2, col - hazards.shape[1] // 2
                    of_place = near.setdefault(place, np.zeros_like(belief))
                    by_place = [it[row, col] for it in factors if it.ndim == 4]
                    product = np.prod([everywhere, *by_place], axis=0)
                    of_place[model.names.index(state)] += hazards[row, col] * product
            none = np.exp(-base)
            for (down, right), hazards in near.items():
                size = 2 * abs(down) + 1, 2 * abs(right) + 1
                neighbour = _neighbour(belief, size, down + size[0] // 2, right + size[1] // 2)
                none = none * (1.0 + (neighbour * np.expm1(-hazards)).sum(axis=0))
            following[model.names.index(entry["to"])] += belief[own] * (last - none)
            last = none
        following[own] += belief[own] * last
    return following


def bayes(model: Parameters, belief: Array, frame: NDArray[np.uint8]) -> Array:
    """Corrects the observed cells (eq. 5); 255 marks the other cells."""
    posterior = belief.copy()
    for row, col in np.argwhere(frame != 255):
        joint = model.observed[:, frame[row, col]] * belief[:, row, col]
        posterior[:, row, col] = joint / joint.sum()
    return posterior
