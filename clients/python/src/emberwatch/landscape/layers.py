"""Layers, which are values with the positions of their cells, and helpers for all readers."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import invalid
from emberwatch.landscape.grid import Place
from emberwatch.landscape.schedule import Clock, Time

MOST_CELLS: Final = 1 << 27  # maximum number of cells of a layer: 1 GiB of doubles


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """The variable, band and missing values to read from each file, from the flags."""

    variable: str | None = None
    band: int | None = None
    nodata: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """One raster."""

    name: str
    """File and band, for errors."""
    values: NDArray[np.float64]
    """Shape (rows, columns), the first row in the north; NaN in cells without a value."""
    place: Place
    clock: Clock = Clock()
    """The unit of the values, if they are times."""
    flags: tuple[tuple[float, str], ...] = ()
    """The meanings of single numbers, if the file states them."""
    time: Time | None = None
    """The time of the layer, if the file states it."""


def choose_variable(file: Path, names: Sequence[str], wanted: str | None) -> str:
    """Returns the name of the wanted variable in a file, or of its only variable."""
    if wanted is not None and wanted in names:
        return wanted
    known = ", ".join(sorted(names)) or "none"
    if wanted is not None:
        raise invalid("--variable", f"a variable of {file} ({known})", f"'{wanted}'")
    if len(names) != 1:
        raise invalid(file, "one variable", f"{len(names)} ({known}); choose with --variable")
    return names[0]


def choose_bands(file: Path, count: int, choice: Choice) -> Sequence[int]:
    """Returns the numbers of the bands to read, counted from 1."""
    if choice.band is None:
        return range(1, count + 1)
    if not 1 <= choice.band <= count:
        raise invalid("--band", f"1 to {count} for {file}", choice.band)
    return [choice.band]


def is_missing(stored: NDArray[Any], nodata: Sequence[float]) -> NDArray[np.bool_]:
    """Returns a mask of the cells that contain one of the `nodata` numbers.

    The numbers are rounded to the type of the file's numbers first.
    """
    missing = np.zeros(stored.shape, np.bool_)
    for number in nodata:
        with np.errstate(over="ignore"):
            missing |= stored == (stored.dtype.type(number) if stored.dtype.kind == "f" else number)
    return missing


def check_cells(file: Path, height: int, width: int) -> None:
    """Refuses a layer that is too large, before it is read."""
    if height * width > MOST_CELLS:
        raise invalid(file, f"at most {MOST_CELLS} cells", f"{height} x {width}")
