"""Reader of NumPy files. A `.npy` file is mapped into memory; a `.npz` is read whole."""

from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.grid import Place
from emberwatch.landscape.layers import Choice, Layer, choose_bands, choose_variable, window


def read(file: Path, choice: Choice) -> Generator[Layer]:
    """Yields the layers of the only array in a file, or of the array of the chosen name."""
    array = _array(file, choice)
    if array.dtype.kind not in "biuf" or array.ndim not in (2, 3) or 0 in array.shape:
        shapes = "(rows, columns) or (layers, rows, columns)"
        raise invalid(file, f"numbers of shape {shapes}", f"{array.dtype} {array.shape}")
    array = array.reshape(-1, *array.shape[-2:])
    place = Place(shape=(array.shape[1], array.shape[2]))
    for band in choose_bands(file, len(array), choice):
        name = f"{file}, layer {band}" if len(array) > 1 else str(file)
        values, cut = window(name, array[band - 1], place, choice)
        yield Layer(name=name, values=values, place=cut, stored=array.dtype)


def _array(file: Path, choice: Choice) -> NDArray[Any]:
    try:
        with file.open("rb") as opened:
            if opened.peek(2)[:2] == b"PK":
                with np.load(opened) as archive:
                    name = choose_variable(file, archive.files, choice.variable)
                    return np.asarray(archive[name])
        loaded: NDArray[Any] = np.load(file, mmap_mode="r")
        return loaded
    except InvalidArgumentError:
        raise
    except Exception as error:  # NumPy, zipfile, zlib and tokenize differ on damaged bytes
        raise InvalidArgumentError(f"{file}: expected a NumPy file, got: {error}") from None
