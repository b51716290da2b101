"""Layers, which are values with the positions of their cells, and helpers for all readers."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import invalid
from emberwatch.landscape.grid import Place, crop
from emberwatch.landscape.schedule import Clock, Time

MOST_CELLS: Final = 1 << 28  # maximum number of used cells of a layer: 1 GiB of 32-bit numbers
_STRIP: Final = 1 << 22  # number of cells that are read at once
_ROUNDED: Final = float(np.finfo(np.float32).eps)  # relative tolerance for `nodata` numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """The part of each file to read, from the flags (docs/landscapes.md)."""

    variable: str | None = None
    band: int | None = None
    nodata: tuple[float, ...] = ()
    crop: tuple[int, ...] | None = None
    cell: float | None = None
    """Side of the cells that perimeters and detections are drawn on, metres; None: refuse these."""
    time_column: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """One raster."""

    name: str
    """File and band, for errors."""
    values: NDArray[np.floating]
    """Shape (rows, columns), the first row in the north; NaN in cells without a value."""
    place: Place
    clock: Clock = Clock()
    """The unit of the values, if they are times."""
    stored: np.dtype[Any] = np.dtype(np.float64)
    """The type of the numbers in the file."""
    time: Time | None = None
    """The time of the layer, if the file states it."""
    notes: tuple[str, ...] = ()
    """What the reader assumed."""


def window(
    name: str, array: Any, place: Place, choice: Choice
) -> tuple[NDArray[np.floating], Place]:
    """Reads the chosen window of an array (rows, columns) whose first cell is the north-west one.

    Returns the values, NaN for `choice.nodata`, and their grid. Reads strips of rows one by one.
    """
    (rows, columns), cut = crop(place, choice.crop)
    height, width = cut.shape
    if height * width > MOST_CELLS:
        raise invalid(name, f"at most {MOST_CELLS} cells", f"{height} x {width}; use --crop")
    values = np.empty(cut.shape, np.promote_types(array.dtype, np.float32))
    strip = max(1, _STRIP // width)
    for top in range(0, height, strip):
        bottom = min(top + strip, height)
        read = np.asarray(array[rows.start + top : rows.start + bottom, columns])
        values[top:bottom] = read
        for number in choice.nodata:
            values[top:bottom][np.isclose(read, number, rtol=_ROUNDED, atol=0.0)] = np.nan
    return values, cut


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
