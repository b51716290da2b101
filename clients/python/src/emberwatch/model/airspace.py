"""Where robots may fly, and what they see from there."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emberwatch._native import MAX_RADIUS
from emberwatch.common.arguments import as_count, told
from emberwatch.errors import invalid


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Airspace:
    """Where robots may fly, and what their sensor sees from there.

    By default they fly everywhere, and see the cells of their path.
    """

    radius: int = 0
    """Rows and columns that they see beyond each cell of their path."""
    n_rings: int = 1
    """Observation matrices: of the path, then of each ring around it; the last holds beyond. What
    is observed by matrix m has the value ``m * O / n_rings`` plus that which it has on the path."""
    pays: str = "visited"
    """Which distinct cells pay: `"visited"`, or `"seen"`."""
    no_fly: NDArray[np.bool_] | None = None
    """Where no robot may be, shape (H, W); a move into such a cell leaves it in place."""

    def __post_init__(self) -> None:
        as_count(self.radius, "radius", 0, MAX_RADIUS)
        as_count(self.n_rings, "n_rings", 1, self.radius + 1)
        if self.pays not in ("visited", "seen"):
            raise invalid("pays", "'visited' or 'seen'", told(self.pays))
        given: Any = self.no_fly
        if given is not None:
            if getattr(given, "dtype", None) != np.bool_ or given.ndim != 2:
                raise invalid("no_fly", "an array of shape (H, W) and type bool", told(given))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Airspace) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash((self.radius, self.n_rings, self.pays))

    def _values(self) -> tuple[object, ...]:
        no_fly = None if self.no_fly is None else self.no_fly.tolist()
        return self.radius, self.n_rings, self.pays, no_fly


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Zones:
    """Zones of land, which differ in how states change."""

    names: tuple[str, ...]
    #: `#rrggbb`.
    colors: tuple[str, ...]
    #: The zone of each cell, by its place in `names`, shape (H, W).
    map: NDArray[np.uint8]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Zones) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash(self.names)

    def _values(self) -> tuple[object, ...]:
        return self.names, self.colors, self.map.tolist()
