"""What a learner sees: which parts, as which spaces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from emberwatch import wire
from emberwatch.errors import InvalidArgumentError
from emberwatch.settings import WorldSpec
from emberwatch.wire import StepAnswer

Part: TypeAlias = Literal["frame", "robot", "age"]

#: One part makes a plain observation, several make a flat dictionary.
Parts: TypeAlias = Part | Sequence[Part]

#: Age of a cell that was not seen for this many steps or more.
MAX_AGE: Final = 255


class Observations:
    """Turns answers into observations of some worlds, counted from 0."""

    def __init__(
        self,
        parts: str | Sequence[str],
        spec: WorldSpec,
        n_worlds: int = 1,
        extra: Mapping[str, spaces.Space[Any]] | None = None,
    ) -> None:
        """`extra` has the spaces of parts that `one` is given."""
        known: dict[str, spaces.Space[Any]] = {
            "frame": image_space(spec),
            "robot": spaces.MultiDiscrete([spec.height, spec.width]),
            "age": image_space(spec),
            **(extra or {}),
        }
        names = (parts,) if isinstance(parts, str) else tuple(parts)
        if not names or len(set(names)) < len(names) or not known.keys() >= set(names):
            raise InvalidArgumentError(
                f"observation: expected one or several of {', '.join(known)}, got {parts!r}"
            )
        self._names, self._is_plain = names, isinstance(parts, str)
        #: The space of one world's observation.
        self.space = (
            known[names[0]]
            if self._is_plain
            else spaces.Dict({name: known[name] for name in names})
        )
        self._ages: NDArray[np.uint8] | None = None
        if "age" in names:
            self._ages = np.full((n_worlds, spec.height, spec.width), MAX_AGE, np.uint8)

    def reset(self, indices: Sequence[int], frames: NDArray[np.uint8]) -> None:
        """Forgets the ages of worlds whose episode has begun, or been resumed with a frame.

        `frames` are those of all worlds, `(n_worlds, H, W)`.
        """
        if self._ages is not None:
            chosen = list(indices)
            is_seen = frames[chosen] != wire.UNOBSERVED
            self._ages[chosen] = np.where(is_seen, np.uint8(0), np.uint8(MAX_AGE))

    def update(self, answer: StepAnswer, first: int = 0) -> None:
        """Adds one step to the ages of the worlds of an answer."""
        if self._ages is not None:
            ages = self._ages[first : first + len(answer.frames)]
            ages += ages < MAX_AGE
            ages[answer.frames != wire.UNOBSERVED] = 0

    def one(
        self, frame: NDArray[np.uint8], row: int, col: int, index: int = 0, **extra: Any
    ) -> Any:
        """The observation of one world; `frame`, `(H, W)`, is taken as it is."""
        ages = None if self._ages is None else self._ages[index]
        return self._chosen(frame, np.array((row, col), np.int64), ages, extra)

    def all(self, frames: NDArray[np.uint8], robots: NDArray[np.int64]) -> Any:
        """The observations of all worlds, stacked; `frames` and `robots` are taken as they are."""
        return self._chosen(frames, robots, self._ages, {})

    def _chosen(
        self,
        frame: NDArray[np.uint8],
        robot: NDArray[np.int64],
        age: NDArray[np.uint8] | None,
        parts: dict[str, Any],
    ) -> Any:
        parts["frame"], parts["robot"] = frame[..., np.newaxis], robot
        if age is not None:
            parts["age"] = age[..., np.newaxis].copy()
        if self._is_plain:
            return parts[self._names[0]]
        return {name: parts[name] for name in self._names}


def image_space(spec: WorldSpec) -> spaces.Box:
    """One byte a cell."""
    return spaces.Box(0, 255, (spec.height, spec.width, 1), np.uint8)
