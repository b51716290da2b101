"""What can be known about a world before its first frame: a filter's first belief."""

import functools
import tempfile
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emberwatch import programs
from emberwatch.arguments import as_array
from emberwatch.belief import initial_prior, uniform_prior
from emberwatch.errors import EmberwatchError, invalid
from emberwatch.model import Model
from emberwatch.resources import SHARED_MEMORY

PriorKind = Literal["simulated", "initial", "uniform"]
"""A prior by name, see `wrappers.BeliefObservation`."""

#: 64 worlds of 512 x 512 cells take minutes.
_SIMULATION_TIMEOUT: Final = 1800.0


@functools.lru_cache(maxsize=8)
def simulated_prior(model: Model, *, height: int, width: int, burn_in: int) -> NDArray[np.floating]:
    """How often each cell of 64 simulated worlds is in each state after the burn-in.

    Runs ``emberwatch-agent prior``, whose worlds do not depend on any environment's seed. Shape
    (S, H, W); the same array again for the same arguments, so it cannot be written to.
    """
    name = "emberwatch-agent"
    with _folder() as directory:
        file, out = Path(directory, "model.toml"), Path(directory, "prior.npy")
        try:
            file.write_text(model.toml, "utf-8")
        except OSError as error:
            raise EmberwatchError(f"write {file}: {error.strerror}", "program") from None
        flags = {"model": file, "height": height, "width": width, "burn-in": burn_in, "out": out}
        arguments = ["prior", *(f"--{flag}={value}" for flag, value in flags.items())]
        programs.run(name, arguments, _SIMULATION_TIMEOUT)
        try:
            with out.open("rb") as stream:
                prior: NDArray[np.floating] = np.lib.format.read_array(stream)
        except (OSError, ValueError) as error:
            problem = f"{name} prior: expected an .npy file: {error}"
            raise EmberwatchError(problem, "program") from error
    expected = (model.n_states, height, width)
    if prior.shape != expected:
        problem = f"{name} prior: expected shape {expected}, got {prior.shape}"
        raise EmberwatchError(problem, "program")
    prior.flags.writeable = False
    return prior


def _folder() -> tempfile.TemporaryDirectory[str]:
    """A temporary folder; in shared memory, which must be writable anyhow, if there is no other."""
    prefix = "emberwatch-prior-"
    try:
        return tempfile.TemporaryDirectory(prefix=prefix)
    except OSError:
        try:
            return tempfile.TemporaryDirectory(prefix=prefix, dir=SHARED_MEMORY)
        except OSError as error:
            raise EmberwatchError(f"make a temporary folder: {error.strerror}", "program") from None


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
