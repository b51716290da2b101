"""The parameters of a model file as arrays: a hidden Markov model on a grid.

Paper section II: states with the transition kernel ``w`` and bias ``b`` of eq. 2, and the
observation matrix ``O`` of eq. 1. The native module checks files, and this module reads the checked
ones. `emberwatch.belief` applies the parameters to a belief.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from os import PathLike
from typing import Any, Self, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

import emberwatch._native as _native
from emberwatch.common.arguments import as_array, as_count, as_integer, as_seed
from emberwatch.common.paths import BYTE_ORDER_MARK, utf8
from emberwatch.errors import invalid, repr_of
from emberwatch.model.airspace import Airspace

Color = tuple[int, int, int]
"""Red, green and blue, 0 to 255 each."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Description:
    """The states and observations of a model, or of recorded worlds, which have no model.

    S is the number of states, and O the number of observed values. Two descriptions are equal if
    all their fields except `toml` are equal.
    """

    name: str
    """Display name."""
    state_names: tuple[str, ...]
    """One name for each state."""
    state_colors: tuple[Color, ...]
    """One colour for each state."""
    observation_names: tuple[str, ...]
    """One name for each observed value."""
    observation_colors: tuple[Color, ...]
    """One colour for each observed value."""
    observation_matrix: NDArray[np.float64]
    """``O[state, observed value]``, shape (S, O). Each row is a distribution."""
    reward: NDArray[np.float64]
    """Reward of a cell in each state, shape (S,). A step pays this reward once for each distinct
    cell that the robot visited."""
    airspace: Airspace
    """Where robots may fly and what they see."""
    toml: str
    """Text of the file, for other programs."""

    @classmethod
    def from_toml(cls, text: str) -> Self:
        """Parses the text of a file that has been checked."""
        text = text.removeprefix(BYTE_ORDER_MARK)
        try:
            values = cls._read(text)
            for colors in ("state_colors", "observation_colors"):
                values[colors] = tuple(map(color_from_hex, values[colors]))
            return cls(**values, toml=text)
        except (TypeError, ValueError) as error:
            expected = "a file that `emberwatch-server --check` accepts"
            raise invalid(cls.__name__.lower(), expected, error) from None

    def with_radius(self, radius: int) -> Self:
        """Returns a copy whose sensor sees `radius` rows and columns beyond each cell of a path."""
        radius = as_count(radius, "radius", 0, _native.MAX_RADIUS)
        if radius == self.airspace.radius:
            return self
        return self.from_toml(_native.with_radius(self.toml, radius))

    @property
    def n_states(self) -> int:
        return len(self.state_names)

    @property
    def n_observations(self) -> int:
        return len(self.observation_names)

    @property
    def target_state(self) -> int:
        """The state with the largest reward (the first such state); in the wildfire model, fire."""
        return int(np.argmax(self.reward))

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash(self.name)

    def _values(self) -> list[object]:
        values = [getattr(self, field.name) for field in fields(self) if field.name != "toml"]
        return [_plain(value) for value in values]

    @staticmethod
    def _read(text: str) -> dict[str, Any]:
        """Returns the values of all fields except `toml`."""
        return _native.read_description(text)


@dataclass(frozen=True, slots=True)
class Transition:
    """A transition of a model file: a way in which a cell changes from one state to another."""

    from_: str
    """The cell's state at step k."""
    to: str
    """The cell's state at step k + 1."""
    base: float
    """Probability without neighbours."""
    near: Mapping[str, Sequence[Sequence[float]]]
    """For a neighbour's state, the probability by the neighbour's place; the centre is the cell."""
    times: Sequence[str]
    """Names of the maps that multiply the hazards -log(1 - p)."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Model(Description):
    """A hidden Markov model of the world; make one with `named` or `from_toml`.

    It has either a kernel and a bias, of size (KH, KW), both odd, or transitions.
    """

    kernel: NDArray[np.float64] | None
    """The weights ``w[next state, state of the neighbour, row, col]`` of eq. 2, shape
    (S, S, KH, KW). The centre is the cell itself; rows grow downward."""
    bias: NDArray[np.float64] | None
    """``b`` of eq. 2, which is added to each next state's weight, shape (S,)."""
    initial: NDArray[np.float64]
    """Distribution of a cell's state at the start of the burn-in, shape (S,)."""
    edge: int | None
    """State of all cells outside the grid (``edge`` in the file); None: these add no weight."""
    transitions: tuple[Transition, ...]
    """The transitions; those of each state are tried in order."""
    maps: Mapping[str, NDArray[np.float32]]
    """The factors that transitions name, shape (H, W) or (KH, KW, H, W). They are read-only."""

    @classmethod
    def named(cls, model: "Model | str | PathLike[str]") -> "Model":
        """Returns a model: a built-in one by its name, or by the path or the text of its file.

        A `Model` is returned as it is.

        Raises:
            InvalidArgumentError: If there is no such model, or the file has an error.
        """
        if isinstance(model, Model):
            return model
        return cls.from_toml(_native.model_text(utf8("model", model)))

    @classmethod
    def wildfire(cls) -> Self:
        """Returns the built-in model `wildfire`, from section II of the paper."""
        return cls.from_toml(_native.built_in("models")["wildfire"])

    def advance(
        self, states: NDArray[np.uint8], *, seed: int | ArrayLike, step: int
    ) -> NDArray[np.uint8]:
        """Draws the next states of worlds, as the simulator does (eq. 4).

        The result depends only on the model and the arguments. In an environment with this seed,
        the step from X_k to X_{k+1} has ``step=env.burn_in + k``. Call it from several threads to
        use several cores: it releases the interpreter lock.

        Args:
            states: The states of one world, (H, W), or of n worlds, (n, H, W); type uint8, values
                below S.
            seed: The seed of all worlds, or one seed for each world, (n,); 0 to 2**64 - 1. Worlds
                with the same seed use the same random numbers: if their states are equal, they stay
                equal. Give each world its own seed to draw independent futures.
            step: Number of steps since the beginning of the burn-in, 0 to 2**64 - 1; it selects the
                random numbers. Use another step for each further call with the same seed.

        Returns:
            The states one step later, as a new array of the same shape.

        Raises:
            InvalidArgumentError: If an argument has another shape, type or range, or the model does
                not fit the grid.
            NotEnoughMemoryError: If the grid does not fit in memory.
        """
        given = as_array(states, "states", "an array")
        if given.ndim not in (2, 3) or given.dtype != np.uint8:
            got = f"{given.dtype} of shape {given.shape}"
            raise invalid("states", "uint8 of shape (H, W) or (n, H, W)", got)
        worlds = given[np.newaxis] if given.ndim == 2 else given
        seeds = _seeds(seed, len(worlds))
        step = as_count(step, "step", 0, 2**64 - 1)
        dynamics = _dynamics(self.toml, worlds.shape[1], worlds.shape[2])
        return dynamics.advance(worlds, seeds, step).reshape(given.shape)

    @staticmethod
    def _read(text: str) -> dict[str, Any]:
        values = _native.read_model(text)
        values["transitions"] = tuple(Transition(*it) for it in values["transitions"])
        for factors in values["maps"].values():
            factors.flags.writeable = False
        return values


@functools.lru_cache(maxsize=8)
def _dynamics(toml: str, height: int, width: int) -> _native.Dynamics:
    return _native.Dynamics(toml, height, width)


def _seeds(seed: int | ArrayLike, n_worlds: int) -> NDArray[np.uint64]:
    """Returns a seed for each world."""
    if as_integer(seed) is not None:
        return np.full(n_worlds, as_seed(seed), np.uint64)
    expected = f"an integer within 0 to 2**64 - 1, or {n_worlds} of them"
    given = as_array(seed, "seed", expected)
    if given.shape != (n_worlds,) or given.dtype.kind not in "iu" or (given < 0).any():
        raise invalid("seed", expected, repr_of(seed))
    return given.astype(np.uint64)


def _plain(value: Any) -> Any:
    """Converts arrays, and the arrays of a mapping, to lists, which can be compared."""
    if isinstance(value, np.ndarray):
        return cast("NDArray[Any]", value).tolist()
    if isinstance(value, dict):
        return {key: _plain(it) for key, it in cast("dict[str, Any]", value).items()}
    return value


def color_from_hex(text: str) -> Color:
    """Parses a colour such as `#c8371b`."""
    red, green, blue = bytes.fromhex(text.removeprefix("#"))
    return red, green, blue
