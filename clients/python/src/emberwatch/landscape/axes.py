"""The axes of a NetCDF variable: the meaning of its dimensions, and the positions of cells."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import invalid
from emberwatch.landscape.lengths import METRES, unit_named
from emberwatch.landscape.packing import Attributes, attributes, unpacked
from emberwatch.landscape.schedule import Clock

_STANDARD_NAMES: Final = {
    "X": ("projection_x_coordinate", "longitude", "grid_longitude"),
    "Y": ("projection_y_coordinate", "latitude", "grid_latitude"),
    "T": ("time",),
}
#: Names of dimensions that imply an axis, if their coordinates do not state one.
_NAMES: Final = {
    "X": ("x", "lon", "longitude", "rlon", "easting", "dimx", "west_east"),
    "Y": ("y", "lat", "latitude", "rlat", "northing", "dimy", "south_north"),
    "T": ("time", "t", "dimt", "date", "step", "layer", "band"),
}
_EVEN: Final = 0.1  # tolerance for positions, as a share of a cell, as 32-bit numbers are rounded

#: Names of dimensions and coordinates that are most likely angles, not metres.
_ANGLES: Final = {"lat", "latitude", "rlat", "lon", "longitude", "rlon"}


class Axis(NamedTuple):
    """A dimension of a variable."""

    name: str
    position: int
    letter: str
    """X, Y, Z or T, as in CF; empty if unknown."""
    coordinate: Any | None
    """The coordinate variable; None if there is none."""


class Line(NamedTuple):
    """Cells of one size, side by side along an axis."""

    low: float
    """The smallest coordinate of the cells' edges."""
    cell: float
    """The size of a cell; 0 if unknown."""
    is_falling: bool
    """Whether coordinates decrease along the axis."""
    unit: str
    """`m`, `degrees`, or empty if unknown."""


def axes_of(file: Path, variable: Any) -> dict[str, Axis]:
    """Returns the axes of columns (X), rows (Y) and, if there is one, time (T)."""
    axes = [
        _axis(file, variable, name, position) for position, name in enumerate(variable.dimensions)
    ]
    for letter in "XY":  # by default, the last dimensions are rows and columns
        unknown = [axis for axis in axes if not axis.letter]
        if unknown and all(axis.letter != letter for axis in axes):
            axes[unknown[-1].position] = unknown[-1]._replace(letter=letter)
    letters = [axis.letter for axis in axes]
    if sorted(letters) not in (["X", "Y"], ["T", "X", "Y"]):
        wrong = [a.name for a in axes if a.letter in ("", "Z") or letters.count(a.letter) > 1]
        raise invalid(
            file,
            "a variable with the dimensions time, rows and columns",
            f"one with {', '.join(wrong or variable.dimensions)}",
        )
    return {axis.letter: axis for axis in axes}


@np.errstate(over="ignore", invalid="ignore")
def line(file: Path, axis: Axis, mapping: Attributes) -> Line | None:
    """Returns the positions of the cells along an axis; None if it has no coordinates."""
    if axis.coordinate is None:
        return None
    given, name = attributes(axis.coordinate), f"{file}, {axis.coordinate.name}"
    is_angle = not _ANGLES.isdisjoint((axis.name.lower(), axis.coordinate.name.lower()))
    factor, unit = _unit(name, given, mapping, is_angle=is_angle)
    is_longitude = unit == "degrees" and axis.letter == "X"
    middles, sizes = _cells(file, axis.coordinate, given, is_longitude=is_longitude)
    middles = np.unwrap(middles, period=360) if is_longitude else middles
    n = middles.size
    step = (middles[-1] - middles[0]) / (n - 1) if n > 1 else sizes.sum()
    errors = np.append(middles - middles[0] - step * np.arange(n), sizes - abs(step))
    if (n > 1 and step == 0) or not np.abs(errors).max() <= _EVEN * abs(step):
        sizes = np.abs(np.append(np.diff(middles), sizes))
        got = f"some of {sizes.min():.6g} and some of {sizes.max():.6g}" if n > 1 else middles[0]
        raise invalid(name, "cells of one size side by side", got)
    low = min(middles[0], middles[-1]) - abs(step) / 2
    return Line(low * factor, abs(step) * factor, bool(step < 0), unit)


def auxiliary(variable: Any) -> Iterator[Any]:
    """Yields the existing variables that the attribute `coordinates` names."""
    for name in str(attributes(variable).get("coordinates", "")).split():
        found = find(variable.group(), name)
        if found is not None:
            yield found


def find(group: Any, name: str) -> Any | None:
    """Finds a variable by name in a group or its enclosing groups; None if there is none."""
    while group is not None:
        try:
            found = group[name]
        except LookupError:
            found = None
        if hasattr(found, "dtype"):
            return found
        group = group.parent
    return None


def letter_of(file: Path, coordinate: Any) -> str:
    """Returns the axis (X, Y, Z or T) that a coordinate's attributes state; empty if none."""
    given = attributes(coordinate)
    axis, name, unit = (str(given.get(key, "")) for key in ("axis", "standard_name", "units"))
    degrees = re.fullmatch("degrees?_?(e|n)(ast|orth)?", unit, re.IGNORECASE)
    said = {letter for letter, names in _STANDARD_NAMES.items() if name in names}
    said |= {axis.upper()} if axis else set[str]()
    said |= {{"e": "X", "n": "Y"}[degrees[1].lower()]} if degrees else set[str]()
    if not said and Clock(unit).unit() is not None:
        said = {"T"}
    if len(said) > 1:
        raise invalid(f"{file}, {coordinate.name}", "one axis", " and ".join(sorted(said)))
    return said.pop() if said else ""


def _axis(file: Path, variable: Any, name: str, position: int) -> Axis:
    along = [found for found in auxiliary(variable) if found.dimensions == (name,)]
    own = find(variable.group(), name)
    if own is not None and own.dimensions == (name,):
        along.insert(0, own)
    for coordinate in along:
        letter = letter_of(file, coordinate)
        if letter:
            return Axis(name, position, letter, coordinate)
    by_name = [letter for letter, names in _NAMES.items() if name.lower() in names]
    return Axis(name, position, "".join(by_name), along[0] if along else None)


def _unit(
    name: str, given: Attributes, mapping: Attributes, *, is_angle: bool
) -> tuple[float, str]:
    """Returns the factor that converts coordinates to the unit of a `Line`, and this unit."""
    unit = str(given.get("units", "")).strip().lower()
    is_said = "itude" in str(given.get("standard_name", ""))
    if unit.startswith("degree") or (is_said and not unit):
        return 1.0, "degrees"
    if unit in ("rad", "radian", "radians") and "perspective_point_height" in mapping:
        return float(mapping["perspective_point_height"]), "m"  # of a geostationary satellite
    if unit in ("", "1") and not (is_angle and not unit):
        return 1.0, ""
    known = unit_named(unit)
    if known is None:
        raise invalid(f"{name}, units", "degrees, m, km or feet", f"'{unit}'")
    return METRES[known], "m"


def _cells(
    file: Path, coordinate: Any, given: Attributes, *, is_longitude: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the middles of cells, and their sizes if the file has bounds."""
    if "bounds" not in given:
        return unpacked(f"{file}, {coordinate.name}", coordinate[:], given), np.empty(0)
    bounds = find(coordinate.group(), str(given["bounds"]))
    if bounds is None or bounds.shape != (*coordinate.shape, 2):
        raise invalid(
            f"{file}, {coordinate.name}, bounds", "two for each cell", f"'{given['bounds']}'"
        )
    # Bounds are packed like their coordinate, unless they have another type.
    inherited: Attributes = given if bounds.dtype == coordinate.dtype else {}
    edges = unpacked(f"{file}, {bounds.name}", bounds[:], {**inherited, **attributes(bounds)})
    edges = np.unwrap(edges, period=360) if is_longitude else edges
    return edges.mean(axis=1), np.abs(edges[:, 1] - edges[:, 0])
