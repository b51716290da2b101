"""What can be known about a world before its first frame: a filter's first belief."""

import functools
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

import emberwatch._native as _native
from emberwatch.belief import initial_prior, uniform_prior
from emberwatch.common.arguments import as_array, as_count
from emberwatch.errors import invalid
from emberwatch.model import Model

PriorKind = Literal["simulated", "initial", "uniform"]
"""A prior by name, see `wrappers.BeliefObservation`."""


@functools.lru_cache(maxsize=8)
def simulated_prior(model: Model, *, height: int, width: int, burn_in: int) -> NDArray[np.floating]:
    """How often each cell of 64 simulated worlds is in each state after the burn-in.

    Their seeds do not depend on any environment's. Shape (S, H, W); the same array again for the
    same arguments, so it cannot be written to. The agents' beliefs begin with it, too, and it is
    kept for later processes where they keep theirs, in ``~/.cache/emberwatch``.
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
    """A prior by name, or as given; None: ``"simulated"`` after a burn-in, else ``"initial"``."""
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
        raise invalid("prior", expected, repr(prior))
    return simple[prior](model, height=height, width=width)
