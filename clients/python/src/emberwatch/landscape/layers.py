"""A layer: numbers with the place of their cells; and what the readers of all formats share."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import invalid
from emberwatch.landscape.grid import Place
from emberwatch.landscape.schedule import Clock, Time

MOST_CELLS: Final = 1 << 27  # of a layer: 1 GiB as numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """What to take of each file."""

    variable: str | None = None
    band: int | None = None
    nodata: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """One raster."""

    name: str
    """File and band, for errors."""
    values: NDArray[np.float64]
    """Shape (rows, columns), the first row in the north; NaN where the file has no value."""
    place: Place
    clock: Clock = Clock()
    """What a number counts, if it is a time."""
    flags: tuple[tuple[float, str], ...] = ()
    """What single numbers mean, as far as the file says."""
    time: Time | None = None
    """When the layer is, if the file says."""


def choose_variable(file: Path, names: Sequence[str], wanted: str | None) -> str:
    """The wanted one of a file's variables, or the only one."""
    if wanted is not None and wanted in names:
        return wanted
    known = ", ".join(sorted(names)) or "none"
    if wanted is not None:
        raise invalid("--variable", f"one of {file} ({known})", f"'{wanted}'")
    if len(names) != 1:
        raise invalid(file, "one variable", f"{len(names)} ({known}); choose with --variable")
    return names[0]


def choose_bands(file: Path, count: int, choice: Choice) -> Sequence[int]:
    """The bands to read, counted from 1."""
    if choice.band is None:
        return range(1, count + 1)
    if not 1 <= choice.band <= count:
        raise invalid("--band", f"1 to {count} for {file}", choice.band)
    return [choice.band]


def is_missing(stored: NDArray[Any], nodata: Sequence[float]) -> NDArray[np.bool_]:
    """Where a file has one of these numbers, each rounded as the file has rounded its own."""
    missing = np.zeros(stored.shape, np.bool_)
    for number in nodata:
        with np.errstate(over="ignore"):
            missing |= stored == (stored.dtype.type(number) if stored.dtype.kind == "f" else number)
    return missing


def check_cells(file: Path, height: int, width: int) -> None:
    """Refuses layers that are too large, before they are read."""
    if height * width > MOST_CELLS:
        raise invalid(file, f"at most {MOST_CELLS} cells", f"{height} x {width}")
