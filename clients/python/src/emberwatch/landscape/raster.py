"""Reader of GeoTIFF and ESRI ASCII grids, which uses GDAL through rasterio."""

import contextlib
import warnings
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.common.paths import utf8
from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.grid import LIKE, Place
from emberwatch.landscape.layers import Choice, Layer, check_cells, choose_bands, is_missing
from emberwatch.landscape.libraries import library
from emberwatch.landscape.schedule import Clock

#: First words of the header lines of an ESRI ASCII grid.
_ASCII_HEADER: Final = frozenset(
    "ncols nrows xllcorner yllcorner xllcenter yllcenter cellsize dx dy nodata_value".split()
)


def read(file: Path, choice: Choice) -> Generator[Layer]:
    """Yields the bands of a file, which is closed after the last one."""
    if choice.variable is not None:
        raise InvalidArgumentError(
            f"--variable: {file} has no variables, got '{choice.variable}'; leave the flag out"
        )
    is_ascii = file.suffix.lower() == ".asc"
    driver, kind = ("AAIGrid", "an ESRI ASCII grid") if is_ascii else ("GTiff", "a GeoTIFF")
    rasterio, errors = library("rasterio", file), library("rasterio.errors", file)
    # GDAL warns about files without a position, which are valid; its other warnings do not help
    # users.
    with warnings.catch_warnings(action="ignore"):
        try:
            with rasterio.open(Path(utf8("file", file.absolute())), driver=driver) as source:
                place = _place(file, source)
                for band in choose_bands(file, source.count, choice):
                    if is_ascii:
                        values = _ascii(file, place.shape, choice.nodata)
                    else:
                        values = _values(file, source, band, choice.nodata)
                    yield Layer(
                        name=f"{file}, band {band}" if source.count > 1 else str(file),
                        values=values,
                        place=place,
                        clock=Clock(source.units[band - 1] or ""),
                    )
        except errors.RasterioError as error:
            words = error.__cause__ or error
            raise InvalidArgumentError(f"{file}: expected {kind}, got: {words}") from None


def _place(file: Path, source: Any) -> Place:
    """Returns the grid of a file. If the transform is the identity, the file has no position."""
    check_cells(file, source.height, source.width)
    (height, width), transform, crs = source.shape, source.transform, source.crs
    if transform.is_identity:
        return Place(shape=source.shape)
    # The skew is measured over the whole grid, because rotations by tiny angles are rounding
    # errors.
    skewed = abs(transform.b) * height, abs(transform.d) * width
    if skewed[0] > LIKE * abs(transform.a) or skewed[1] > LIKE * abs(transform.e):
        raise invalid(
            file, "rows from west to east", "a rotated grid; reproject it (gdalwarp -t_srs)"
        )
    far = transform * (width, height)
    return Place(
        shape=source.shape,
        corner=(min(transform.c, far[0]), max(transform.f, far[1])),
        cell=(abs(transform.a), abs(transform.e)),
        projection=crs.to_wkt() if crs else None,
    )


def _values(file: Path, source: Any, band: int, nodata: Sequence[float]) -> NDArray[np.float64]:
    dtype = source.dtypes[band - 1]
    if dtype.startswith("complex"):
        raise invalid(file, "real numbers", dtype)
    stored: Any = source.read(band, masked=True)
    values = stored.data.astype(np.float64) * source.scales[band - 1] + source.offsets[band - 1]
    values[stored.mask | is_missing(stored.data, nodata)] = np.nan
    southward, eastward = source.transform.e < 0, source.transform.a > 0
    if source.transform.is_identity:  # no position: the rows stay in their order
        return values
    return values[:: 1 if southward else -1, :: 1 if eastward else -1].copy()


def _ascii(file: Path, shape: tuple[int, int], nodata: Sequence[float]) -> NDArray[np.float64]:
    """Parses an ASCII grid. GDAL would accept too few or too many numbers, and read words as 0."""
    rows, never = list[NDArray[np.float64]](), ""
    with file.open(encoding="ascii", errors="replace") as lines:
        for line in lines:
            words = line.lower().replace(",", ".").split()
            if words and words[0] in _ASCII_HEADER and not rows:
                never = words[-1] if words[0] == "nodata_value" else never
            elif words:
                rows.append(np.array([_number(file, word, never) for word in words]))
    values = np.concatenate(rows) if rows else np.empty(0)
    if values.size != shape[0] * shape[1]:
        wanted = f"{shape[0] * shape[1]} numbers for {shape[0]} x {shape[1]} cells"
        raise invalid(file, wanted, values.size)
    with contextlib.suppress(ValueError):
        nodata = (*nodata, float(never))
    with np.errstate(over="ignore"):  # compared as 32-bit numbers: the header may be rounded
        values[is_missing(values.astype(np.float32), nodata)] = np.nan
    return values.reshape(shape)


def _number(file: Path, word: str, never: str) -> float:
    try:
        return np.nan if word == never else float(word)
    except ValueError:
        raise invalid(
            file, "numbers", f"'{word[:40]}'; NODATA_value can define a word for no value"
        ) from None
