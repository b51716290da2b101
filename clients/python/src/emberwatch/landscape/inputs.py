"""The files of each sequence, and the reader of each format. One layer is in memory at a time."""

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
#: Files about others, which GDAL reads with them if they have their names.
_BESIDE: Final = (".prj", ".tfw", ".xml")


def stacks(inputs: Sequence[Path], *, one_file_each: bool) -> list[list[Path]]:
    """The files of each sequence: of each folder, by the numbers in their names, and the rest.

    `one_file_each` makes each file a sequence of its own.
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
            raise invalid(file, "each file once", "it twice")
        known.add(os.path.realpath(file))
    return [[file] for file in files] if one_file_each else found


def read(files: Sequence[Path], choice: Choice) -> Generator[Layer]:
    """The layers of these files, in order; a file is open until its last, or until closed."""
    for file in files:
        with closing(_READERS[file.suffix.lower()](file, choice)) as layers:
            yield from layers


def _layers(files: Iterable[Path]) -> list[Path]:
    """All but hidden files and those about a layer, by its name (`fire.tif.ovr`) or ending."""
    files = [file for file in files if not file.name.startswith(".")]
    layers = [file for file in files if file.suffix.lower() in _READERS]
    names = tuple(f"{file.stem}." for file in layers)
    others = [file for file in files if not file.name.startswith(names)]
    return layers + [file for file in others if file.suffix.lower() not in _BESIDE]


def _by_number(file: Path) -> list[tuple[int, str]]:
    """Orders `step_2` before `step_10`."""
    parts = re.findall(r"\d+|\D+", file.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
