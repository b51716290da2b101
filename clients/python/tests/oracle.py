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


def parameters(text: str) -> Parameters:
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
    """Predicts with a kernel (eqs. 2 to 4)."""
    assert model.kernel is not None
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


def bayes(model: Parameters, belief: Array, frame: NDArray[np.uint8]) -> Array:
    """Corrects the observed cells (eq. 5); 255 marks the other cells."""
    posterior = belief.copy()
    for row, col in np.argwhere(frame != 255):
        joint = model.observed[:, frame[row, col]] * belief[:, row, col]
        posterior[:, row, col] = joint / joint.sum()
    return posterior
