"""Reader of NumPy files, which are read whole."""

from argparse import Namespace
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.grid import Place
from emberwatch.landscape.layers import Layer, choose_bands, choose_variable


def read(file: Path, flags: Namespace) -> Generator[Layer]:
    """Yields the layers of the only array in a file, or of the array of the chosen name."""
    array = _array(file, flags)
    if array.dtype.kind not in "biuf" or array.ndim not in (2, 3) or 0 in array.shape:
        shapes = "(rows, columns) or (layers, rows, columns)"
        raise invalid(file, f"numbers of shape {shapes}", f"{array.dtype} {array.shape}")
    array = array.reshape(-1, *array.shape[-2:])
    for band in choose_bands(file, len(array), flags.band):
        yield Layer(
            name=f"{file}, layer {band}" if len(array) > 1 else str(file),
            values=np.array(array[band - 1], np.promote_types(array.dtype, np.float32)),
            place=Place(shape=(array.shape[1], array.shape[2])),
        )


def _array(file: Path, flags: Namespace) -> NDArray[Any]:
    try:
        with file.open("rb") as opened:
            loaded: Any = np.load(opened)
            if hasattr(loaded, "files"):  # an archive
                loaded = loaded[choose_variable(file, loaded.files, flags.variable)]
            return loaded
    except InvalidArgumentError:
        raise
    except Exception as error:  # NumPy, zipfile, zlib and tokenize differ on damaged bytes
        raise InvalidArgumentError(f"{file}: expected a NumPy file, got: {error}") from None
