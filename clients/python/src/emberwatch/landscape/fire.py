"""States of a fire from its layers: unburnt, burning, burnt.

Every kind of input is first converted to two times for each cell, counted in layers or steps: when
the cell begins to burn, and when it is burnt. These times are resampled, and then converted to the
state of each cell in each step.
"""

import math
from argparse import Namespace
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import invalid
from emberwatch.landscape.grid import check_same, check_square, resampled, target_shape
from emberwatch.landscape.layers import Layer, where
from emberwatch.landscape.times import SECONDS, date, schedule, steps_at, unit_of

UNBURNT, BURNING, BURNT = 0, 1, 2

MOST_STATES: Final = 1 << 31  # maximum size of a sequence, bytes
#: Numbers below 0 that files use for "no value".
_CODES: Final = (-1, -9, -99, -999, -9999, -99999, -32767, -32768, -2147483647, -2147483648)


class Times(NamedTuple):
    """The times at which each cell of one fire begins to burn, and is burnt, on the world's grid.

    Times are in steps, and infinite if the cell never begins to burn or never is burnt.
    """

    arrival: NDArray[np.float64]
    burnt: NDArray[np.float64]
    n_steps: int
    name: str  # of the first layer
    begin: str | None  # the date of step 0
    notes: tuple[str, ...]  # what was assumed


def times(layers: Iterable[Layer], flags: Namespace) -> Times:
    """Computes the times of one fire from its layers."""
    if flags.kind == "arrival":
        return _of_arrival(list(layers), flags)
    return _of_stack(layers, flags)


def states(fire: Times) -> NDArray[np.uint8]:
    """Computes the states of a fire in each step, shape (K, H, W)."""
    height, width = fire.arrival.shape
    if fire.n_steps < 2:
        got = f"{fire.n_steps}: all cells that burn begin in it"
        remedy = "use a shorter --step, or merge the files of one fire (ogrmerge.py -single)"
        raise invalid(fire.name, "at least 2 steps", f"{got}; {remedy}")
    if fire.n_steps * height * width > MOST_STATES:
        got = f"{fire.n_steps} steps of {height} x {width} cells"
        remedy = "use a longer --step, or a smaller grid"
        raise invalid(fire.name, f"at most {MOST_STATES} bytes of states", f"{got}; {remedy}")
    sequence = np.empty((fire.n_steps, height, width), np.uint8)
    for k, step in enumerate(sequence):
        np.add(fire.arrival <= k, fire.burnt <= k, out=step, dtype=np.uint8, casting="unsafe")
    return sequence


def _of_arrival(layers: list[Layer], flags: Namespace) -> Times:
    layer = layers[0]
    if len(layers) != 1:
        raise invalid(layer.name, "one band of arrival times", f"{len(layers)}; choose with --band")
    values = layer.values.astype(np.float64)
    arrival = np.where(np.isfinite(values), values, np.inf)
    if np.isinf(arrival).all():
        raise invalid(layer.name, "cells that burn", "none")
    _check_negative(layer, flags)
    unit = unit_of(layer.unit, flags.unit, layer.name)
    if unit is None:
        expected = f"ms, s, min, h or d, as {layer.name} does not state the unit of times"
        raise invalid("--unit", expected, "none")
    begin = float(arrival.min()) if flags.begin is None else flags.begin
    latest = float(arrival[np.isfinite(arrival)].max())
    first, last = _on_world(arrival, arrival, layer, flags)
    moments = np.unique(first[np.isfinite(first)])
    # A step shows the fire at the step's time, so a cell that begins to burn later first burns in
    # the next step.
    first, last, end = (
        steps_at(np.maximum(at, begin) - begin, flags.seconds / SECONDS[unit])
        for at in (first, last, np.array([latest]))
    )
    since, until = (
        date(at * SECONDS[unit], layer.unit) or f"{at:.13g} {unit}" for at in moments[[0, -1]]
    )
    n_steps, n_lit = int(end[0]) + 1, len(np.unique(first[np.isfinite(first)]))
    words = f"cells begin to burn at {len(moments)} times from {since} to {until}"
    return Times(
        arrival=first,
        burnt=last + flags.burning,
        n_steps=n_steps,
        name=layer.name,
        begin=date(begin, layer.unit),
        notes=(*layer.notes, f"{words}, in {n_lit} of {n_steps} steps"),
    )


def _check_negative(layer: Layer, flags: Namespace) -> None:
    """Refuses times below 0, which mostly mean "never", unless `--begin` says that they are times.

    Even then, refuses the usual codes for "no value".
    """
    negative = np.isfinite(layer.values) & (layer.values < 0)
    if flags.begin is not None:
        negative &= np.isin(layer.values, _CODES)
    if negative.any():
        remedy = "if it means never, give --nodata; if the cell burnt before, --begin 0"
        raise invalid(layer.name, "times of at least 0", f"{_first(layer, negative)}; {remedy}")


def _of_stack(layers: Iterable[Layer], flags: Namespace) -> Times:
    read = list[Layer]()
    state, mark, n_missing = np.empty(0, np.uint8), math.nan, 0
    arrival = burnt = np.empty(0)  # numbers of layers
    unburnt = flags.codes[UNBURNT] if flags.kind == "states" else 0.0
    for k, layer in enumerate(layers):
        if not read:
            state = np.zeros(layer.place.shape, np.uint8)
            arrival, burnt = np.full((2, *state.shape), np.inf)
        read.append(replace(layer, values=np.empty(0)))  # without its memory
        check_same(layer.place, layer.name, read[0].place, read[0].name)
        missing = np.isnan(layer.values)
        n_missing += np.count_nonzero(missing)
        layer.values[missing] = unburnt
        if flags.kind == "states":
            now = _coded(layer, flags)
        else:
            now, mark = _marked(layer, flags, state, mark)
        again = now < state
        if again.any():
            got = f"{again.sum()} that burn or are unburnt again, the first {where(again)}"
            raise invalid(layer.name, "cells that burn once and stay burnt", got)
        state = now
        arrival[(state >= BURNING) & np.isinf(arrival)] = k
        burnt[(state == BURNT) & np.isinf(burnt)] = k
    first = read[0]
    steps = schedule(read, step=flags.seconds, unit=flags.unit)
    if np.isinf(arrival).all():
        raise invalid(first.name, "cells that burn", "none")
    is_mask = flags.kind == "mask"
    both = _on_world(arrival, arrival if is_mask else burnt, first, flags)
    arrival, burnt = (_at(one, steps) for one in both)
    note = f"{n_missing} cells of layers have no value, and count as unburnt"
    return Times(
        arrival=arrival,
        burnt=burnt + flags.burning if is_mask else burnt,
        n_steps=int(steps[-1]) + 1,
        name=first.name,
        begin=None if first.time is None else date(first.time, first.time_unit),
        notes=(note,) if n_missing else (),
    )


def _on_world(
    arrival: NDArray[Any], burnt: NDArray[Any], layer: Layer, flags: Namespace
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Returns both times of each cell, resampled to the world's grid."""
    if not flags.oblong:
        check_square(layer.place, layer.name)
    shape = target_shape(layer.place, height=flags.height, cell=flags.cell)
    if shape == arrival.shape:
        return arrival, burnt
    # A larger cell is burnt once all of its input cells that ever burn are burnt.
    last = np.where(np.isfinite(arrival), burnt, -np.inf)
    last, first = resampled(last, shape, latest=True), resampled(arrival, shape)
    return first, np.where(np.isfinite(first), last, np.inf)


def _coded(layer: Layer, flags: Namespace) -> NDArray[np.uint8]:
    now = np.full(layer.values.shape, len(flags.codes), np.uint8)
    for state, code in enumerate(flags.codes):
        now[layer.values == code] = state
    unknown = now == len(flags.codes)
    if unknown.any():
        codes = ", ".join(f"{code:.6g}" for code in flags.codes)
        raise invalid(layer.name, f"the codes {codes}", _first(layer, unknown))
    return now


def _marked(
    layer: Layer, flags: Namespace, before: NDArray[np.uint8], mark: float
) -> tuple[NDArray[np.uint8], float]:
    """Returns the states, and the number that marks cells."""
    burning = layer.values != 0
    if math.isnan(mark) and burning.any():
        mark = float(layer.values[burning][0])
    wrong = burning & ((layer.values != mark) | (layer.values < 0))
    if wrong.any():
        remedy = "if it means no value, give --nodata"
        expected = "0 and only one other number, above 0, in all layers"
        raise invalid(layer.name, expected, f"{_first(layer, wrong)}; {remedy}")
    now = burning.astype(np.uint8)
    if flags.kind == "burning":
        now[~burning & (before >= BURNING)] = BURNT
    return now, mark


def _at(layers: NDArray[np.floating[Any]], steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Converts layer numbers to step numbers; infinite numbers stay infinite."""
    numbers = np.where(np.isfinite(layers), layers, len(steps)).astype(np.intp)
    return np.append(steps, np.inf)[numbers]


def _first(layer: Layer, cells: NDArray[np.bool_]) -> str:
    return f"{layer.values[cells][0]:.9g} {where(cells)}"
