"""The hidden Markov model on a grid: what a model file says, as arrays.

Paper section II: states with the transition kernel ``w`` and bias ``b`` of eq. 2, and the
observation matrix ``O`` of eq. 1. Whether a file makes sense is for the server to say; this module
reads what the server has accepted. `emberwatch.belief` applies the parameters to a belief.
"""

from dataclasses import dataclass, fields
from importlib import resources
from importlib.resources.abc import Traversable
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from emberwatch import _native
from emberwatch.arguments import check_settings
from emberwatch.errors import invalid
from emberwatch.paths import utf8

Color = tuple[int, int, int]
"""Red, green and blue, 0 to 255 each."""

MAX_VALUES = 64
"""Most states, and most observations, of a model."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Description:
    """What is known of states and observations: of recorded worlds, that is all.

    S is the number of states, O that of observations. Two descriptions are equal if all they say
    is, whatever their files look like.
    """

    name: str
    """Name shown to people."""
    state_names: tuple[str, ...]
    """By state."""
    state_colors: tuple[Color, ...]
    """By state."""
    observation_names: tuple[str, ...]
    """By observed value."""
    observation_colors: tuple[Color, ...]
    """By observed value."""
    observation_matrix: NDArray[np.float64]
    """``O[state, observed value]``, each row a distribution, shape (S, O)."""
    reward: NDArray[np.float64]
    """What a step pays for each distinct visited cell by its state, shape (S,)."""
    toml: str
    """Text of the file, for other programs."""

    @classmethod
    def from_toml(cls, text: str) -> Self:
        """Reads the text of a file that a server has accepted."""
        try:
            return cls(**cls._read(text), toml=text)
        except (TypeError, ValueError) as error:
            expected = "a file that `emberwatch-server --check` accepts"
            raise invalid(cls.__name__.lower(), expected, error) from None

    @property
    def n_states(self) -> int:
        return len(self.state_names)

    @property
    def n_observations(self) -> int:
        return len(self.observation_names)

    @property
    def target_state(self) -> int:
        """The state that pays most, the first of them: fire in the wildfire model."""
        return int(np.argmax(self.reward))

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash(self.name)

    def _values(self) -> list[object]:
        values = [getattr(self, field.name) for field in fields(self) if field.name != "toml"]
        return [value.tolist() if isinstance(value, np.ndarray) else value for value in values]

    @staticmethod
    def _read(text: str) -> dict[str, Any]:
        """All fields but the text."""
        return _native.read_description(text)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Model(Description):
    """A model; make one with `named` or `from_toml`.

    (KH, KW) is the kernel's size, both odd.
    """

    kernels: NDArray[np.float64]
    """``w[next state, state of the neighbour, row, col]``; the centre is the cell itself, rows grow
    downward. One for all cells, shape (1, S, S, KH, KW), or one for each state that a cell itself
    is in, shape (S, S, S, KH, KW)."""
    bias: NDArray[np.float64]
    """``b``, added to each next state's weight, shape (S,)."""
    initial: NDArray[np.float64]
    """Distribution of a cell at the start of the burn-in, shape (S,)."""

    @classmethod
    def named(cls, name: str | PathLike[str]) -> Self:
        """The built-in model of a name, or that of a file, which the server checks first."""
        utf8("model", name)
        check_settings([f"--model={fspath(name)}"])
        return cls.checked(name)

    @classmethod
    def checked(cls, name: str | PathLike[str]) -> Self:
        """The same of a name or file that the server has accepted already."""
        source = built_in("models").get(fspath(name), Path(name))
        return cls.from_toml(source.read_text("utf-8"))

    @classmethod
    def wildfire(cls) -> Self:
        """The built-in wildfire of the paper's section II, as ``config/models/wildfire.toml``."""
        return cls.checked("wildfire")

    @property
    def kernel(self) -> NDArray[np.float64]:
        """The first of the kernels: that of all cells, unless `sees_own_state`."""
        return self.kernels[0]

    @property
    def sees_own_state(self) -> bool:
        """Whether a cell's weights depend on the state that it is in itself."""
        return len(self.kernels) > 1

    @staticmethod
    def _read(text: str) -> dict[str, Any]:
        return _native.read_model(text)


def built_in(kind: str) -> dict[str, Traversable]:
    """The files of `models`, `tasks` or `landscapes` that the programs know by name, by name."""
    folder = resources.files("emberwatch") / kind
    files = {file.name.removesuffix(".toml"): file for file in folder.iterdir()}
    return dict(sorted(files.items()))


def color_from_hex(text: str) -> Color:
    """A colour such as `#c8371b`."""
    red, green, blue = bytes.fromhex(text.removeprefix("#"))
    return red, green, blue
