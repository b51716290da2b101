"""What a learner sees: which parts, as which spaces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from emberwatch import wire
from emberwatch.errors import SettingError
from emberwatch.settings import Shape
from emberwatch.wire import StepAnswer

#: The parts that there are.
Part: TypeAlias = Literal["frame", "robot", "age"]

#: One part makes a plain observation, several make a flat dictionary.
Parts: TypeAlias = Part | Sequence[Part]

#: Age of a cell that was not seen for so many steps, or never.
MAX_AGE: Final = 255


class Observations:
    """Turns answers into observations of some worlds, counted from 0.

    Attributes:
        spaces: The space of each part.
        space: The space of one world's observation.
        has_age: Whether the age of what was seen is a part.
    """

    def __init__(self, parts: Parts, shape: Shape, n_worlds: int = 1) -> None:
        """Chooses the parts.

        Raises:
            SettingError: If a part is unknown, or named twice, or there is none.
        """
        self._names, self._is_plain = check_parts(parts, ("frame", "robot", "age"))
        image = spaces.Box(0, 255, (shape.height, shape.width, 1), np.uint8)
        robot = spaces.MultiDiscrete([shape.height, shape.width])
        self.spaces: dict[str, spaces.Space[Any]] = {"frame": image, "robot": robot, "age": image}
        self.space = assemble(self._names, self.spaces, self._is_plain)
        self.has_age: Final = "age" in self._names
        self._ages = np.full((n_worlds, shape.height, shape.width), MAX_AGE, np.uint8)

    def began(self, indices: Sequence[int], frames: NDArray[np.uint8]) -> None:
        """Forgets the ages of worlds whose episode has begun, or been resumed with a frame.

        Args:
            indices: The worlds.
            frames: The frames of all worlds, `(n_worlds, H, W)`.
        """
        if self.has_age:
            chosen = list(indices)
            is_seen = frames[chosen] != wire.UNOBSERVED
            self._ages[chosen] = np.where(is_seen, np.uint8(0), np.uint8(MAX_AGE))

    def note(self, answer: StepAnswer, first: int) -> None:
        """Keeps ages up to date: one more step in the worlds of an answer."""
        if self.has_age:
            ages = self._ages[first : first + len(answer.frames)]
            ages += ages < MAX_AGE
            ages[answer.frames != wire.UNOBSERVED] = 0

    def one(self, frame: NDArray[np.uint8], row: int, col: int, index: int = 0) -> Any:
        """The observation of one world; `frame`, `(H, W)`, is taken as it is."""
        parts: dict[str, NDArray[Any]] = {}
        for name in self._names:
            if name == "frame":
                parts[name] = frame[:, :, np.newaxis]
            elif name == "robot":
                parts[name] = np.array((row, col), np.int64)
            else:
                parts[name] = self._ages[index, :, :, np.newaxis].copy()
        return parts[self._names[0]] if self._is_plain else parts

    def all(self, frames: NDArray[np.uint8], robots: NDArray[np.int64]) -> Any:
        """The observations of all worlds, stacked; `frames` and `robots` are taken as they are."""
        parts: dict[str, NDArray[Any]] = {}
        for name in self._names:
            if name == "frame":
                parts[name] = frames[..., np.newaxis]
            elif name == "robot":
                parts[name] = robots
            else:
                parts[name] = self._ages[..., np.newaxis].copy()
        return parts[self._names[0]] if self._is_plain else parts


def assemble(
    names: Sequence[str], known: Mapping[str, spaces.Space[Any]], is_plain: bool
) -> spaces.Space[Any]:
    """The space of an observation of these parts."""
    return known[names[0]] if is_plain else spaces.Dict({name: known[name] for name in names})


def check_parts(parts: str | Sequence[str], known: Sequence[str]) -> tuple[tuple[str, ...], bool]:
    """The names asked for, and whether a plain observation was.

    Raises:
        SettingError: If a name is unknown, or named twice, or there is none.
    """
    names = (parts,) if isinstance(parts, str) else tuple(parts)
    if not names or len(set(names)) < len(names) or any(name not in known for name in names):
        raise SettingError(
            f"observation: expected one or several of {', '.join(known)}, got {parts!r}"
        )
    return names, isinstance(parts, str)
