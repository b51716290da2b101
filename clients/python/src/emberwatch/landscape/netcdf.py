"""Reader of NetCDF files. xarray unpacks numbers and dates; CF attributes state axes and grid."""

from argparse import Namespace
from collections.abc import Generator, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.common.paths import utf8
from emberwatch.errors import invalid
from emberwatch.landscape.grid import Place
from emberwatch.landscape.layers import SINCE_1970, Layer, choose_bands, choose_variable

#: Standard names, units and attributes `axis` of coordinates, or names of dimensions, by axis.
_ROWS: Final = "y projection_y_coordinate latitude degrees_north lat northing".split()
_COLUMNS: Final = "x projection_x_coordinate longitude degrees_east lon easting".split()
_LAYERS: Final = "t time date step layer band".split()
_EVEN: Final = 0.1  # tolerance for positions, as a share of a cell, as 32-bit numbers are rounded


def read(file: Path, flags: Namespace) -> Generator[Layer]:
    """Yields a layer for each time of a variable. The file is closed after the last layer."""
    xarray, path = import_module("xarray"), utf8("file", file.absolute())
    import_module("rioxarray")  # adds `rio` to arrays
    options = {"engine": "netcdf4", "decode_coords": "all", "decode_timedelta": False}
    with xarray.open_dataset(path, cache=False, **options) as dataset:
        arrays = {
            str(name): array
            for name, array in dataset.data_vars.items()
            if array.ndim > 1 and array.dtype.kind in "biufM"
        }
        yield from _layers(file, arrays[choose_variable(file, arrays, flags.variable)], flags)


def _layers(file: Path, array: Any, flags: Namespace) -> Iterator[Layer]:
    if 0 in array.shape:
        raise invalid(file, "cells", f"an array of shape {array.shape}")
    rows = _dimension(array, _ROWS, array.dims[-2])
    columns = _dimension(array, _COLUMNS, array.dims[-1])
    array = array.transpose(..., rows, columns)
    (layers, *others) = array.dims[:-2] or ("layer",)
    if others or (array.ndim == 3 and _dimension(array, _LAYERS, "") != layers):
        got = f"one with {', '.join(map(str, array.dims))}"
        raise invalid(file, "a variable with the dimensions time, rows and columns", got)
    place, turned = _place(file, array, rows, columns)
    time = array.coords.get(layers if array.ndim == 3 else "time")
    array = array if array.ndim == 3 else array.expand_dims("layer")
    times, time_unit = (None, "") if time is None else _numbers(time)
    for band in choose_bands(file, len(array), flags.band):
        values, unit = _numbers(array[band - 1])
        yield Layer(
            name=f"{file}, band {band}" if len(array) > 1 else str(file),
            values=values[turned],
            place=place,
            unit=unit,
            time=None if times is None else float(np.atleast_1d(times)[band - 1]),
            time_unit=time_unit,
        )


def _dimension(array: Any, words: Sequence[str], default: str) -> str:
    """Returns the dimension whose name or coordinate has one of the words."""
    for name in array.dims:
        given: dict[str, Any] = dict(array.coords[name].attrs) if name in array.coords else {}
        told = [name, *(given.get(key, "") for key in ("axis", "standard_name", "units"))]
        if any(str(it).lower() in words for it in told):
            return name
    return default


def _numbers(array: Any) -> tuple[NDArray[np.floating], str]:
    """Returns numbers and their unit. Dates become seconds since 1970."""
    if array.dtype.kind == "M":
        seconds = (array.values - np.datetime64(0, "s")) / np.timedelta64(1, "s")
        return seconds, SINCE_1970
    numbers = np.array(array.values, np.promote_types(array.dtype, np.float32))
    return numbers, str(array.attrs.get("units", ""))


def _place(file: Path, array: Any, rows: str, columns: str) -> tuple[Place, tuple[slice, slice]]:
    """Returns the grid of a variable, and slices that put the north-west cell first.

    Without coordinates, rows run from south to north, and columns from west to east.
    """
    if rows not in array.coords or columns not in array.coords:
        return Place(shape=array.shape[-2:]), (slice(None, None, -1), slice(None))
    x, y = array.coords[columns], array.coords[rows]
    (west, width), (south, height) = _line(file, x), _line(file, y)
    turned = slice(None, None, 1 if height < 0 else -1), slice(None, None, -1 if width < 0 else 1)
    width, height = abs(width) or abs(height) or 1.0, abs(height) or abs(width) or 1.0
    place = Place(
        shape=array.shape[-2:],
        corner=(west - width / 2, south + (array.shape[-2] - 0.5) * height),
        cell=(width, height),
        crs=_crs(array, x),
    )
    return place, turned


def _line(file: Path, one: Any) -> tuple[float, float]:
    """Returns the smallest coordinate, and the distance between two, below 0 if they decrease."""
    kilometre = 1000.0 if str(one.attrs.get("units", "")).lower() in ("km", "kilometre") else 1.0
    at: NDArray[np.float64] = one.values.astype(np.float64) * kilometre
    step = float(at[-1] - at[0]) / max(1, at.size - 1)
    errors = at - at[0] - step * np.arange(at.size)
    if (at.size > 1 and step == 0) or not np.abs(errors).max() <= _EVEN * abs(step):
        sizes = np.abs(np.diff(at))
        got = f"some of {sizes.min():.6g} and some of {sizes.max():.6g}" if sizes.size else at[0]
        raise invalid(f"{file}, {one.name}", "cells of one size side by side", got)
    return float(min(at[0], at[-1])), step


def _crs(array: Any, x: Any) -> Any:
    """Returns the projection of the grid mapping; degrees without one refer to WGS 84."""
    pyproj, crs = import_module("pyproj"), array.rio.crs
    if crs is not None:
        return pyproj.CRS.from_wkt(crs.to_wkt())
    is_angle = str(x.attrs.get("units", "")).lower().startswith("degree")
    return pyproj.CRS("EPSG:4326") if is_angle else None
