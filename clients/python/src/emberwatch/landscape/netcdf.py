"""Reader of NetCDF files.

This module, `axes` and `packing` apply the CF conventions to a variable and its coordinates.
Attributes that are not supported are refused by name.
"""

import math
import os
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.axes import Axis, auxiliary, axes_of, find, letter_of, line
from emberwatch.landscape.grid import Place
from emberwatch.landscape.ground import unit_of
from emberwatch.landscape.layers import Choice, Layer, check_cells, choose_bands, choose_variable
from emberwatch.landscape.libraries import library
from emberwatch.landscape.packing import Attributes, attributes, unpacked
from emberwatch.landscape.schedule import Clock, Time

#: Attributes that name auxiliary variables.
_ABOUT: Final = ("bounds", "cell_measures", "climatology", "coordinates", "grid_mapping")
#: Attributes that are not supported, as they change the meaning of dimensions or times.
_NOT_READ: Final = ("climatology", "compress", "coordinate_interpolation")


def read(file: Path, choice: Choice) -> Generator[Layer]:
    """Yields a layer for each time of a variable. The file is closed after the last layer."""
    netcdf4 = library("netCDF4", file)
    # Latin-1 keeps all bytes of the path in any locale.
    path = os.fsencode(file.absolute()).decode("latin-1")
    try:
        with netcdf4.Dataset(path, encoding="latin-1") as dataset:
            variables: dict[str, Any] = {
                f"{variable.group().path}/{variable.name}".lstrip("/"): variable
                for variable in _variables(dataset)
            }
            name = choose_variable(file, list(variables), choice.variable)
            yield from _layers(file, variables[name], choice)
    except InvalidArgumentError:
        raise
    except Exception as error:  # netCDF4 and NumPy raise different errors for damaged bytes
        words = getattr(error, "strerror", None) or error
        raise InvalidArgumentError(f"{file}: expected a NetCDF file, got: {words}") from None


def _variables(dataset: Any) -> list[Any]:
    """Returns the numeric variables with rows and columns, without auxiliary variables."""
    dataset.set_auto_maskandscale(False)
    every = list(_all(dataset))
    tables = [attributes(variable) for variable in every]
    words = " ".join(str(given.get(key, "")) for given in tables for key in _ABOUT)
    about = {word.rpartition("/")[2] for word in words.replace(": ", " ").split()}
    return [
        variable
        for variable in every
        if variable.ndim > 1
        and getattr(variable.dtype, "kind", "") in "iufcV"
        and variable.name not in about
    ]


def _all(group: Any) -> Iterator[Any]:
    yield from group.variables.values()
    for inner in group.groups.values():
        yield from _all(inner)


def _layers(file: Path, variable: Any, choice: Choice) -> Iterator[Layer]:
    given, axes = attributes(variable), axes_of(file, variable)
    _check_attributes(file, variable, *(axis.coordinate for axis in axes.values()))
    rows, columns, time = axes["Y"].position, axes["X"].position, axes.get("T")
    place, turned = _place(file, variable, axes)
    times, time_clock = _times(file, variable, time)
    n_layers = 1 if time is None else variable.shape[time.position]
    for band in choose_bands(file, n_layers, choice):
        name = f"{file}, band {band}" if n_layers > 1 else str(file)
        if times is not None and not math.isfinite(times[band - 1]):
            raise invalid(name, "a time", times[band - 1])
        where: list[Any] = [slice(None)] * variable.ndim
        if time is not None:
            where[time.position] = band - 1
        values = unpacked(name, variable[tuple(where)], given, choice.nodata)
        yield Layer(
            name=name,
            values=(values if rows < columns else values.T)[turned].copy(),
            place=place,
            clock=_clock(given),
            flags=_flags(given),
            time=None if times is None else Time(float(times[band - 1]), time_clock),
        )


def _flags(given: Attributes) -> tuple[tuple[float, str], ...]:
    numbers = np.atleast_1d(given.get("flag_values", given.get("flag_masks", ())))
    return tuple(zip(numbers.tolist(), str(given.get("flag_meanings", "")).split(), strict=False))


def _check_attributes(file: Path, *variables: Any) -> None:
    for variable in variables:
        for name in _NOT_READ:
            if variable is not None and name in variable.ncattrs():
                got = f"'{variable.getncattr(name)}'"
                raise invalid(f"{file}, {variable.name}", f"no {name}", got)


def _place(file: Path, variable: Any, axes: dict[str, Axis]) -> tuple[Place, tuple[slice, slice]]:
    """Returns the grid of a variable, and slices that put the north-west cell first."""
    shape = variable.shape[axes["Y"].position], variable.shape[axes["X"].position]
    check_cells(file, *shape)
    if 0 in variable.shape:
        raise invalid(file, "cells", " x ".join(map(str, variable.shape)))
    mapping = _mapping(variable, getattr(axes["X"].coordinate, "name", ""))
    x, y = line(file, axes["X"], mapping), line(file, axes["Y"], mapping)
    turned = (
        slice(None, None, 1 if y is not None and y.is_falling else -1),
        slice(None, None, -1 if x is not None and x.is_falling else 1),
    )
    if x is None or y is None:
        _check_straight(file, variable, axes)
        return Place(shape=shape), turned
    is_in_degrees, unit = x.unit == "degrees", x.unit or y.unit
    if is_in_degrees != (y.unit == "degrees"):
        raise invalid(file, "rows and columns in one unit", "degrees and metres")
    projection = _projection(file, mapping, is_in_degrees=is_in_degrees)
    share = _share(file, projection, unit)
    width, height = x.cell or y.cell or 1.0, y.cell or x.cell or 1.0
    west = (round(x.low + 180, 9) % 360) - 180 if is_in_degrees else x.low
    place = Place(
        shape=shape,
        corner=(west * share, (y.low + shape[0] * height) * share),
        cell=(width * share, height * share),
        projection=projection,
        metres=1.0 if unit == "m" else None,
    )
    return place, turned


def _check_straight(file: Path, variable: Any, axes: dict[str, Axis]) -> None:
    """Refuses rows and columns with two-dimensional coordinates, which are curves on the ground."""
    sides = {axes["X"].name, axes["Y"].name}
    for found in auxiliary(variable):
        if sides <= {*found.dimensions} and letter_of(file, found) in ("X", "Y"):
            raise invalid(
                file,
                "coordinates with one dimension",
                f"{found.name} with {', '.join(found.dimensions)}; reproject it",
            )


def _mapping(variable: Any, column: str) -> Attributes:
    """Returns the attributes of the grid mapping; if there are several, of the columns' mapping."""
    words = str(attributes(variable).get("grid_mapping", "")).split()
    name = named = ""
    for word in words:
        if word.endswith(":"):
            named = word[:-1]
        elif word == column or len(words) == 1:
            name = named or word
    found = find(variable.group(), name) if name else None
    return {} if found is None else attributes(found)


def _projection(file: Path, mapping: Attributes, *, is_in_degrees: bool) -> str | None:
    """Returns the projection as well-known text.

    A grid mapping that pyproj does not know becomes a list of its attributes, for comparisons only.
    """
    pyproj = library("pyproj", file)
    text = mapping.get("crs_wkt") or mapping.get("spatial_ref")
    if text:
        return str(text)
    if not mapping:
        return pyproj.CRS("EPSG:4326").to_wkt() if is_in_degrees else None
    name = mapping.get("grid_mapping_name", "grid mapping")
    try:
        return pyproj.CRS.from_cf({"projected_crs_name": name} | dict(mapping)).to_wkt()
    except Exception:  # pyproj may raise any error for unexpected attributes
        words = ", ".join(f"{key} {value}" for key, value in sorted(mapping.items()))
        return f'"{name}" {words}'


def _share(file: Path, projection: str | None, unit: str) -> float:
    """Returns the factor that converts metres or degrees to the unit of the projection."""
    known = None if projection is None else unit_of(projection)
    if known is None or not unit:
        return 1.0
    length, is_angle = known
    if is_angle != (unit == "degrees"):
        words = ("metres", "degrees") if is_angle else ("degrees", "metres")
        raise invalid(file, f"coordinates in {words[1]}, the unit of its grid mapping", words[0])
    return (math.radians(1.0) if is_angle else 1.0) / length


def _times(
    file: Path, variable: Any, time: Axis | None
) -> tuple[NDArray[np.float64] | None, Clock]:
    """Returns the times of the layers and their clock, from a dimension or a scalar coordinate.

    The times are None if the file has none.
    """
    if time is not None:
        found = time.coordinate
    else:
        scalars = [found for found in auxiliary(variable) if not found.dimensions]
        found = next((found for found in scalars if _is_time(file, found)), None)
    if found is None:
        return None, Clock()
    given = attributes(found)
    return unpacked(f"{file}, {found.name}", np.atleast_1d(found[...]), given), _clock(given)


def _is_time(file: Path, scalar: Any) -> bool:
    """Returns whether a scalar is the time of the layer, not, for example, a reference time."""
    standard_name = attributes(scalar).get("standard_name", "time")
    return standard_name == "time" and letter_of(file, scalar) == "T"


def _clock(given: Attributes) -> Clock:
    return Clock(str(given.get("units", "")), str(given.get("calendar", "standard")))
