"""The size of cells on the ground, from their coordinate reference system (CRS).

A unit of x and y may be a foot or a degree. A metre on the map is seldom a metre on the ground: in
Mercator projections at 60 degrees north it is half a metre. pyproj computes positions and distances
on the ellipsoid.
"""

from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np

from emberwatch.errors import invalid
from emberwatch.landscape.libraries import library

#: Length of the measured lines, as a share of the Earth's radius. They are about 600 m long.
_SHARE: Final = 1e-4
_RADIUS: Final = 6.371e6  # radius of the Earth, metres
#: Maps whose lengths differ from the ground by a smaller share, as in UTM zones and State Planes,
#: count as exact, so that cells of 30 m stay cells of 30 m.
_EXACT: Final = 2e-3


class Ground(NamedTuple):
    """The size and direction of a cell on the ground."""

    width: float
    """Metres."""
    height: float
    """Metres."""
    angle: float = 90.0
    """Degrees between rows and columns."""
    north: float = 0.0
    """Direction of the columns, in degrees clockwise from true north."""


@lru_cache(maxsize=64)
def unit_cell(projection: str, x: float, y: float) -> Ground | None:
    """Measures a cell of one unit of the CRS at x, y; None for a CRS that pyproj does not know."""
    crs = _horizontal(projection)
    if crs is None:
        return None
    base, unit = crs, _factor(crs)
    while base.source_crs is not None:  # latitudes and longitudes
        base = base.source_crs
    if not base.is_geographic:  # an engineering CRS: a plane without a position on the Earth
        return Ground(unit, unit)
    step = _SHARE * (1.0 if crs.is_geographic else _RADIUS) / unit
    ends = x + step * np.array([-0.5, 0.5, 0, 0]), y + step * np.array([0, 0, -0.5, 0.5])
    transformer = library("pyproj", "projection").Transformer.from_crs(crs, base, always_xy=True)
    lon, lat = np.array(transformer.transform(*ends)) * _factor(base)
    if not (np.isfinite(lon).all() and (np.abs(lat) <= np.pi / 2).all()):
        raise invalid(f"projection {crs.name}", "cells on the Earth", f"one at {x:g}, {y:g}")
    # Two geodesics, along a row and along a column.
    azimuths, _, lengths = base.get_geod().inv(
        lon[::2], lat[::2], lon[1::2], lat[1::2], radians=True
    )
    east, north = np.degrees(azimuths).tolist()
    width, height = (np.array(lengths) / step).tolist()
    if max(abs(width / unit - 1), abs(height / unit - 1)) < _EXACT and not crs.is_geographic:
        width = height = unit
    return Ground(width, height, (east - north) % 360, north)


def unit_of(projection: str) -> tuple[float, bool] | None:
    """Returns the length of a unit of x and y, in metres or radians, and whether it is an angle."""
    crs = _horizontal(projection)
    return None if crs is None else (_factor(crs), bool(crs.is_geographic))


def vertical_unit(projection: str) -> tuple[float, str] | None:
    """Returns the length in metres and the name of the unit of height; None without heights."""
    crs = _parsed(projection)
    for axis in () if crs is None else crs.axis_info:
        if axis.direction == "up":
            return axis.unit_conversion_factor, axis.unit_name
    return None


def is_same(projection: str | None, other: str | None) -> bool:
    """Returns whether two texts describe the same horizontal CRS."""
    if projection is None or other is None or projection == other:
        return projection == other
    crs, second = _horizontal(projection), _horizontal(other)
    if crs is None or second is None:
        return False
    return crs.equals(second, ignore_axis_order=True)


@lru_cache(maxsize=64)
def _parsed(projection: str) -> Any | None:
    """Parses well-known text; None if pyproj does not know the CRS."""
    pyproj = library("pyproj", "projection")
    try:
        return pyproj.CRS.from_wkt(projection)
    except pyproj.exceptions.CRSError:
        return None


def _horizontal(projection: str) -> Any | None:
    crs = _parsed(projection)
    while crs is not None and (crs.is_compound or crs.is_bound):
        crs = crs.sub_crs_list[0] if crs.is_compound else crs.source_crs
    return crs


def _factor(crs: Any) -> float:
    return crs.axis_info[0].unit_conversion_factor
