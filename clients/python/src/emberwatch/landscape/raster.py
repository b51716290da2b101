"""Reader of GeoTIFF and ESRI ASCII grids, which uses GDAL through rioxarray."""

import re
import warnings
from collections.abc import Generator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.common.paths import utf8
from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.grid import LIKE, Place
from emberwatch.landscape.layers import Choice, Layer, choose_bands, window
from emberwatch.landscape.libraries import library
from emberwatch.landscape.schedule import Clock

#: Descriptions of bands that say which cells of other bands are valid.
_AUXILIARY: Final = re.compile(r"(?i)\b(alpha|(data|valid\w*|cloud) ?mask|quality|q[ac])\b")

#: A header line of an ESRI ASCII grid.
_HEADER: Final = re.compile(
    rb"(?i)\s*(ncols|nrows|[xy]ll(corner|center)|cellsize|d[xy]|nodata_value)\s"
)


def read(file: Path, choice: Choice) -> Generator[Layer]:
    """Yields the bands of a file, which is closed after the last one."""
    is_ascii = file.suffix.lower() == ".asc"
    driver, kind = ("AAIGrid", "an ESRI ASCII grid") if is_ascii else ("GTiff", "a GeoTIFF")
    rasterio, rioxarray = library("rasterio", file), library("rioxarray", file)
    path = Path(utf8("file", file.absolute()))
    # GDAL warns about files without a position, which are valid; its other warnings do not help
    # users.
    with warnings.catch_warnings(action="ignore"):
        try:
            with rasterio.open(path, driver=driver) as source, ExitStack() as stack:
                place, (bands, alpha) = _place(file, source), _bands(file, source, choice)
                if is_ascii:
                    arrays = [_ascii(file, source)]
                else:
                    arrays = stack.enter_context(
                        rioxarray.open_rasterio(
                            path, mask_and_scale=True, decode_times=False, cache=False
                        )
                    )
                for band in bands:
                    name = f"{file}, band {band}" if source.count > 1 else str(file)
                    array = _turned(arrays[band - 1], source.transform)
                    values, cut = window(name, array, place, choice)
                    if alpha:
                        array = _turned(arrays[alpha - 1], source.transform)
                        is_valid = window(name, array, place, replace(choice, nodata=()))[0] > 0
                        values[~is_valid] = np.nan
                    yield Layer(
                        name=name,
                        values=values,
                        place=cut,
                        clock=Clock(source.units[band - 1] or ""),
                        stored=np.dtype("f8" if is_ascii else source.dtypes[band - 1]),
                    )
        except InvalidArgumentError:
            raise
        except Exception as error:  # rasterio and rioxarray have no common base class
            words = error.__cause__ or error
            raise InvalidArgumentError(f"{file}: expected {kind}, got: {words}") from None


def _bands(file: Path, source: Any, choice: Choice) -> tuple[Sequence[int], int]:
    """Returns the bands with values, and the alpha band, which is 0 in cells without; 0: none."""
    if source.subdatasets:
        pages = f"{len(source.subdatasets)} pages; make bands of them (gdal_merge.py -separate)"
        raise invalid(file, "one image", pages)
    bands = choose_bands(file, source.count, choice)
    if any(source.dtypes[band - 1].startswith("complex") for band in bands):
        raise invalid(file, "real numbers", source.dtypes[bands[0] - 1])
    kinds, labels = source.colorinterp, source.descriptions
    alpha = [band for band in source.indexes if kinds[band - 1].name == "alpha"]
    odd = alpha + [band for band in bands if _AUXILIARY.search(labels[band - 1] or "")]
    if choice.band is None and odd and not (odd == alpha and len(bands) == 2):
        remedy = f"choose with --band; if it is one, gdal_edit.py -colorinterp_{odd[0]} gray"
        got = f"band {odd[0]}, '{labels[odd[0] - 1] or 'alpha'}'; {remedy}"
        raise invalid(file, "bands of layers", got)
    others = [band for band in bands if band not in alpha]
    return (others, min(alpha, default=0)) if others else (bands, 0)


def _place(file: Path, source: Any) -> Place:
    """Returns the grid of a file. If the transform is the identity, the file has no position."""
    (height, width), transform, crs = source.shape, source.transform, source.crs
    # Measured over the whole grid, because rotations by tiny angles are rounding errors.
    skewed = abs(transform.b) * height > LIKE * abs(transform.a)
    if skewed or abs(transform.d) * width > LIKE * abs(transform.e) or source.gcps[0]:
        got = "a rotated grid; reproject it (gdalwarp -t_srs)"
        raise invalid(file, "rows from west to east", got)
    if transform.is_identity:
        return Place(shape=source.shape)
    east, south = transform.c + transform.a * width, transform.f + transform.e * height
    return Place(
        shape=source.shape,
        corner=(min(transform.c, east), max(transform.f, south)),
        cell=(abs(transform.a), abs(transform.e)),
        projection=crs.to_wkt() if crs else None,
    )


def _turned(array: Any, transform: Any) -> Any:
    """Returns a band whose first row is in the north, and first column in the west."""
    if transform.is_identity:  # no position: the rows stay in their order
        return array
    return array[:: 1 if transform.e < 0 else -1, :: 1 if transform.a > 0 else -1]


def _ascii(file: Path, source: Any) -> NDArray[np.float64]:
    """Parses an ASCII grid. GDAL would accept too few or too many numbers, and read words as 0."""
    with file.open("rb") as opened:
        start = 0
        while _HEADER.match(opened.readline()):
            start = opened.tell()
        opened.seek(start)
        values = np.concatenate([np.array(line.split(), np.float64) for line in opened])
    if values.size != source.height * source.width:
        expected = f"{source.height * source.width} numbers for {source.height} x {source.width}"
        raise invalid(file, f"{expected} cells", values.size)
    if source.nodata is not None:  # compared as 32-bit numbers: the header may be rounded
        with np.errstate(over="ignore"):
            values[values.astype(np.float32) == np.float32(source.nodata)] = np.nan
    return values.reshape(source.shape)
