"""Files as layers: one array of numbers each, with the place of its cells.

GeoTIFF, ESRI ASCII grid and NetCDF are read by GDAL through rasterio, NumPy files by NumPy. One
layer is in memory at a time, of NumPy files the whole array.
"""

import importlib
import math
import os
import re
import warnings
import zipfile
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.lib.format import read_array, read_array_header_1_0, read_array_header_2_0, read_magic
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.grid import Place
from emberwatch.landscape.schedule import Clock, Time

_DRIVERS: Final = {
    ".tif": ("GTiff", "a GeoTIFF"),
    ".tiff": ("GTiff", "a GeoTIFF"),
    ".asc": ("AAIGrid", "an ESRI ASCII grid"),
    ".nc": ("netCDF", "a NetCDF file"),
}
_NUMPY: Final = (".npy", ".npz")
_KNOWN: Final = ", ".join((*_DRIVERS, *_NUMPY))
#: First words of the lines before an ESRI ASCII grid's numbers.
_ASCII_HEADER: Final = frozenset(
    "ncols nrows xllcorner yllcorner xllcenter yllcenter cellsize dx dy nodata_value".split()
)
#: Dimensions of NetCDF files that need not say that they are time.
_TIMES: Final = frozenset(("time", "t", "dimt", "date", "step", "layer", "band"))
#: Files that say where the cells of others are, which GDAL reads with them.
_BESIDE: Final = (".prj", ".tfw", ".xml")
_MOST_CELLS: Final = 1 << 27  # of a layer: 1 GiB as numbers
_MOST_BYTES: Final = 1 << 32  # of a NumPy array, all of which is in memory


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """What to take of each file."""

    variable: str | None = None
    band: int | None = None
    nodata: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """One raster."""

    name: str
    """File and band, for errors."""
    values: NDArray[np.float64]
    """Shape (rows, columns), the first row in the north; NaN where the file has no value."""
    place: Place
    clock: Clock = Clock()
    """What a number counts, if it is a time."""
    time: Time | None = None
    """Where the file has a time dimension: the layer's place on it."""


def stacks(inputs: Sequence[Path], *, one_file_each: bool) -> list[list[Path]]:
    """The files of each sequence: of each folder, by the numbers in their names, and the rest.

    `one_file_each` makes each file a sequence of its own.
    """
    found, loose = list[list[Path]](), list[Path]()
    for path in inputs:
        if not path.exists():
            raise invalid(path, "a file or folder", "none")
        if path.is_dir():
            files = sorted((file for file in path.iterdir() if _is_layer(file)), key=_by_number)
            if not files:
                raise invalid(path, "rasters in this folder", "none")
            found.append(files)
        else:
            loose.append(path)
    found += [loose] if loose else []
    files = [file for stack in found for file in stack]
    known = set[str]()
    for file in files:
        if file.suffix.lower() not in (*_DRIVERS, *_NUMPY):
            raise invalid(file, f"one of {_KNOWN}", f"'{file.suffix}'")
        if os.path.realpath(file) in known:
            raise invalid(file, "each file once", "it twice")
        known.add(os.path.realpath(file))
    return [[file] for file in files] if one_file_each else found


def read(files: Sequence[Path], choice: Choice) -> Generator[Layer]:
    """The layers of these files, in order; a file is open until its last, or until closed."""
    for file in files:
        reader = _read_numpy if file.suffix.lower() in _NUMPY else _read_raster
        with closing(reader(file, choice)) as layers:
            yield from layers


def _is_layer(file: Path) -> bool:
    return not file.name.startswith(".") and file.suffix.lower() not in _BESIDE


def _by_number(file: Path) -> list[tuple[int, str]]:
    """Orders `step_2` before `step_10`."""
    parts = re.findall(r"\d+|\D+", file.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _read_numpy(file: Path, choice: Choice) -> Generator[Layer]:
    array = _array(file, choice)
    array = array.reshape(-1, *array.shape[-2:])
    for band in _bands(file, len(array), choice):
        stored = array[band - 1]
        values = stored.astype(np.float64)
        values[_is_missing(stored, choice.nodata)] = np.nan
        yield Layer(
            name=f"{file}, layer {band}" if len(array) > 1 else str(file),
            values=values,
            place=Place(shape=(array.shape[1], array.shape[2])),
        )


def _is_missing(stored: NDArray[Any], nodata: Sequence[float]) -> NDArray[np.bool_]:
    """Where a file has one of these numbers, each rounded as the file has rounded its own."""
    missing = np.zeros(stored.shape, np.bool_)
    for number in nodata:
        with np.errstate(over="ignore"):
            missing |= stored == (stored.dtype.type(number) if stored.dtype.kind == "f" else number)
    return missing


def _array(file: Path, choice: Choice) -> NDArray[Any]:
    try:
        with file.open("rb") as opened:
            if zipfile.is_zipfile(opened):
                with zipfile.ZipFile(opened) as archive:
                    members = {name.removesuffix(".npy"): name for name in archive.namelist()}
                    name = _variable(file, list(members), choice.variable)
                    with archive.open(members[name]) as member:
                        return _checked_array(file, member)
            if choice.variable is not None:
                raise invalid(
                    "--variable", f"none for {file}, which has one array", f"'{choice.variable}'"
                )
            return _checked_array(file, opened)
    except InvalidArgumentError:
        raise
    except Exception as error:  # of NumPy, zipfile, zlib and tokenize, for damaged bytes
        raise InvalidArgumentError(f"{file}: expected a NumPy file, got: {error}") from None


def _checked_array(file: Path, opened: IO[bytes]) -> NDArray[Any]:
    """The array, whose header is checked before its values are read."""
    opened.seek(0)
    version = read_magic(opened)
    header = {(1, 0): read_array_header_1_0, (2, 0): read_array_header_2_0}.get(version)
    if header is None:
        raise ValueError(f"version {version} of the format")
    shape, _, dtype = header(opened)
    if dtype.kind not in "biuf" or len(shape) not in (2, 3) or 0 in shape:
        raise invalid(
            file, "numbers of shape (rows, columns) or (layers, rows, columns)", f"{dtype} {shape}"
        )
    _check_cells(file, *shape[-2:])
    n_bytes = math.prod(shape) * dtype.itemsize
    if n_bytes > _MOST_BYTES:
        raise invalid(
            file, f"at most {_MOST_BYTES} bytes of numbers", f"{n_bytes}: {dtype} {shape}"
        )
    opened.seek(0)
    return read_array(opened, allow_pickle=False)


def _check_cells(file: Path, height: int, width: int) -> None:
    if height * width > _MOST_CELLS:
        raise invalid(file, f"at most {_MOST_CELLS} cells", f"{height} x {width}")


def _read_raster(file: Path, choice: Choice) -> Generator[Layer]:
    rasterio = _rasterio(file)
    driver, kind = _DRIVERS[file.suffix.lower()]
    # What has no place is a grid without one; GDAL's other warnings are of no use to people.
    with warnings.catch_warnings(action="ignore"):
        try:
            with rasterio.open(_address(rasterio, file, driver, choice), driver=driver) as source:
                place = _place(file, source)
                if driver == "AAIGrid":
                    _check_ascii(file, *place.shape)
                for band in _bands(file, source.count, choice):
                    yield _layer(file, source, place, band, choice.nodata)
        except rasterio.errors.RasterioError as error:
            words = error.__cause__ or error
            raise InvalidArgumentError(f"{file}: expected {kind}, got: {words}") from None


def _rasterio(file: Path) -> Any:
    try:
        rasterio = importlib.import_module("rasterio")
        importlib.import_module("rasterio.errors")
    except ImportError as error:
        raise InvalidArgumentError(
            f"{file}: expected rasterio to read it with, got: {error}; "
            "pip install emberwatch[landscape]"
        ) from None
    return rasterio


def _address(rasterio: Any, file: Path, driver: str, choice: Choice) -> str:
    """What GDAL opens: the file, or one variable of it."""
    if driver != "netCDF":
        if choice.variable is not None:
            raise invalid(
                "--variable", f"none for {file}, which has no variables", f"'{choice.variable}'"
            )
        return str(file)
    with rasterio.open(file, driver=driver) as source:
        names = [address.rpartition(":")[2] for address in source.subdatasets]
        if source.count:
            names = [source.tags(1)["NETCDF_VARNAME"]]
    return f'NETCDF:"{file}":{_variable(file, names, choice.variable)}'


def _variable(file: Path, names: list[str], wanted: str | None) -> str:
    if wanted in names:
        return wanted
    known = ", ".join(sorted(names)) or "none"
    if wanted is not None:
        raise invalid("--variable", f"one of {file} ({known})", f"'{wanted}'")
    if len(names) != 1:
        raise invalid(file, "one variable", f"{len(names)} ({known}); choose with --variable")
    return names[0]


def _bands(file: Path, count: int, choice: Choice) -> Sequence[int]:
    if choice.band is None:
        return range(1, count + 1)
    if not 1 <= choice.band <= count:
        raise invalid("--band", f"1 to {count} for {file}", choice.band)
    return [choice.band]


def _place(file: Path, source: Any) -> Place:
    """Where the cells are; a file that does not say so has the identity as its transform."""
    _check_cells(file, source.height, source.width)
    shape, transform, crs = (source.height, source.width), source.transform, source.crs
    if transform.is_identity:
        return Place(shape=shape)
    if transform.b or transform.d:
        raise invalid(file, "rows from west to east", "a rotated grid")
    far = transform * (source.width, source.height)
    return Place(
        shape=shape,
        corner=(min(transform.c, far[0]), max(transform.f, far[1])),
        cell=(abs(transform.a), abs(transform.e)),
        projection=crs.to_wkt() if crs else None,
        is_in_degrees=bool(crs and crs.is_geographic),
        metres=crs.linear_units_factor[1] if crs and crs.is_projected else 1.0,
    )


def _check_ascii(file: Path, height: int, width: int) -> None:
    """Refuses what GDAL fills up, cuts or takes as 0."""
    n_numbers = 0
    with file.open(encoding="ascii", errors="replace") as lines:
        for line in lines:
            words = line.split()
            if n_numbers == 0 and words and words[0].lower() in _ASCII_HEADER:
                continue
            for word in words:
                try:
                    float(word.replace(",", "."))
                except ValueError:
                    raise invalid(file, "numbers", f"'{word[:40]}'") from None
            n_numbers += len(words)
    if n_numbers != height * width:
        raise invalid(file, f"{height * width} numbers for {height} x {width} cells", n_numbers)


def _layer(file: Path, source: Any, place: Place, band: int, nodata: Sequence[float]) -> Layer:
    dtype = source.dtypes[band - 1]
    if dtype.startswith("complex"):
        raise invalid(file, "real numbers", dtype)
    stored: Any = source.read(band, masked=True)
    values = stored.data.astype(np.float64) * source.scales[band - 1] + source.offsets[band - 1]
    values[stored.mask | _is_missing(stored.data, nodata)] = np.nan
    if place.corner is not None:  # else the first row is the first
        southward, eastward = source.transform.e < 0, source.transform.a > 0
        values = values[:: 1 if southward else -1, :: 1 if eastward else -1].copy()
    tags, of_band = source.tags(), source.tags(band)
    dimension = _dimension(file, tags)
    time = None
    if f"NETCDF_DIM_{dimension}_VALUES" in tags:  # else the dimension only counts the layers
        value = float(of_band[f"NETCDF_DIM_{dimension}"])
        if not math.isfinite(value):
            raise invalid(f"{file}, band {band}", "a time", value)
        time = Time(value, _clock(dimension, tags, None))
    return Layer(
        name=f"{file}, band {band}" if source.count > 1 else str(file),
        values=values,
        place=place,
        clock=_clock(of_band.get("NETCDF_VARNAME", ""), tags, source.units[band - 1]),
        time=time,
    )


def _clock(variable: str, tags: dict[str, str], unit: str | None) -> Clock:
    return Clock(
        unit or tags.get(f"{variable}#units", ""), tags.get(f"{variable}#calendar", "standard")
    )


def _dimension(file: Path, tags: dict[str, str]) -> str:
    """The one beside rows and columns, if any: that of time."""
    extra = [name for name in tags.get("NETCDF_DIM_EXTRA", "").strip("{}").split(",") if name]
    wrong = [name for name in extra if not _is_time(name, tags)] or extra[1:]
    if wrong:
        raise InvalidArgumentError(
            f"{file}: expected a variable of time, rows and columns, in this order, got it over "
            f"{', '.join(wrong)}"
        )
    return extra[0] if extra else ""


def _is_time(name: str, tags: dict[str, str]) -> bool:
    clock = _clock(name, tags, None)
    return (
        name.lower() in _TIMES
        or tags.get(f"{name}#axis") == "T"
        or tags.get(f"{name}#standard_name") == "time"
        or clock.unit() is not None
    )
