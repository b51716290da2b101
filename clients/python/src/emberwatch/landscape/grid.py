"""Grids on the ground: checks that layers have one grid, and resampling to the world's grid."""

import math
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from emberwatch._native import MAX_SIDE
from emberwatch.errors import invalid
from emberwatch.landscape.ground import Ground, is_same, unit_cell

LIKE: Final = 1e-3
"""Tolerance between the positions of two grids, as a share of a cell."""

Rule = Literal["earliest", "nearest"]

_SQUARE: Final = 0.02  # relative tolerance between lengths, such as the sides of a square cell


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """The grid of a file on the ground."""

    shape: tuple[int, int]
    """Rows and columns."""
    corner: tuple[float, float] | None = None
    """x and y of the north-west corner; None if unknown."""
    cell: tuple[float, float] = (1.0, 1.0)
    """Width and height of a cell, in units of x and y."""
    projection: str | None = None
    """Coordinate reference system as well-known text."""
    metres: float | None = None
    """Length of a unit of x and y in metres, if there is no projection; None if unknown."""

    def ground(self, down: float = 0.5, right: float = 0.5) -> Ground | None:
        """Returns a cell's size on the ground; None if it is unknown.

        `down` and `right` choose the cell: 0 is the first row or column, 1 the last.
        """
        (rows, columns), (width, height) = self.shape, self.cell
        if self.corner is None or (self.projection is None and self.metres is None):
            return None
        unit = Ground(self.metres or 1.0, self.metres or 1.0)
        if self.projection is not None:
            x = self.corner[0] + width * (0.5 + right * (columns - 1))
            y = self.corner[1] - height * (0.5 + down * (rows - 1))
            unit = unit_cell(self.projection, x, y)
        return unit and unit._replace(width=width * unit.width, height=height * unit.height)

    def sides(self) -> tuple[float, float]:
        """Returns width and height of the middle cell, on the ground if that is known."""
        ground = self.ground()
        return self.cell if ground is None else (ground.width, ground.height)

    def could_be_in_degrees(self) -> bool:
        """Returns whether the unit of x and y is unknown, and all coordinates could be degrees."""
        if self.corner is None or (self.projection, self.metres) != (None, None):
            return False
        west, south, east, north = _extent(self)
        # Edges may be half a cell beyond the poles.
        return west >= -181 and east <= 361 and south >= -91 and north <= 91


def check_same(place: Place, name: str, first: Place, first_name: str) -> None:
    """Refuses a layer whose grid differs from the first layer's; NumPy files have no positions."""
    if place.shape != first.shape:
        raise invalid(name, f"{_size(first)} cells as in {first_name}", _size(place))
    if place.corner is None or first.corner is None:
        return
    if not is_same(place.projection, first.projection):
        expected = f"the projection of {first_name}, {_projection(first)}"
        raise invalid(name, expected, _projection(place))
    apart = np.subtract(_extent(place), _extent(first))
    if (np.abs(apart) > LIKE * first.cell[0]).any():
        raise invalid(name, f"the extent of {first_name}, {_extent(first)}", _extent(place))


def check_square(place: Place, name: str) -> None:
    """Refuses a layer whose cells are not square on the ground."""
    ground = place.ground() or Ground(*place.cell)
    unit = "" if place.ground() is None else " metres on the ground"
    got = f"{ground.width:.6g} x {ground.height:.6g}{unit}"
    if abs(math.cos(math.radians(ground.angle))) > _SQUARE:
        got = f"rows and columns at {ground.angle:.0f} degrees"
    elif abs(ground.width / ground.height - 1) <= _SQUARE:
        return
    remedy = "reproject it (gdalwarp -t_srs), or treat them as squares with --oblong"
    raise invalid(name, "square cells", f"{got}; {remedy}")


def check_even(place: Place, name: str) -> None:
    """Refuses a layer whose cells differ in size on the ground between the middle and the edges."""
    middle = place.ground()
    if middle is None:
        return
    shares = (0.0, 0.5, 1.0)
    found = [place.ground(down, right) or middle for down in shares for right in shares]
    sides = np.array([(one.width, one.height) for one in found])
    if (np.abs(sides / (middle.width, middle.height) - 1) > _SQUARE).any():
        got = f"{sides.min():.6g} to {sides.max():.6g} metres; reproject it (gdalwarp -t_srs), use"
        remedy = "a part (gdal_translate -srcwin), or treat all like the middle one with --oblong"
        raise invalid(name, "cells of one size on the ground", f"{got} {remedy}")


def check_unit(place: Place, subject: str, remedy: str) -> None:
    """Refuses cells of unknown size; assumes metres if coordinates cannot be degrees."""
    got = _projection(place)
    if place.could_be_in_degrees():
        got = "no projection, and coordinates that may be degrees"
    elif place.corner is not None and (place.projection is None or place.ground() is not None):
        return
    expected = "cells in metres, or a projection that gives their size"
    raise invalid(subject, expected, f"{got}; {remedy}")


def check_alike(place: Place, name: str, first: Place, *, mixed: bool) -> None:
    """Refuses a sequence whose grid differs from the first sequence's.

    `mixed` allows cells of another size or projection.
    """
    if place.shape != first.shape:
        got = f"{_size(place)}; use --height and --width"
        raise invalid(name, f"{_size(first)} cells as in the first sequence", got)
    if mixed:
        return
    has_place = place.corner is not None
    if not is_same(place.projection, first.projection) or has_place != (first.corner is not None):
        expected = f"the projection of the first sequence, {_projection(first)}"
        raise invalid(name, expected, f"{_projection(place)}; --mixed allows both")
    sides = np.array([place.sides(), first.sides()])
    if has_place and (np.abs(sides[0] / sides[1] - 1) > _SQUARE).any():
        got, of_first = (f"{width:.6g} x {height:.6g}" for width, height in sides)
        remedy = "use --cell or --crop, or allow both with --mixed"
        expected = f"cells of {of_first} on the ground as in the first sequence"
        raise invalid(name, expected, f"{got}; {remedy}")


def of_world(place: Place, shape: tuple[int, int]) -> Place:
    """Returns the grid of the world that an input is resampled to."""
    width = place.cell[0] * place.shape[1] / shape[1]
    height = place.cell[1] * place.shape[0] / shape[0]
    return replace(place, shape=shape, cell=(width, height))


def crop(place: Place, wanted: tuple[int, ...] | None) -> tuple[tuple[slice, slice], Place]:
    """Returns the rows and columns of a `--crop` window, and their grid; None: all."""
    (height, width), corner = place.shape, place.corner
    top, left, rows, columns = wanted or (0, 0, height, width)
    if min(rows, columns) < 1 or top + rows > height or left + columns > width:
        expected = f"TOP,LEFT,HEIGHT,WIDTH within {height} x {width} cells"
        raise invalid("--crop", expected, f"{top},{left},{rows},{columns}")
    if corner is not None:
        corner = corner[0] + place.cell[0] * left, corner[1] - place.cell[1] * top
    cut = replace(place, shape=(rows, columns), corner=corner)
    return (slice(top, top + rows), slice(left, left + columns)), cut


def target_shape(
    place: Place, *, height: int | None, width: int | None, cell: float | None
) -> tuple[int, int]:
    """Computes rows and columns of the world from the flags."""
    rows, columns = place.shape
    if cell is not None:
        check_unit(place, "--cell", "use --height")
        share = place.sides()[1] / cell
        height, width = max(1, round(rows * share)), max(1, round(columns * share))
    elif height or width:
        height = height or max(1, round(rows * (width or 1) / columns))
        width = width or max(1, round(columns * height / rows))
    height, width = height or rows, width or columns
    if max(height, width) > MAX_SIDE:
        got = f"{height} x {width}; use --height, --width, --cell or --crop"
        raise invalid("grid", f"at most {MAX_SIDE} x {MAX_SIDE} cells, the server's maximum", got)
    if not 1 - _SQUARE <= (columns / width) / (rows / height) <= 1 + _SQUARE:
        got = f"{height} x {width}; use --crop or another size"
        raise invalid("grid", f"the proportions of {rows} x {columns} cells", got)
    return height, width


def resampled(
    times: NDArray[np.floating[Any]], shape: tuple[int, int], rule: Rule, *, latest: bool = False
) -> NDArray[np.floating[Any]]:
    """Resamples times to larger or smaller cells.

    With `"nearest"`, a cell gets the time of the input cell in its middle. With `"earliest"`, it
    gets the smallest time of all input cells that it overlaps (with `latest`, the largest).
    """
    for axis, new in enumerate(shape):
        old = len(times) if axis == 0 else times[0].size
        if old == new:
            continue
        if rule == "nearest":
            at = ((np.arange(new) + 0.5) * old / new).astype(np.intp)
            times = times.take(at, axis=axis)
        else:
            reduce = np.max if latest else np.min
            # Computed in integers, so that rounding does not make touching cells overlap.
            edges = [(i * old // new, -(-(i + 1) * old // new)) for i in range(new)]
            parts = [
                reduce(times[(slice(None),) * axis + (slice(*edge),)], axis=axis) for edge in edges
            ]
            times = np.stack(parts, axis=axis)
    return times


def _extent(place: Place) -> tuple[float, float, float, float]:
    """Returns the left, bottom, right and top coordinates."""
    (x, y), (width, height) = place.corner or (0.0, 0.0), place.cell
    rows, columns = place.shape
    return x, y - height * rows, x + width * columns, y


def _size(place: Place) -> str:
    return f"{place.shape[0]} x {place.shape[1]}"


def _projection(place: Place) -> str:
    if place.projection is None:
        return "none" if place.corner is not None else "no place on the ground"
    quoted = place.projection.split('"')
    return quoted[1] if len(quoted) > 1 else place.projection
