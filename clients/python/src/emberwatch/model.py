"""The hidden Markov model on a grid: what a model file says, as arrays.

Paper section II: states with the transition kernel ``w`` and bias ``b`` of eq. 2, and the
observation matrix ``O`` of eq. 1. The server hands its model file to its clients as text;
`Model.from_toml` reads it and refuses what the server would refuse. What the parameters do to a
belief is in `emberwatch.belief`.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from os import PathLike, fspath
from pathlib import Path
from typing import Any, NoReturn, Self, cast

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import SettingError

Color = tuple[int, int, int]
"""Red, green and blue, 0 to 255 each."""

MAX_VALUES = 64
"""Most states, and most observations, of a model."""

MAX_KERNEL_SIDE = 15
"""Largest side of a kernel, cells."""

MAX_FILE_BYTES = 16 << 20
"""Longest model file that is read, bytes."""

_LEAST_SHARE = 1e-30  # of the largest weight, that a cell's weights may sum to: the server's
_SMALLEST, _LARGEST = 1e-100, 1e100  # size of numbers that are not zero: the server's
_SUM_TOLERANCE = 1e-6  # of a distribution in a model file: the server's
_RESERVED = ("exploit", "exploit_only", "explore")  # words that name the agent's policies


class ModelError(ValueError):
    """A model file that no world can run, with the entry, what it must be and what it is."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Model:
    """A checked model; make one with `named`, `read` or `from_toml`.

    S is the number of states, O that of observations, (KH, KW) the kernel's size, both odd. Two
    models are equal if all they say is, whatever their files look like.
    """

    name: str
    """Name shown to people."""
    state_names: tuple[str, ...]
    """By state; letters, digits, ``-`` and ``_``."""
    state_colors: tuple[Color, ...]
    """By state, for pictures."""
    observation_names: tuple[str, ...]
    """By observed value."""
    observation_colors: tuple[Color, ...]
    """By observed value, for pictures."""
    kernel: NDArray[np.float64]
    """Weights ``w[to, from, row, col]`` of eq. 2, shape (S, S, KH, KW), all >= 0; the centre is the
    cell itself, rows grow downward."""
    bias: NDArray[np.float64]
    """Bias ``b[to]`` of eq. 2, shape (S,), all >= 0."""
    observation_matrix: NDArray[np.float64]
    """``P(y | x)`` of eq. 1, shape (S, O); each row sums to one."""
    initial: NDArray[np.float64]
    """Distribution of each cell at the start of the burn-in, shape (S,); sums to one."""
    reward: NDArray[np.float64]
    """Reward for each distinct visited cell by its state, shape (S,)."""
    toml: str
    """Text of the model file, for other programs."""

    @classmethod
    def from_toml(cls, text: str) -> Self:
        """Reads and checks the text of a model file.

        Raises:
            ModelError: Names the entry, what it must be and what it is.
        """
        try:
            file = tomllib.loads(text)
        except (ValueError, RecursionError) as error:  # tomllib recurses into nested arrays
            raise ModelError(f"model file: expected TOML, got {_short(str(error))}") from error
        return cls(**_fields(file), toml=text)

    @classmethod
    def read(cls, path: str | PathLike[str]) -> Self:
        """Reads and checks a model file.

        Raises:
            ModelError: Names the file and the entry, what it must be and what it is.
            OSError: The file cannot be read.
        """
        with Path(path).open("rb") as file:  # which may be a pipe, but not endless
            text = file.read(MAX_FILE_BYTES + 1)
        if len(text) > MAX_FILE_BYTES:
            raise ModelError(f"{path}: expected at most {MAX_FILE_BYTES} bytes, got more")
        try:
            return cls.from_toml(text.decode())
        except (ModelError, UnicodeDecodeError) as error:
            raise ModelError(f"{path}: {error}") from error

    @classmethod
    def named(cls, name: str | PathLike[str]) -> Self:
        """The built-in model of a name, or that of a file: what ``--model`` takes.

        Raises:
            SettingError: It is neither a name nor a file that can be read.
            ModelError: Names the file and the entry, what it must be and what it is.
        """
        name, built_in = fspath(name), built_in_models()
        if name in built_in:
            return cls.from_toml(built_in[name].read_text("utf-8"))
        try:
            return cls.read(name)
        except OSError as error:
            raise SettingError(
                f"model: expected {', '.join(built_in)} or the path of a model file, "
                f"got {name!r}: {error.strerror}"
            ) from None

    @classmethod
    def wildfire(cls) -> Self:
        """The built-in wildfire of the paper's section II, as ``config/models/wildfire.toml``."""
        return cls.named("wildfire")

    @property
    def n_states(self) -> int:
        """Number of states S."""
        return len(self.state_names)

    @property
    def n_observations(self) -> int:
        """Number of observations O."""
        return len(self.observation_names)

    @property
    def target_state(self) -> int:
        """The state that pays most, the first of them: fire in the wildfire model."""
        return int(np.argmax(self.reward))

    def check_on(self, *, height: int, width: int) -> None:
        """Checks that eq. 3 never divides by zero on a grid, nor by next to nothing.

        Args:
            height: Grid height, cells, at least 1.
            width: Grid width, cells, at least 1.

        Raises:
            ModelError: Names the first cell whose weights can vanish.
        """
        least = self.kernel.sum(axis=0).min(axis=0)
        largest = max(self.kernel.max(), self.bias.max(), np.finfo(np.float64).tiny)
        rows, on_rows = _distinct(height, least.shape[0])
        cols, on_cols = _distinct(width, least.shape[1])
        shares = (on_rows @ (least / largest) @ on_cols.T) + (self.bias / largest).sum()
        faint = np.argwhere(shares < _LEAST_SHARE)
        if faint.size:
            row, col = faint[0]
            raise ModelError(
                f"model {self.name!r} on a {height} x {width} grid: transition weights of cell "
                f"({rows[row]}, {cols[col]}): expected a sum of at least {_LEAST_SHARE:g} of the "
                f"largest weight whatever its neighbourhood, got {shares[row, col]:g}; give the "
                "centre of the kernel a positive weight from every state, or give a state a bias"
            )

    def __eq__(self, other: object) -> bool:
        """Whether the other model says the same."""
        if not isinstance(other, Model):
            return NotImplemented
        return self._key() == other._key()

    def __hash__(self) -> int:
        """Equal for equal models."""
        return hash(self._key())

    def _key(self) -> tuple[object, ...]:
        arrays = (self.kernel, self.bias, self.observation_matrix, self.initial, self.reward)
        names = (self.name, self.state_names, self.state_colors)
        observations = (self.observation_names, self.observation_colors)
        return (*names, *observations, *((array.shape, array.tobytes()) for array in arrays))


def built_in_models() -> dict[str, Traversable]:
    """The files of the models that have names, by name: those that the programs know."""
    folder = resources.files("emberwatch") / "models"
    files = {file.name.removesuffix(".toml"): file for file in folder.iterdir()}
    return dict(sorted(files.items()))


def _distinct(side: int, kernel: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Places along a side that can differ, and which taps of each lie on the grid.

    Places further than a kernel from both ends are all alike: one of them is enough.
    """
    at = np.arange(side)
    at = at[(at <= kernel) | (at + kernel >= side)]
    tap = at[:, None] + np.arange(kernel)[None, :] - kernel // 2
    return at, ((tap >= 0) & (tap < side)).astype(np.float64)


def _fields(file: dict[str, object]) -> dict[str, Any]:
    """Checks every entry, in the server's order; returns the fields of `Model` but the text."""
    keys = ("name", "kernel_size", "states", "observations", "kernel")
    _Checker("model file").keys(file, "top level", keys)
    check = _Checker(f"model {_Checker('model file').text(file['name'], 'name')!r}")
    keys = ("name", "color", "initial", "observed_as")
    states = check.tables(file["states"], "states", keys, ("reward", "bias"))
    observations = check.tables(file["observations"], "observations", ("name", "color"))
    state_names, state_colors = check.names(states, "state", least=2)
    for name in state_names:
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name) or name in _RESERVED:
            expected = f"letters, digits, '-' and '_', and none of {', '.join(_RESERVED)}"
            check.wrong("state name", expected, repr(name))
    observation_names, observation_colors = check.names(observations, "observation", least=1)
    kernel = check.kernel(file["kernel"], check.kernel_size(file["kernel_size"]), state_names)
    bias = check.per_state(states, "bias", least=0.0)
    reward = check.per_state(states, "reward", least=-math.inf)
    initial = check.distribution(check.per_state(states, "initial", least=0.0), "initial")
    matrix = check.observation_matrix(states, len(observations))
    return {
        "name": file["name"],
        "state_names": state_names,
        "state_colors": state_colors,
        "observation_names": observation_names,
        "observation_colors": observation_colors,
        "kernel": kernel,
        "bias": bias,
        "observation_matrix": matrix,
        "initial": initial,
        "reward": reward,
    }


@dataclass(frozen=True, slots=True)
class _Checker:
    """The checks of a model file; each returns what it checked, with its type."""

    subject: str
    """What every error begins with."""

    def wrong(self, what: str, expected: str, got: object) -> NoReturn:
        raise ModelError(f"{self.subject}: {what}: expected {expected}, got {_short(str(got))}")

    def keys(
        self,
        value: object,
        what: str,
        required: Sequence[str],
        optional: Sequence[str] = (),
    ) -> dict[str, object]:
        if not isinstance(value, dict):
            self.wrong(what, "a table", _kind(value))
        table = cast("dict[str, object]", value)
        for key in required:
            if key not in table:
                self.wrong(what, f"the key {key!r}", "none")
        for key in table:
            if key not in (*required, *optional):
                known = ", ".join((*required, *optional))
                self.wrong(what, f"only the keys {known}", repr(key))
        return table

    def tables(
        self, value: object, what: str, required: Sequence[str], optional: Sequence[str] = ()
    ) -> list[dict[str, object]]:
        entries = enumerate(self.items(value, what, "tables"))
        return [self.keys(entry, f"{what}[{i}]", required, optional) for i, entry in entries]

    def items(self, value: object, what: str, of: str) -> list[object]:
        if not isinstance(value, list):
            self.wrong(what, f"a list of {of}", _kind(value))
        return cast("list[object]", value)

    def text(self, value: object, what: str) -> str:
        if not isinstance(value, str):
            self.wrong(what, "a text", _kind(value))
        return value

    def number(self, value: object, what: str) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.wrong(what, "a number", _kind(value))
        if isinstance(value, int) and not -(2**63) <= value < 2**63:  # what TOML allows
            self.wrong(what, "a number of 64 bits", f"{value.bit_length()} bits")
        return float(value)

    def numbers(self, value: object, what: str) -> list[float]:
        return [self.number(entry, what) for entry in self.items(value, what, "numbers")]

    def names(
        self, entries: list[dict[str, object]], what: str, *, least: int
    ) -> tuple[tuple[str, ...], tuple[Color, ...]]:
        """Names, none of them twice, and colours of states or observations."""
        if not least <= len(entries) <= MAX_VALUES:
            self.wrong(f"{what}s", f"{least} to {MAX_VALUES}", len(entries))
        names: list[str] = []
        colors: list[Color] = []
        for entry in entries:
            name = self.text(entry["name"], f"{what} name")
            if name in names:
                self.wrong(f"{what} name", "each name once", f"{name!r} twice")
            color = self.text(entry["color"], f"{what} {name!r}: color")
            if not re.fullmatch("#[0-9A-Fa-f]{6}", color):
                self.wrong(f"{what} {name!r}: color", "#rrggbb", color)
            names.append(name)
            colors.append((int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)))
        return tuple(names), tuple(colors)

    def per_state(
        self, states: list[dict[str, object]], key: str, *, least: float
    ) -> NDArray[np.float64]:
        values: list[float] = []
        for state in states:
            what = f"state {state['name']!r}: {key}"
            value = self.number(state.get(key, 0.0), what)
            if not math.isfinite(value) or value < least:
                expected = "a finite number >= 0" if least == 0.0 else "a finite number"
                self.wrong(what, expected, value)
            self.size(value, what, is_zero=value == 0.0)
            values.append(value)
        return np.array(values)

    def size(self, value: float, what: str, *, is_zero: bool) -> None:
        if not is_zero and not _SMALLEST <= abs(value) <= _LARGEST:
            self.wrong(what, f"0, or a size of {_SMALLEST:g} to {_LARGEST:g}", value)

    def distribution(self, values: NDArray[np.float64], what: str) -> NDArray[np.float64]:
        """Probabilities whose sum is nearly one, divided by it."""
        if not np.isfinite(values).all() or (values < 0.0).any():
            self.wrong(what, "probabilities >= 0", values.tolist())
        total = values.sum()
        if abs(total - 1.0) > _SUM_TOLERANCE:
            self.wrong(what, "a sum of 1", f"{total:.10g}")
        return values / total

    def observation_matrix(
        self, states: list[dict[str, object]], n_observations: int
    ) -> NDArray[np.float64]:
        rows: list[NDArray[np.float64]] = []
        for state in states:
            what = f"state {state['name']!r}: observed_as"
            row = np.array(self.numbers(state["observed_as"], what))
            if row.size != n_observations:
                expected = f"{n_observations} probabilities, one per observation"
                self.wrong(what, expected, row.size)
            rows.append(self.distribution(row, what))
        return np.stack(rows)

    def kernel_size(self, value: object) -> tuple[int, int]:
        match value:
            case [int(height), int(width)] if all(map(_is_kernel_side, (height, width))):
                return height, width
            case _:
                pass
        self.wrong("kernel_size", f"two odd numbers up to {MAX_KERNEL_SIDE}", value)

    def kernel(
        self, value: object, size: tuple[int, int], names: tuple[str, ...]
    ) -> NDArray[np.float64]:
        """Weights (S, S, KH, KW) from the blocks that are not zero."""
        kernel = np.zeros((len(names), len(names), *size))
        filled: set[tuple[int, int]] = set()
        for entry in self.tables(value, "kernel", ("from", "to", "weights"), ("scale",)):
            what = f"kernel from {entry['from']!r} to {entry['to']!r}"
            for key in ("to", "from"):
                if entry[key] not in names:
                    self.wrong(what, f"states out of {', '.join(names)}", repr(entry[key]))
            block = names.index(cast(str, entry["to"])), names.index(cast(str, entry["from"]))
            if block in filled:
                self.wrong(what, "one entry for each pair of states", "two")
            filled.add(block)
            kernel[block] = self.weights(entry, what, size)
        return kernel

    def weights(
        self, entry: dict[str, object], what: str, size: tuple[int, int]
    ) -> list[list[float]]:
        scale = self.number(entry.get("scale", 1.0), f"{what}: scale")
        rows = [self.numbers(row, what) for row in self.items(entry["weights"], what, "rows")]
        if [len(row) for row in rows] != [size[1]] * size[0]:
            expected = f"{size[0]} rows of {size[1]} weights"
            self.wrong(what, expected, f"rows of {[len(row) for row in rows]}")
        for value in (value for row in rows for value in row):
            weight = value * scale
            if not math.isfinite(weight) or weight < 0.0:
                self.wrong(what, "finite weights >= 0", weight)
            self.size(weight, what, is_zero=value == 0.0 or scale == 0.0)
        return [[value * scale for value in row] for row in rows]


def _is_kernel_side(side: int) -> bool:
    return not isinstance(side, bool) and side % 2 == 1 and 0 < side <= MAX_KERNEL_SIDE


def _kind(value: object) -> str:
    for kind, name in ((dict, "a table"), (list, "a list"), (str, "a text"), (bool, "a boolean")):
        if isinstance(value, kind):
            return name
    return type(value).__name__


def _short(text: str) -> str:
    return text if len(text) <= 200 else text[:200] + " ..."
