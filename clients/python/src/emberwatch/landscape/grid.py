"""Grids on the ground: their size, whether layers have one grid, and resampling to larger cells."""

from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch._native import MAX_SIDE
from emberwatch.errors import invalid

LIKE: Final = 1e-3
"""Tolerance between the positions of two grids, as a share of a cell."""

_SQUARE: Final = 0.02  # relative tolerance between lengths, such as the sides of a square cell
#: Maps whose lengths differ from the ground by a smaller share, as in UTM zones and State Planes,
#: count as exact, so that cells of 30 m stay cells of 30 m.
_EXACT: Final = 2e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """The grid of a file on the ground."""

    shape: tuple[int, int]  # rows and columns
    corner: tuple[float, float] | None = None  # x and y of the north-west corner, if known
    cell: tuple[float, float] = (1.0, 1.0)  # width and height, in units of x and y
    crs: Any = None  # a `pyproj.CRS`; None if unknown

    def ground(self) -> tuple[float, float] | None:
        """Returns width and height of the middle cell in metres; None if these are unknown.

        A metre on the map is seldom a metre on the ground: in Mercator projections at 60 degrees
        north it is half a metre.
        """
        if self.corner is None or self.crs is None or self.crs.geodetic_crs is None:
            return None
        (rows, columns), (width, height) = self.shape, self.cell
        x, y = self.corner[0] + columns * width / 2, self.corner[1] - rows * height / 2
        edges = [x - width / 2, x + width / 2, x, x], [y, y, y - height / 2, y + height / 2]
        transformer = import_module("pyproj").Transformer
        to_degrees = transformer.from_crs(self.crs, self.crs.geodetic_crs, always_xy=True)
        lon, lat = np.array(to_degrees.transform(*edges))
        # Two lines on the ellipsoid, along the cell's row and along its column.
        _, _, sides = self.crs.get_geod().inv(lon[::2], lat[::2], lon[1::2], lat[1::2])
        if not np.isfinite(sides).all():
            raise invalid(f"projection {self.crs.name}", "cells on the Earth", f"{x:g}, {y:g}")
        on_map = np.array(self.cell) * self.crs.axis_info[0].unit_conversion_factor
        is_exact = self.crs.is_projected and (np.abs(sides / on_map - 1) < _EXACT).all()
        width, height = (on_map if is_exact else sides).tolist()
        return width, height


def check_same(place: Place, name: str, first: Place, first_name: str) -> None:
    """Refuses a layer whose grid differs from the first layer's; NumPy files have no positions."""
    if place.shape != first.shape:
        raise invalid(name, f"{_size(first)} cells as in {first_name}", _size(place))
    if place.corner is None or first.corner is None:
        return
    crs, other = place.crs, first.crs
    if crs != other and not (crs and other and crs.equals(other, ignore_axis_order=True)):
        expected, got = (one.name if one else "none" for one in (other, crs))
        raise invalid(name, f"the projection of {first_name}, {expected}", got)
    apart = np.subtract(_extent(place), _extent(first))
    if (np.abs(apart) > LIKE * first.cell[0]).any():
        raise invalid(name, f"the extent of {first_name}, {_extent(first)}", _extent(place))


def check_square(place: Place, name: str) -> None:
    """Refuses a layer whose cells are not square on the ground."""
    width, height = place.ground() or place.cell
    if abs(width / height - 1) > _SQUARE:
        unit = "" if place.ground() is None else " metres on the ground"
        remedy = "reproject it (gdalwarp -t_srs), or treat them as squares with --oblong"
        raise invalid(name, "square cells", f"{width:.6g} x {height:.6g}{unit}; {remedy}")


def target_shape(place: Place, *, height: int | None, cell: float | None) -> tuple[int, int]:
    """Computes rows and columns of the world from the flags."""
    rows, columns = place.shape
    if cell is not None:
        ground = place.ground()
        if ground is None:
            expected = "input with a projection, which gives the size of its cells"
            raise invalid("--cell", expected, "none; use --height, or gdal_edit.py -a_srs")
        share = ground[1] / cell
    else:
        share = (height or rows) / rows
    height, width = max(1, round(rows * share)), max(1, round(columns * share))
    if max(height, width) > MAX_SIDE:
        got = f"{height} x {width}; use --height, --cell or a part of the input"
        raise invalid("grid", f"at most {MAX_SIDE} x {MAX_SIDE} cells, the server's maximum", got)
    if abs((columns / width) / (rows / height) - 1) > _SQUARE:
        got = f"{height} x {width}; use a part of the input or another size"
        raise invalid("grid", f"the proportions of {rows} x {columns} cells", got)
    return height, width


def resampled(
    times: NDArray[np.floating[Any]], shape: tuple[int, int], *, latest: bool = False
) -> NDArray[np.floating[Any]]:
    """Resamples times to larger or smaller cells.

    A cell gets the smallest time of all input cells that it overlaps (with `latest`, the largest).
    """
    reduce = np.max if latest else np.min
    for axis, new in enumerate(shape):
        old = times.shape[axis]
        # Computed in integers, so that rounding does not make touching cells overlap.
        edges = [range(i * old // new, -(-(i + 1) * old // new)) for i in range(new)]
        times = np.stack([reduce(times.take(edge, axis), axis) for edge in edges], axis)
    return times


def _extent(place: Place) -> tuple[float, float, float, float]:
    """Returns the left, bottom, right and top coordinates."""
    (x, y), (width, height) = place.corner or (0.0, 0.0), place.cell
    rows, columns = place.shape
    return x, y - height * rows, x + width * columns, y


def _size(place: Place) -> str:
    return f"{place.shape[0]} x {place.shape[1]}"
