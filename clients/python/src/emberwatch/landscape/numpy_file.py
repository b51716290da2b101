"""Reader of NumPy files, which are read whole."""

from argparse import Namespace
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np

from emberwatch.errors import invalid
from emberwatch.landscape.grid import Place
from emberwatch.landscape.layers import Layer, choose_bands, choose_variable


def read(file: Path, flags: Namespace) -> Generator[Layer]:
    """Yields the layers of the only array in a file, or of the array of the chosen name."""
    with file.open("rb") as opened:
        array: Any = np.load(opened)
        if hasattr(array, "files"):  # an archive
            array = array[choose_variable(file, array.files, flags.variable)]
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
