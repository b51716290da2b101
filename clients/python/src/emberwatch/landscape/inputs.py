"""Finds the files of each sequence, and reads them. Only one layer is in memory at a time."""

import os
import re
from collections.abc import Generator, Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

from emberwatch.errors import invalid
from emberwatch.landscape import netcdf, numpy_file, raster
from emberwatch.landscape.layers import Choice, Layer

_READERS: Final = {
    ".tif": raster.read,
    ".tiff": raster.read,
    ".asc": raster.read,
    ".nc": netcdf.read,
    ".npy": numpy_file.read,
    ".npz": numpy_file.read,
}
#: Endings of auxiliary files, which GDAL reads together with the raster of the same name.
_AUXILIARY: Final = (".prj", ".tfw", ".xml")


def stacks(inputs: Sequence[Path], *, one_file_each: bool) -> list[list[Path]]:
    """Returns the files of each sequence.

    Each folder is a sequence, ordered by the numbers in its file names. All files that are given by
    name form one more sequence. `one_file_each` makes each file a separate sequence.
    """
    found, loose = list[list[Path]](), list[Path]()
    for path in inputs:
        if not path.exists():
            raise invalid(path, "a file or folder", "none")
        if path.is_dir():
            files = sorted(_layers(path.iterdir()), key=_by_number)
            if not files:
                raise invalid(path, "rasters in this folder", "none")
            found.append(files)
        else:
            loose.append(path)
    found += [loose] if loose else []
    files = [file for stack in found for file in stack]
    known = set[str]()
    for file in files:
        if file.suffix.lower() not in _READERS:
            raise invalid(file, f"one of {', '.join(_READERS)}", f"'{file.suffix}'")
        if os.path.realpath(file) in known:
            raise invalid(file, "each file once", "this one twice")
        known.add(os.path.realpath(file))
    return [[file] for file in files] if one_file_each else found


def read(files: Sequence[Path], choice: Choice) -> Generator[Layer]:
    """Yields the layers of files in order. Each file is closed after its last layer."""
    for file in files:
        with closing(_READERS[file.suffix.lower()](file, choice)) as layers:
            yield from layers


def _layers(files: Iterable[Path]) -> list[Path]:
    """Drops hidden files, and auxiliary ones such as `fire.tif.ovr` and `fire.prj`."""
    files = [file for file in files if not file.name.startswith(".")]
    layers = [file for file in files if file.suffix.lower() in _READERS]
    names = tuple(f"{file.stem}." for file in layers)
    others = [file for file in files if not file.name.startswith(names)]
    return layers + [file for file in others if file.suffix.lower() not in _AUXILIARY]


def _by_number(file: Path) -> list[tuple[int, str]]:
    """Returns a sort key that orders `step_2` before `step_10`."""
    parts = re.findall(r"\d+|\D+", file.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
