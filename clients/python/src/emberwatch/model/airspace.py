"""Where robots may fly, and what they see from there."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emberwatch._native import MAX_RADIUS
from emberwatch.common.arguments import as_count
from emberwatch.errors import invalid, repr_of


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Airspace:
    """Where robots may fly, and what their sensor sees.

    By default robots may fly everywhere, and they see the cells of their path.
    """

    radius: int = 0
    """Number of rows and columns that robots see beyond each cell of their path."""
    no_fly: NDArray[np.bool_] | None = None
    """True in the no-fly cells, shape (H, W). A robot that moves into one stays where it is."""

    def __post_init__(self) -> None:
        as_count(self.radius, "radius", 0, MAX_RADIUS)
        given: Any = self.no_fly
        if given is not None:
            if getattr(given, "dtype", None) != np.bool_ or given.ndim != 2:
                raise invalid("no_fly", "an array of shape (H, W) and type bool", repr_of(given))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Airspace) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash(self.radius)

    def _values(self) -> tuple[object, ...]:
        no_fly = None if self.no_fly is None else self.no_fly.tolist()
        return self.radius, no_fly
