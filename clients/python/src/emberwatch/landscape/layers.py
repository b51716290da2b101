"""Layers, which are values with the positions of their cells, and helpers for all readers."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import invalid
from emberwatch.landscape.grid import Place

SINCE_1970: Final = "seconds since 1970-01-01"
"""The unit of dates. Readers convert dates to this unit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """One raster."""

    name: str
    values: NDArray[np.floating]
    """Shape (rows, columns), the first row in the north; NaN in cells without a value."""
    place: Place
    unit: str = ""
    """The unit of the values, as the file writes it, or `SINCE_1970`."""
    time: float | None = None
    time_unit: str = ""
    """The unit of `time`, like `unit`."""
    notes: tuple[str, ...] = ()  # what the reader assumed


def check_full(layer: Layer, expected: str, remedy: str) -> None:
    """Refuses a layer with a cell that has no value."""
    missing = np.isnan(layer.values)
    if missing.any():
        got = f"none in {missing.sum()} cells, the first {where(missing)}; {remedy}"
        raise invalid(layer.name, expected, got)


def where(cells: NDArray[np.bool_]) -> str:
    """Names the first of the cells, for errors."""
    row, column = np.argwhere(cells)[0].tolist()
    return f"in row {row}, column {column}"


def choose_variable(file: Path, names: Iterable[str], wanted: str | None) -> str:
    """Returns the name of the wanted variable in a file, or of its only variable."""
    names = sorted(names)
    known = ", ".join(names) or "none"
    if wanted is not None and wanted not in names:
        raise invalid("--variable", f"a variable of {file} ({known})", f"'{wanted}'")
    if wanted is None and len(names) != 1:
        raise invalid(file, "one variable", f"{len(names)} ({known}); choose with --variable")
    return wanted or names[0]


def choose_bands(file: Path, count: int, wanted: int | None) -> Sequence[int]:
    """Returns the numbers of the bands to read, counted from 1."""
    if wanted is None:
        return range(1, count + 1)
    if wanted > count:
        raise invalid("--band", f"1 to {count} for {file}", wanted)
    return [wanted]
