"""Where cells are: what layers must have in common, and how they become the wanted grid."""

import math
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid

MAX_SIDE: Final = 4096
"""Most rows, and most columns, that the server takes."""
LIKE: Final = 1e-3
"""Share of a cell by which places may differ."""

Rule = Literal["earliest", "nearest"]

_SQUARE: Final = 0.02  # by how much the sides of a square cell may differ


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """The grid of a file on the ground."""

    shape: tuple[int, int]
    """Rows and columns."""
    corner: tuple[float, float] | None = None
    """x and y of the north-west corner; None if the file does not say."""
    cell: tuple[float, float] = (1.0, 1.0)
    """Width and height of a cell."""
    projection: str | None = None
    """As well-known text."""
    is_in_degrees: bool = False
    metres: float = 1.0
    """Length of a unit of x and y; cells without a projection count in metres."""

    def sides(self) -> tuple[float, float]:
        """Width and height of a cell in one unit, in the middle of the grid."""
        width, height = self.cell
        if self.is_in_degrees and self.corner is not None:
            middle = self.corner[1] - height * self.shape[0] / 2
            width *= math.cos(math.radians(middle))
        return width, height


def check_same(place: Place, name: str, first: Place, first_name: str) -> None:
    """Refuses a layer whose cells are not those of the first."""
    if place.projection != first.projection:
        raise invalid(
            name, f"the projection of {first_name}, {_projection(first)}", _projection(place)
        )
    if place.shape != first.shape:
        raise invalid(name, f"{_size(first)} cells as in {first_name}", _size(place))
    apart = np.subtract(_extent(place), _extent(first))
    if (np.abs(apart) > LIKE * first.cell[0]).any():
        raise invalid(name, f"the extent of {first_name}, {_extent(first)}", _extent(place))


def check_square(place: Place, name: str) -> None:
    """Refuses a layer whose cells are not square on the ground."""
    width, height = place.sides()
    if not (1 - _SQUARE) * height <= width <= (1 + _SQUARE) * height:
        unit = " degrees of latitude" if place.is_in_degrees else ""
        raise InvalidArgumentError(
            f"{name}: expected square cells, got {width:.6g} x {height:.6g}{unit}; reproject it "
            "(gdalwarp), or take them as squares with --oblong"
        )


def check_alike(place: Place, name: str, first: Place, *, mixed: bool) -> None:
    """Refuses a sequence whose world has another grid than the first one's.

    `mixed` allows cells of another size or projection.
    """
    if place.shape != first.shape:
        raise InvalidArgumentError(
            f"{name}: expected {_size(first)} cells as the first sequence, got {_size(place)}; "
            "use --height and --width"
        )
    if mixed:
        return
    if (place.projection, place.corner is None) != (first.projection, first.corner is None):
        raise InvalidArgumentError(
            f"{name}: expected the projection of the first sequence, {_projection(first)}, got "
            f"{_projection(place)}; --mixed takes both"
        )
    sides = np.array([place.sides(), first.sides()])
    if place.corner is not None and (np.abs(sides[0] / sides[1] - 1) > _SQUARE).any():
        of_first, got = (f"{width:.6g} x {height:.6g}" for width, height in sides[::-1])
        raise InvalidArgumentError(
            f"{name}: expected cells of {of_first} on the ground as in the first sequence, got "
            f"{got}; use --cell or --crop, or take both with --mixed"
        )


def of_world(place: Place, shape: tuple[int, int]) -> Place:
    """The grid that an input becomes."""
    width = place.cell[0] * place.shape[1] / shape[1]
    height = place.cell[1] * place.shape[0] / shape[0]
    return replace(place, shape=shape, cell=(width, height))


def part(place: Place, window: tuple[slice, slice]) -> Place:
    """The grid of these rows and columns."""
    rows, columns = window
    corner = place.corner and (
        place.corner[0] + place.cell[0] * columns.start,
        place.corner[1] - place.cell[1] * rows.start,
    )
    return replace(
        place, shape=(rows.stop - rows.start, columns.stop - columns.start), corner=corner
    )


def crop(place: Place, wanted: tuple[int, ...] | None) -> tuple[slice, slice]:
    """The rows and columns of the input to use."""
    height, width = place.shape
    if wanted is None:
        return slice(0, height), slice(0, width)
    top, left, rows, columns = wanted
    if (
        min(top, left) < 0
        or min(rows, columns) < 1
        or top + rows > height
        or left + columns > width
    ):
        raise InvalidArgumentError(
            f"--crop: expected TOP,LEFT,HEIGHT,WIDTH within {height} x {width} cells, "
            f"got {','.join(map(str, wanted))}"
        )
    return slice(top, top + rows), slice(left, left + columns)


def target_shape(
    place: Place, *, height: int | None, width: int | None, cell: float | None
) -> tuple[int, int]:
    """Rows and columns of the world."""
    rows, columns = place.shape
    if cell is not None:
        if place.corner is None or place.is_in_degrees:
            raise invalid("--cell", "a grid in metres", f"{_projection(place)}; use --height")
        share = place.sides()[1] * place.metres / cell
        height, width = max(1, round(rows * share)), max(1, round(columns * share))
    elif height is None and width is None:
        height, width = rows, columns
    elif width is None:
        width = max(1, round(columns * (height or 1) / rows))
    elif height is None:
        height = max(1, round(rows * width / columns))
    height, width = height or 1, width or 1
    if max(height, width) > MAX_SIDE:
        raise InvalidArgumentError(
            f"grid: expected at most {MAX_SIDE} x {MAX_SIDE} cells, as the server takes, got "
            f"{height} x {width}; use --height, --width, --cell or --crop"
        )
    if not 1 - _SQUARE <= (columns / width) / (rows / height) <= 1 + _SQUARE:
        raise InvalidArgumentError(
            f"grid: expected the proportions of {rows} x {columns} cells, got {height} x {width}; "
            "use --crop or another size"
        )
    return height, width


def resampled(
    times: NDArray[np.float64], shape: tuple[int, int], rule: Rule, *, latest: bool = False
) -> NDArray[np.float64]:
    """Times of larger or smaller cells.

    `"nearest"` takes the input cell in the middle of each, `"earliest"` the least of all input
    cells that it overlaps (`latest`: the greatest).
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
            # In whole numbers, so that edges that coincide do not overlap by rounding.
            edges = [(i * old // new, -(-(i + 1) * old // new)) for i in range(new)]
            parts = [
                reduce(times[(slice(None),) * axis + (slice(*edge),)], axis=axis) for edge in edges
            ]
            times = np.stack(parts, axis=axis)
    return times


def _extent(place: Place) -> tuple[float, float, float, float]:
    """Left, bottom, right and top."""
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
