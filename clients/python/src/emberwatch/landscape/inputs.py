"""Finds the files of each sequence, and reads them. Only one layer is in memory at a time."""

import re
import warnings
from argparse import Namespace
from collections.abc import Generator, Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

import numpy as np

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape import netcdf, perimeters, raster
from emberwatch.landscape.layers import Layer

#: The reader of each ending, and what it expects.
_READERS: Final = {
    ".tif": (raster.read, "a GeoTIFF"),
    ".tiff": (raster.read, "a GeoTIFF"),
    ".asc": (raster.read, "an ESRI ASCII grid"),
    ".nc": (netcdf.read, "a NetCDF file"),
    ".npy": (raster.read_numpy, "a NumPy file"),
    ".npz": (raster.read_numpy, "a NumPy file"),
    ".geojson": (perimeters.read, "perimeters"),
    ".gpkg": (perimeters.read, "perimeters"),
    ".shp": (perimeters.read, "perimeters"),
    ".csv": (perimeters.read_detections, "a CSV file"),
}
#: Formats without variables.
_UNNAMED: Final = (".tif", ".tiff", ".asc", ".npy", ".csv")
_ROUNDED: Final = float(np.finfo(np.float32).eps)  # relative tolerance for `nodata` numbers


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
            shown = [file for file in path.iterdir() if not file.name.startswith(".")]
            files = [file for file in shown if file.suffix.lower() in _READERS]
            if not files:
                raise invalid(path, "rasters in this folder", "none")
            found.append(sorted(files, key=_key))
        elif path.suffix.lower() not in _READERS:
            raise invalid(path, f"one of {', '.join(_READERS)}", f"'{path.suffix}'")
        else:
            loose.append(path)
    found += [loose] if loose else []
    return [[file] for files in found for file in files] if one_file_each else found


def read(files: Iterable[Path], flags: Namespace) -> Generator[Layer]:
    """Yields the layers of files in order. Each file is closed after its last layer."""
    for file in files:
        reader, kind = _READERS[file.suffix.lower()]
        if flags.variable is not None and file.suffix.lower() in _UNNAMED:
            got = f"'{flags.variable}'; leave the flag out"
            raise InvalidArgumentError(f"--variable: {file} has no variables, got {got}")
        try:
            # GDAL warns about files without a position, which are valid; other warnings of the
            # libraries do not help users.
            with warnings.catch_warnings(action="ignore"), closing(reader(file, flags)) as layers:
                for layer in layers:
                    for number in flags.nodata:
                        is_missing = np.isclose(layer.values, number, rtol=_ROUNDED, atol=0.0)
                        layer.values[is_missing] = np.nan
                    yield layer
        except InvalidArgumentError:
            raise
        except ImportError as error:
            raise InvalidArgumentError(f"{error}; pip install emberwatch[landscape]") from None
        except Exception as error:  # the libraries' errors have no common base class
            words = error.__cause__ or getattr(error, "strerror", None) or error
            raise InvalidArgumentError(f"{file}: expected {kind}, got: {words}") from None


def _key(file: Path) -> list[tuple[int, str]]:
    """Returns a sort key that orders `step_2` before `step_10`."""
    parts = re.findall(r"\d+|\D+", file.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
