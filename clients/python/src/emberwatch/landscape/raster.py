"""Readers of GeoTIFF and ESRI ASCII grids, by GDAL through rasterio, and of NumPy files."""

from argparse import Namespace
from collections.abc import Generator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from emberwatch.common.paths import utf8
from emberwatch.errors import invalid
from emberwatch.landscape.grid import LIKE, Place
from emberwatch.landscape.layers import Layer, choose_bands, choose_variable


def read(file: Path, flags: Namespace) -> Generator[Layer]:
    """Yields the bands of a file, which is closed after the last one."""
    path, driver = utf8("file", file.absolute()), "GTiff"
    if file.suffix.lower() == ".asc":
        driver = "AAIGrid"
    with import_module("rasterio").open(path, driver=driver) as source:
        place = _place(file, source)
        for band in _bands(file, source, flags):
            # GDAL masks cells by numbers that mean "no value", masks and alpha bands.
            read = source.read(band, masked=True)
            values = read.astype(np.promote_types(read.dtype, np.float32)).filled(np.nan)
            values = values * source.scales[band - 1] + source.offsets[band - 1]
            yield Layer(
                name=f"{file}, band {band}" if source.count > 1 else str(file),
                values=_turned(values, source.transform),
                place=place,
                unit=source.units[band - 1] or "",
            )


def read_numpy(file: Path, flags: Namespace) -> Generator[Layer]:
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


def _bands(file: Path, source: Any, flags: Namespace) -> Sequence[int]:
    """Returns the bands with values. GDAL takes the last of four bytes for an alpha band."""
    bands = choose_bands(file, source.count, flags.band)
    alpha = [band for band in bands if source.colorinterp[band - 1].name == "alpha"]
    if alpha and flags.band is None:
        remedy = f"choose with --band; if it is a layer, gdal_edit.py -colorinterp_{alpha[0]} gray"
        raise invalid(file, "bands of layers", f"the alpha band {alpha[0]}; {remedy}")
    return bands


def _place(file: Path, source: Any) -> Place:
    """Returns the grid of a file. If the transform is the identity, the file has no position."""
    (height, width), transform, crs = source.shape, source.transform, source.crs
    # Measured over the whole grid, because rotations by tiny angles are rounding errors.
    skewed = abs(transform.b) * height > LIKE * abs(transform.a)
    if skewed or abs(transform.d) * width > LIKE * abs(transform.e):
        got = "a rotated grid; reproject it (gdalwarp -t_srs)"
        raise invalid(file, "rows from west to east", got)
    if transform.is_identity:
        return Place(shape=source.shape)
    east, south = transform.c + transform.a * width, transform.f + transform.e * height
    return Place(
        shape=source.shape,
        corner=(min(transform.c, east), max(transform.f, south)),
        cell=(abs(transform.a), abs(transform.e)),
        crs=import_module("pyproj").CRS.from_wkt(crs.to_wkt()) if crs else None,
    )


def _turned(values: Any, transform: Any) -> Any:
    """Returns values whose first row is in the north, and first column in the west."""
    if transform.is_identity:  # no position: the rows stay in their order
        return values
    return values[:: 1 if transform.e < 0 else -1, :: 1 if transform.a > 0 else -1]
