"""Reader of NumPy files, which holds the whole array in memory."""

import math
import zipfile
from collections.abc import Generator
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.lib.format import read_array, read_array_header_1_0, read_array_header_2_0, read_magic
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.grid import Place
from emberwatch.landscape.layers import (
    Choice,
    Layer,
    check_cells,
    choose_bands,
    choose_variable,
    is_missing,
)

MOST_BYTES: Final = 1 << 32  # maximum size of an array, bytes


def read(file: Path, choice: Choice) -> Generator[Layer]:
    """Yields the layers of the only array in a file, or of the array of the chosen name."""
    array = _array(file, choice)
    array = array.reshape(-1, *array.shape[-2:])
    for band in choose_bands(file, len(array), choice):
        stored = array[band - 1]
        values = stored.astype(np.float64)
        values[is_missing(stored, choice.nodata)] = np.nan
        yield Layer(
            name=f"{file}, layer {band}" if len(array) > 1 else str(file),
            values=values,
            place=Place(shape=(array.shape[1], array.shape[2])),
        )


def _array(file: Path, choice: Choice) -> NDArray[Any]:
    try:
        with file.open("rb") as opened:
            if zipfile.is_zipfile(opened):
                with zipfile.ZipFile(opened) as archive:
                    members = {name.removesuffix(".npy"): name for name in archive.namelist()}
                    name = choose_variable(file, list(members), choice.variable)
                    with archive.open(members[name]) as member:
                        return _checked_array(file, member)
            if choice.variable is not None:
                raise InvalidArgumentError(
                    f"--variable: {file} has only one array, without a name, got "
                    f"'{choice.variable}'; leave the flag out"
                )
            return _checked_array(file, opened)
    except InvalidArgumentError:
        raise
    except Exception as error:  # NumPy, zipfile, zlib and tokenize differ on damaged bytes
        raise InvalidArgumentError(f"{file}: expected a NumPy file, got: {error}") from None


def _checked_array(file: Path, opened: IO[bytes]) -> NDArray[Any]:
    """Reads an array, after a check of its header."""
    opened.seek(0)
    version = read_magic(opened)
    header = {(1, 0): read_array_header_1_0, (2, 0): read_array_header_2_0}.get(version)
    if header is None:
        raise ValueError(f"version {version} of the format")
    shape, _, dtype = header(opened)
    if dtype.kind not in "biuf" or len(shape) not in (2, 3) or 0 in shape:
        raise invalid(
            file, "numbers of shape (rows, columns) or (layers, rows, columns)", f"{dtype} {shape}"
        )
    check_cells(file, *shape[-2:])
    n_bytes = math.prod(shape) * dtype.itemsize
    if n_bytes > MOST_BYTES:
        raise invalid(file, f"at most {MOST_BYTES} bytes of numbers", f"{n_bytes}: {dtype} {shape}")
    opened.seek(0)
    return read_array(opened, allow_pickle=False)
