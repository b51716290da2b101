"""Finds the files of each sequence, and reads them. Only one layer is in memory at a time."""

import os
from collections.abc import Generator, Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Final, NamedTuple

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape import detections, netcdf, numpy_file, perimeters, raster
from emberwatch.landscape.layers import Choice, Layer
from emberwatch.landscape.order import ordered

_READERS: Final = {
    ".tif": raster.read,
    ".tiff": raster.read,
    ".asc": raster.read,
    ".nc": netcdf.read,
    ".npy": numpy_file.read,
    ".npz": numpy_file.read,
    ".geojson": perimeters.read,
    ".gpkg": perimeters.read,
    ".shp": perimeters.read,
    ".csv": detections.read,
}
#: Formats without variables.
_UNNAMED: Final = (".tif", ".tiff", ".asc", ".npy", ".csv")
#: Endings of auxiliary files, which GDAL reads together with the raster of the same name.
_AUXILIARY: Final = (".prj", ".tfw", ".xml", ".dbf", ".shx", ".cpg")


class Stack(NamedTuple):
    """The files of a sequence, and a note on their order in a folder."""

    files: list[Path]
    notes: tuple[str, ...] = ()


def stacks(inputs: Sequence[Path], *, one_file_each: bool, order: str | None = None) -> list[Stack]:
    """Returns the sequences.

    Each folder is a sequence, ordered by the numbers or dates in its file names (`order`). All
    files that are given by name form one more sequence. `one_file_each` makes each file a separate
    sequence.
    """
    found, loose = list[Stack](), list[Path]()
    for path in inputs:
        if not path.exists():
            raise invalid(path, "a file or folder", "none")
        if path.is_dir():
            files = _layers(path.iterdir())
            if not files:
                raise invalid(path, "rasters in this folder", "none")
            files, note = ordered(path, files, order)
            found.append(Stack(files, (note,) if len(files) > 1 else ()))
        else:
            loose.append(path)
    found += [Stack(loose)] if loose else []
    known = set[str]()
    for file in (file for stack in found for file in stack.files):
        if file.suffix.lower() not in _READERS:
            raise invalid(file, f"one of {', '.join(_READERS)}", f"'{file.suffix}'")
        if os.path.realpath(file) in known:
            raise invalid(file, "each file once", "this one twice")
        known.add(os.path.realpath(file))
    if not one_file_each:
        return found
    return [
        Stack([file], () if file != stack.files[0] else stack.notes)
        for stack in found for file in stack.files
    ]  # fmt: skip


def read(files: Sequence[Path], choice: Choice) -> Generator[Layer]:
    """Yields the layers of files in order. Each file is closed after its last layer."""
    for file in files:
        if choice.variable is not None and file.suffix.lower() in _UNNAMED:
            got = f"'{choice.variable}'; leave the flag out"
            raise InvalidArgumentError(f"--variable: {file} has no variables, got {got}")
        with closing(_READERS[file.suffix.lower()](file, choice)) as layers:
            yield from layers


def _layers(files: Iterable[Path]) -> list[Path]:
    """Drops hidden files, and auxiliary ones such as `fire.tif.ovr` and `fire.prj`."""
    files = [file for file in files if not file.name.startswith(".")]
    layers = [file for file in files if file.suffix.lower() in _READERS]
    names = tuple(f"{file.stem}." for file in layers)
    others = [file for file in files if not file.name.startswith(names)]
    return layers + [file for file in others if file.suffix.lower() not in _AUXILIARY]
