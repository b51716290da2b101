"""States of a fire from its layers: unburnt, burning, burnt.

Every kind of input is first converted to two times for each cell, counted in layers or steps: when
the cell begins to burn, and when it is burnt. These times are resampled, and then converted to the
state of each cell in each step.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.grid import (
    Place,
    Rule,
    check_same,
    check_square,
    of_world,
    resampled,
    target_shape,
)
from emberwatch.landscape.layers import Layer, check_full, where
from emberwatch.landscape.schedule import SECONDS, Time, schedule, steps_at, unit_of

UNBURNT, BURNING, BURNT = 0, 1, 2

Kind = Literal["arrival", "mask", "burning", "states"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)

MOST_STATES: Final = 1 << 31  # maximum size of a sequence, bytes
#: Numbers below 0 that files use for "no value", and the number below which all others are, too.
_CODES: Final = (-1, -9, -99, -999, -9999, -99999, -32767, -32768, -2147483647, -2147483648)
_LEAST: Final = -1e18
_LAST_DAY, _HALF_YEAR = 366, 180  # days


class Times(NamedTuple):
    """The times at which each cell of one fire begins to burn, and is burnt, on the world's grid.

    Times are in steps, and infinite if the cell never begins to burn or never is burnt.
    """

    arrival: NDArray[np.float64]
    burnt: NDArray[np.float64]
    n_steps: int
    place: Place
    name: str
    """Name of the first layer, for errors."""
    begin: str | None = None
    """The date of step 0, if the files have it."""
    notes: tuple[str, ...] = ()
    """What was assumed about the input."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Meaning:
    """The interpretation of the numbers in the layers, from the flags (docs/landscapes.md)."""

    kind: Kind
    seconds: float
    """Duration of a step."""
    unit: str | None = None
    begin: float | None = None
    year_days: int | None = None
    burning: int = 1
    every: int = 1
    codes: tuple[float, float, float] = (UNBURNT, BURNING, BURNT)
    oblong: bool = False
    missing_is_unburnt: bool = False
    height: int | None = None
    width: int | None = None
    cell: float | None = None
    """Side of the world's cells in metres, instead of `height` and `width`."""
    resample: Rule = "earliest"


def times(layers: Iterable[Layer], meaning: Meaning) -> Times:
    """Computes the times of one fire from its layers."""
    if meaning.kind == "arrival":
        return _of_arrival(list(layers), meaning)
    return _of_stack(layers, meaning)


def states(fire: Times) -> NDArray[np.uint8]:
    """Computes the states of a fire in each step, shape (K, H, W)."""
    height, width = fire.place.shape
    if fire.n_steps < 2:
        got = f"{fire.n_steps}: all cells that burn begin in it"
        remedy = "use a shorter --step, or merge the files of one fire (ogrmerge.py -single)"
        raise invalid(fire.name, "at least 2 steps", f"{got}; {remedy}")
    if fire.n_steps * height * width > MOST_STATES:
        got = f"{fire.n_steps} steps of {height} x {width} cells"
        remedy = "use a longer --step or --every, or a smaller grid"
        raise invalid(fire.name, f"at most {MOST_STATES} bytes of states", f"{got}; {remedy}")
    sequence = np.empty((fire.n_steps, height, width), np.uint8)
    for k, step in enumerate(sequence):
        np.add(fire.arrival <= k, fire.burnt <= k, out=step, dtype=np.uint8, casting="unsafe")
    return sequence


def _of_arrival(layers: list[Layer], meaning: Meaning) -> Times:
    layer = layers[0]
    if len(layers) != 1:
        raise invalid(layer.name, "one band of arrival times", f"{len(layers)}; choose with --band")
    arrival = layer.values
    burns = np.isfinite(arrival)
    arrival[~burns] = np.inf
    _check_negative(layer, meaning)
    if not burns.any():
        raise invalid(layer.name, "cells that burn", "none")
    unit = unit_of(layer.clock, meaning.unit, layer.name)
    if unit is None:
        expected = f"ms, s, min, h or d, as {layer.name} does not state the unit of times"
        raise invalid("--unit", expected, "none")
    notes = layer.notes + _over_new_year(arrival, unit, layer.name, meaning)
    latest = np.max(arrival, where=burns, initial=-np.inf)
    begin = float(arrival.min()) if meaning.begin is None else meaning.begin
    rounding = float(np.spacing(np.array(latest, layer.stored))) if layer.stored.kind == "f" else 0
    place, first, last = _on_world(arrival, arrival, layer, meaning)
    moments = np.unique(first[np.isfinite(first)])
    # A step shows the fire at the step's time, so a cell that begins to burn later first burns in
    # the next step.
    first, last, latest = (
        steps_at(
            np.maximum(np.asarray(at, np.float64), begin) - begin,
            meaning.seconds / SECONDS[unit],
            rounding,
            layer.name,
        )
        for at in (first, last, latest)
    )
    date = layer.clock.date(begin * SECONDS[unit])
    since, until = (
        layer.clock.date(at * SECONDS[unit]) or f"{at:.13g} {unit}" for at in moments[[0, -1]]
    )
    n_steps, n_lit = int(latest) + 1, len(np.unique(first[np.isfinite(first)]))
    words = f"cells begin to burn at {len(moments)} times from {since} to {until}"
    notes = (*notes, f"{words}, in {n_lit} of {n_steps} steps")
    return Times(first, last + meaning.burning, n_steps, place, layer.name, date, notes)


def _check_negative(layer: Layer, meaning: Meaning) -> None:
    """Refuses times below 0, which mostly mean "never", unless `--begin` says that they are times.

    Even then, refuses the usual codes for "no value".
    """
    negative = layer.values < 0
    if negative.any() and meaning.begin is not None and np.isinf(layer.values).any():
        negative &= np.isin(layer.values, _CODES) | (layer.values < _LEAST)
    # If every cell has a time, a negative time may mean that the cell never burns.
    if negative.any():
        remedy = "if it means never, give --nodata; if the cell burnt before, --begin 0"
        raise invalid(layer.name, "times of at least 0", f"{_first(layer, negative)}; {remedy}")


def _over_new_year(
    arrival: NDArray[np.floating[Any]], unit: str, name: str, meaning: Meaning
) -> tuple[str, ...]:
    """Moves days of the year after New Year to the next year, or notes that there may be some."""
    finite = arrival[np.isfinite(arrival)] if unit == "d" else np.zeros(1)
    is_of_year = unit == "d" and 0 <= finite.min() and finite.max() < _LAST_DAY + 1
    if meaning.year_days is not None and not is_of_year:
        got = f"{finite.min():g} to {finite.max():g}" if unit == "d" else f"the unit {unit}"
        raise invalid("--year-days", f"days 0 to {_LAST_DAY} in {name}", got)
    days = np.unique(np.floor(finite))
    gaps = np.diff(days)
    if not is_of_year or not gaps.size or gaps.max() < _HALF_YEAR:
        return ()
    last, following = days[gaps.argmax() :][:2]
    if meaning.year_days is None:
        words = f"no cell begins to burn between days {last:g} and {following:g}"
        return (f"{words}; if these are days of the year, give --year-days 365 (or 366)",)
    arrival[arrival < following] += meaning.year_days
    return (
        f"days {days[0]:g} to {last:g} follow New Year, and days {following:g} to {days[-1]:g}",
    )


def _of_stack(layers: Iterable[Layer], meaning: Meaning) -> Times:
    first = None
    state, mark = np.empty(0, np.uint8), math.nan
    arrival = burnt = np.empty(0, np.float32)  # numbers of layers
    names, stamps = list[str](), list[Time]()
    codes = meaning.codes if meaning.kind == "states" else (0.0,)
    for k, layer in enumerate(layers):
        if first is None:
            first, state = layer, np.zeros(layer.place.shape, np.uint8)
            arrival, burnt = np.full((2, *state.shape), np.inf, np.float32)
        check_same(layer.place, layer.name, first.place, first.name)
        names.append(layer.name)
        stamps += [layer.time] if layer.time else []
        if not meaning.missing_is_unburnt:
            check_full(layer, "a value in each cell", "--missing-is-unburnt treats them as unburnt")
        layer.values[np.isnan(layer.values)] = codes[0]
        if meaning.kind == "states":
            now = _coded(layer, meaning)
        else:
            now, mark = _marked(layer, meaning, state, mark)
        _check_order(layer, state, now)
        state = now
        arrival[(state >= BURNING) & np.isinf(arrival)] = k
        burnt[(state == BURNT) & np.isinf(burnt)] = k
    if first is None:
        raise invalid("layers", "at least 2", "none")
    step, every, unit = meaning.seconds, meaning.every, meaning.unit
    times = schedule(names, stamps, step=step, every=every, unit=unit)
    if np.isinf(arrival).all():
        raise invalid(first.name, "cells that burn", "none")
    is_mask = meaning.kind == "mask"
    place, *both = _on_world(arrival, arrival if is_mask else burnt, first, meaning)
    arrival, burnt = (_at(one, times.steps) for one in both)
    n_steps = int(times.steps[-1]) + 1
    burnt = burnt + meaning.burning if is_mask else burnt
    return Times(arrival, burnt, n_steps, place, first.name, times.begin)


def _on_world(
    arrival: NDArray[Any], burnt: NDArray[Any], layer: Layer, meaning: Meaning
) -> tuple[Place, NDArray[Any], NDArray[Any]]:
    """Returns the world's grid, and both times of each cell resampled to it."""
    if not meaning.oblong:
        check_square(layer.place, layer.name)
    height, width, cell = meaning.height, meaning.width, meaning.cell
    shape = target_shape(layer.place, height=height, width=width, cell=cell)
    place = of_world(layer.place, shape)
    if shape == arrival.shape:
        return place, arrival, burnt
    # A larger cell is burnt once all of its input cells that ever burn are burnt.
    last = np.where(np.isfinite(arrival), burnt, -np.inf)
    last = resampled(last, shape, meaning.resample, latest=True)
    first = resampled(arrival, shape, meaning.resample)
    burns = np.isfinite(first)
    if not burns.any():
        grid = f"the grid of {shape[0]} x {shape[1]} cells"
        raise InvalidArgumentError(f"--resample: no cell burns on {grid}; use 'earliest'")
    return place, first, np.where(burns, last, np.inf)


def _coded(layer: Layer, meaning: Meaning) -> NDArray[np.uint8]:
    """Returns the states that codes mean."""
    now = np.full(layer.values.shape, len(meaning.codes), np.uint8)
    for state, code in enumerate(meaning.codes):
        now[layer.values == code] = state
    unknown = now == len(meaning.codes)
    if unknown.any():
        codes = ", ".join(f"{code:.6g}" for code in meaning.codes)
        raise invalid(layer.name, f"the codes {codes}", _first(layer, unknown))
    return now


def _marked(
    layer: Layer, meaning: Meaning, before: NDArray[np.uint8], mark: float
) -> tuple[NDArray[np.uint8], float]:
    """Returns the states that a mask means, and the number that marks its cells."""
    burning = layer.values != 0
    if math.isnan(mark) and burning.any():
        mark = float(layer.values[burning][0])
    if mark < 0:
        got = f"{_first(layer, burning)}; if it means no value, give --nodata"
        raise invalid(layer.name, "0 and a number above 0", got)
    wrong = burning & (layer.values != mark)
    if wrong.any():
        expected = f"0 and only one other number in all layers, {mark:.6g}"
        raise InvalidArgumentError(f"{layer.name}: expected {expected}, got {_first(layer, wrong)}")
    now = burning.astype(np.uint8)
    if meaning.kind == "burning":
        now[~burning & (before >= BURNING)] = BURNT
    return now, mark


def _check_order(layer: Layer, before: NDArray[np.uint8], now: NDArray[np.uint8]) -> None:
    """Refuses a cell whose state cannot follow its state in the previous layer."""
    for state, words in (
        (BURNING, "burnt cells to stay burnt, got {} that burn again"),
        (UNBURNT, "burning cells not to become unburnt, got {} that are unburnt again"),
    ):
        wrong = (now == state) & (before > state)
        if wrong.any():
            words = words.format(wrong.sum())
            raise InvalidArgumentError(f"{layer.name}: expected {words}, the first {where(wrong)}")


def _at(layers: NDArray[np.floating[Any]], steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Converts layer numbers to step numbers; infinite numbers stay infinite."""
    numbers = np.where(np.isfinite(layers), layers, len(steps)).astype(np.intp)
    return np.append(steps, np.inf)[numbers]


def _first(layer: Layer, cells: NDArray[np.bool_]) -> str:
    return f"{layer.values[cells][0]:.9g} {where(cells)}"
