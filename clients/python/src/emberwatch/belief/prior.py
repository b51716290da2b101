"""Priors: a filter's belief about a world before its first frame."""

import functools
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

import emberwatch._native as _native
from emberwatch.common.arguments import as_array, as_count
from emberwatch.errors import invalid, repr_of
from emberwatch.model import Model

PriorKind = Literal["simulated", "initial", "uniform"]
"""The name of a prior, see `wrappers.BeliefObservation`."""


def initial_prior(model: Model, *, height: int, width: int) -> NDArray[np.float64]:
    """Returns the model's initial distribution, before the burn-in, in each cell; (S, H, W)."""
    return np.tile(model.initial[:, None, None], (1, height, width))


def uniform_prior(model: Model, *, height: int, width: int) -> NDArray[np.float64]:
    """Returns equal probabilities of all states, (S, H, W), as in the paper's demonstration."""
    return np.full((model.n_states, height, width), 1.0 / model.n_states)


@functools.lru_cache(maxsize=8)
def simulated_prior(model: Model, *, height: int, width: int, burn_in: int) -> NDArray[np.floating]:
    """Returns how often each cell is in each state after the burn-in of 64 simulated worlds.

    The result has shape (S, H, W), and is read-only because calls with the same arguments share it.
    The seeds of these worlds are fixed, and no environment uses them. The agent starts from the
    same prior. The first call simulates for some seconds; later processes read the prior from
    ``~/.cache/emberwatch``.
    """
    height = as_count(height, "height", 1, _native.MAX_SIDE)
    width = as_count(width, "width", 1, _native.MAX_SIDE)
    burn_in = as_count(burn_in, "burn_in", 0, 2**64 - 1)
    prior = _native.simulated_prior(model.toml, height, width, burn_in)
    prior.flags.writeable = False
    return prior


def prior_of(
    prior: PriorKind | ArrayLike | None,
    model: Model,
    *,
    height: int,
    width: int,
    burn_in: int,
) -> NDArray[np.floating]:
    """Returns a prior by name, or the given array after a check of its shape.

    If `prior` is None, it is ``"simulated"`` for worlds with a burn-in, otherwise ``"initial"``.
    """
    if prior is None:
        prior = "simulated" if burn_in > 0 else "initial"
    if not isinstance(prior, str):
        expected = (model.n_states, height, width)
        given = as_array(prior, "prior", f"an array of shape {expected}")
        if given.shape != expected:
            raise invalid("prior", f"shape {expected}", given.shape)
        return given
    if prior == "simulated":
        return simulated_prior(model, height=height, width=width, burn_in=burn_in)
    simple = {"initial": initial_prior, "uniform": uniform_prior}
    if prior not in simple:
        expected = "'simulated', 'initial', 'uniform' or an array"
        raise invalid("prior", expected, repr_of(prior))
    return simple[prior](model, height=height, width=width)
