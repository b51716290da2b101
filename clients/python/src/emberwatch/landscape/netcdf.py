"""Reader of NetCDF files. xarray unpacks numbers; CF attributes state axes, times and the grid."""

import math
import re
import warnings
from collections.abc import Generator, Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.grid import Place
from emberwatch.landscape.ground import unit_of
from emberwatch.landscape.layers import Choice, Layer, choose_bands, choose_variable, window
from emberwatch.landscape.lengths import METRES, unit_named
from emberwatch.landscape.libraries import library
from emberwatch.landscape.schedule import SECONDS, SINCE_1970, Clock, Time

#: Standard names, units and attributes `axis` of coordinates, or names of dimensions, by axis.
_WORDS: Final = {
    "X": set(
        "x projection_x_coordinate longitude grid_longitude degrees_east degree_east degrees_e "
        "lon rlon easting dimx west_east".split()
    ),
    "Y": set(
        "y projection_y_coordinate latitude grid_latitude degrees_north degree_north degrees_n "
        "lat rlat northing dimy south_north".split()
    ),
    "T": set("t time dimt date step layer band".split()),
    "Z": {"z"},
}
#: Names of coordinates that are most likely angles, not metres.
_ANGLES: Final = {"lat", "latitude", "rlat", "lon", "longitude", "rlon"}
_DEGREES: Final = (math.radians(1.0), True)
#: Attributes that are not supported, as they change the meaning of dimensions or times.
_NOT_READ: Final = ("climatology", "compress", "coordinate_interpolation")
_EVEN: Final = 0.1  # tolerance for positions, as a share of a cell, as 32-bit numbers are rounded


def read(file: Path, choice: Choice) -> Generator[Layer]:
    """Yields a layer for each time of a variable. The file is closed after the last layer."""
    xarray, _ = library("xarray", file), library("netCDF4", file)
    options = {"decode_times": False, "decode_coords": "all", "cache": False}
    with warnings.catch_warnings(action="ignore"), TemporaryDirectory() as folder:
        # xarray decodes paths by the locale; this one is plain.
        link = Path(folder, "input.nc")
        link.symlink_to(file.absolute())
        try:
            with closing(xarray.open_datatree(link, engine="netcdf4", **options)) as tree:
                arrays = {
                    f"{group.path}/{name}".lstrip("/"): array
                    for group in tree.subtree
                    for name, array in group.data_vars.items()
                    if array.ndim > 1 and array.dtype.kind in "biufc"
                }
                name = choose_variable(file, list(arrays), choice.variable)
                yield from _layers(file, arrays[name], choice)
        except InvalidArgumentError:
            raise
        except Exception as error:  # netCDF4, xarray and NumPy raise different errors
            words = getattr(error, "strerror", None) or error
            raise InvalidArgumentError(f"{file}: expected a NetCDF file, got: {words}") from None


def _layers(file: Path, array: Any, choice: Choice) -> Iterator[Layer]:
    for name, one in ((name, one) for one in (array, *array.coords.values()) for name in _NOT_READ):
        given = one.encoding | one.attrs
        if name in given:
            raise invalid(f"{file}, {one.name}", f"no {name}", f"'{given[name]}'")
    if array.dtype.kind == "c" or 0 in array.shape:
        raise invalid(file, "real numbers", f"{array.dtype} {array.shape}")
    axes = _axes(file, array)
    place, turned = _place(file, array, axes["Y"], axes["X"])
    times = _times(file, array, axes.get("T"))
    array = array.transpose(*(axes[letter] for letter in "TYX" if letter in axes))
    array = array if array.ndim == 3 else array.expand_dims("layer")
    low, high = _limits(f"{file}, {array.name}", array)
    for band in choose_bands(file, len(array), choice):
        name = f"{file}, band {band}" if len(array) > 1 else str(file)
        time = times[band - 1]._replace(name=name) if times else None
        if time is not None and not math.isfinite(time.value):
            raise invalid(name, "a time", time.value)
        values, cut = window(name, array[band - 1][turned], place, choice)
        values[(values < low) | (values > high)] = np.nan
        yield Layer(
            name=name,
            values=values,
            place=cut,
            clock=_clock(array),
            stored=array.encoding["dtype"],
            time=time,
        )


def _limits(name: str, array: Any) -> tuple[float, float]:
    """Returns the smallest and largest valid number; packed ones have the type of the file."""
    given, packing = array.attrs, array.encoding
    limits = given.get("valid_min", -np.inf), given.get("valid_max", np.inf)
    limits = given.get("valid_range", limits)
    if np.size(limits) != 2:
        raise invalid(f"{name}, valid_range", "two numbers", limits)
    scale, offset = packing.get("scale_factor", 1.0), packing.get("add_offset", 0.0)
    low, high = (
        float(limit * scale + offset if np.asarray(limit).dtype == packing["dtype"] else limit)
        for limit in limits
    )
    slack = abs(scale) / 10 if array.dtype != packing["dtype"] else 0.0  # unpacked with rounding
    return low - slack, high + slack


def _axes(file: Path, array: Any) -> dict[str, str]:
    """Returns the dimensions of columns (X), rows (Y) and, if there is one, time (T)."""
    letters = list[str]()
    for name in array.dims:
        stated = [_stated(file, one) for one in _along(array, name)]
        by_name = [letter for letter, words in _WORDS.items() if name.lower() in words]
        letters.append(next(filter(None, [*stated, *by_name]), ""))
    for letter in "XY":  # by default, the last dimensions are rows and columns
        if letter not in letters and "" in letters:
            letters[len(letters) - 1 - letters[::-1].index("")] = letter
    if sorted(letters) not in (["X", "Y"], ["T", "X", "Y"]):
        pairs = list(zip(letters, array.dims, strict=True))
        wrong = [name for letter, name in pairs if letter in ("", "Z") or letters.count(letter) > 1]
        got = f"one with {', '.join(wrong or array.dims)}"
        raise invalid(file, "a variable with the dimensions time, rows and columns", got)
    return dict(zip(letters, array.dims, strict=True))


def _along(array: Any, dimension: str) -> list[Any]:
    """Returns the coordinates along a dimension, starting with the one of its name."""
    along = [one for one in array.coords.values() if one.dims == (dimension,)]
    return sorted(along, key=lambda one: one.name != dimension)


def _stated(file: Path, one: Any) -> str:
    """Returns the axis (X, Y, Z or T) that a coordinate's attributes state; empty if none."""
    told = {str(one.attrs.get(key, "")).lower() for key in ("axis", "standard_name", "units")}
    said = [letter for letter, words in _WORDS.items() if words & told]
    if len(said) > 1:
        raise invalid(f"{file}, {one.name}", "one axis", " and ".join(said))
    is_time = _clock(one).unit() is not None or "%Y" in _clock(one).words
    return said[0] if said else "T" if is_time else ""


def _place(file: Path, array: Any, rows: str, columns: str) -> tuple[Place, tuple[slice, slice]]:
    """Returns the grid of a variable, and slices that put the north-west cell first."""
    shape = array.sizes[rows], array.sizes[columns]
    x, y = (next(iter(_along(array, name)), None) for name in (columns, rows))
    for one in array.coords.values() if x is None or y is None else ():
        if {rows, columns} <= {*one.dims} and _stated(file, one) in ("X", "Y"):
            got = f"{one.name} with {', '.join(one.dims)}; reproject it"
            raise invalid(file, "coordinates with one dimension", got)
    (west, width), (south, height) = (
        (0.0, 1.0) if one is None else _line(file, one) for one in (x, y)
    )
    turned = slice(None, None, 1 if height < 0 else -1), slice(None, None, -1 if width < 0 else 1)
    if x is None or y is None:
        return Place(shape=shape), turned
    units = [unit for unit in (_unit(file, array, one) for one in (x, y)) if unit]
    length, is_angle = units[0] if units else (1.0, False)
    projection = _projection(file, array, is_angle=is_angle)
    known = (unit_of(projection) if projection else None) or (1.0, is_angle)
    if any(unit[1] != known[1] for unit in units):
        expected, got = ("degrees", "metres") if known[1] else ("metres", "degrees")
        raise invalid(file, f"coordinates in {expected}, as its grid mapping or columns", got)
    share = length / known[0] if units else 1.0
    west = (round(west + 180, 9) % 360) - 180 if is_angle else west
    width, height = abs(width) or abs(height) or 1.0, abs(height) or abs(width) or 1.0
    place = Place(
        shape=shape,
        corner=((west - width / 2) * share, (south + (shape[0] - 0.5) * height) * share),
        cell=(width * share, height * share),
        projection=projection,
        metres=1.0 if units and not is_angle else None,
    )
    return place, turned


@np.errstate(over="ignore", invalid="ignore")
def _line(file: Path, one: Any) -> tuple[float, float]:
    """Returns the smallest coordinate, and the distance between two, below 0 if they decrease."""
    at: NDArray[np.float64] = one.values.astype(np.float64)
    if str(one.attrs.get("units", "")).lower() in _WORDS["X"]:  # degrees east
        at = np.unwrap(at, period=360)
    step = float(at[-1] - at[0]) / max(1, at.size - 1)
    errors = at - at[0] - step * np.arange(at.size)
    if (at.size > 1 and step == 0) or not np.abs(errors).max() <= _EVEN * abs(step):
        sizes = np.abs(np.diff(at))
        got = f"some of {sizes.min():.6g} and some of {sizes.max():.6g}" if sizes.size else at[0]
        raise invalid(f"{file}, {one.name}", "cells of one size side by side", got)
    return float(min(at[0], at[-1])), step


def _unit(file: Path, array: Any, one: Any) -> tuple[float, bool] | None:
    """Returns a unit's length in metres or radians, and whether it is an angle."""
    unit, name = (str(one.attrs.get(key, "")).strip().lower() for key in ("units", "standard_name"))
    if unit.startswith("degree") or (not unit and "itude" in name):
        return _DEGREES
    if unit in ("rad", "radian", "radians"):  # of a geostationary satellite
        mapping = array.coords.get(array.encoding.get("grid_mapping"))
        return float(mapping.attrs["perspective_point_height"]), False
    if unit in ("", "1") and one.name.lower() not in _ANGLES:
        return None
    known = unit_named(unit)
    if known is None:
        raise invalid(f"{file}, {one.name}, units", "degrees, m, km or feet", f"'{unit}'")
    return METRES[known], False


def _projection(file: Path, array: Any, *, is_angle: bool) -> str | None:
    """Returns the projection as well-known text; degrees without one refer to WGS 84."""
    name = array.encoding.get("grid_mapping", "")
    if ":" in name:
        raise invalid(file, "one grid mapping", f"'{name}'")
    if name not in array.coords:
        return library("pyproj", file).CRS("EPSG:4326").to_wkt() if is_angle else None
    try:
        return library("pyproj", file).CRS.from_cf(array.coords[name].attrs).to_wkt()
    except Exception as error:  # pyproj may raise any error for unexpected attributes
        raise invalid(f"{file}, {name}", "a grid mapping of CF", error) from None


def _times(file: Path, array: Any, dimension: str | None) -> list[Time]:
    """Returns the times of the layers, along a dimension or of one layer; empty if there are none.

    A scalar may also be another time, such as a reference time. Numbers such as 20200831.5 become
    seconds.
    """
    found = _along(array, dimension) if dimension else []
    for one in array.coords.values() if dimension is None else ():
        is_time = one.ndim == 0 and one.attrs.get("standard_name", "time") == "time"
        found += [one] if is_time and _stated(file, one) == "T" else []
    if not found:
        return []
    time = found[0]
    numbers, clock = np.atleast_1d(time.values).astype(np.float64), _clock(time)
    kind = np.dtype(time.encoding["dtype"])
    gap = float(np.spacing(np.nanmax(np.abs(numbers)).astype(kind))) if kind.kind == "f" else 0.0
    if re.fullmatch(r"days? as %Y%m%d(\.%f)?", clock.words):
        numbers, gap = _seconds(f"{file}, {time.name}", numbers), gap * SECONDS["d"]
        clock = Clock(SINCE_1970)
    return [Time(str(file), number, clock, gap) for number in numbers.tolist()]


def _seconds(name: str, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    try:
        days = [datetime.strptime(f"{int(n)}", "%Y%m%d").replace(tzinfo=UTC) for n in numbers]
    except ValueError as error:
        raise invalid(name, "days as %Y%m%d.%f", error) from None
    return np.array([day.timestamp() for day in days]) + numbers % 1 * SECONDS["d"]


def _clock(one: Any) -> Clock:
    calendar = str(one.attrs.get("calendar", "standard")).lower()
    is_standard = calendar in ("gregorian", "proleptic_gregorian")  # they agree since 1583
    return Clock(str(one.attrs.get("units", "")), "standard" if is_standard else calendar)
