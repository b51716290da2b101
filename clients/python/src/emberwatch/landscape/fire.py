"""States of a fire from its layers: unburnt, burning, burnt.

Every kind of input is first converted to two times for each cell, counted in layers or steps: when
the cell begins to burn, and when it is burnt. These times are resampled, and then converted to the
state of each cell in each step.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.landscape.grid import Place, Rule, check_same, check_square, crop, part, resampled
from emberwatch.landscape.layers import Layer
from emberwatch.landscape.schedule import SECONDS, Schedule, steps_at, unit_of
from emberwatch.landscape.world import STATES

UNBURNT, BURNING, BURNT = 0, 1, 2

Kind = Literal["arrival", "mask", "burning", "states"]

#: Parts of words that identify each state, in the order of the search.
_WORDS: Final = (("not_burn", "unburn"), ("burning",), ("burned", "burnt"))
MOST_STATES: Final = 1 << 31  # maximum size of a sequence, bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class Times:
    """The times at which each cell of one fire begins to burn, and is burnt.

    Times are in steps, and infinite if the cell never begins to burn or never is burnt.
    """

    arrival: NDArray[np.float64]
    burnt: NDArray[np.float64]
    n_steps: int
    place: Place
    name: str
    """Name of the first layer, for errors."""
    begin: datetime | None = None
    """The date of step 0, if the files have it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Meaning:
    """The interpretation of the numbers in the layers, from the flags."""

    kind: Kind
    step: float
    """Duration of a step, seconds."""
    unit: str | None = None
    """Unit of arrival times, or of the times of layers; None: the file's unit."""
    begin: float | None = None
    """The arrival time of step 0; earlier arrivals are moved to it. None: the earliest arrival."""
    burning: int = 1
    """Number of steps that a cell burns after its arrival."""
    every: int = 1
    """If layers have no times, every `every`-th layer becomes a step."""
    crop: tuple[int, ...] | None = None
    """Top, left, height and width of the used part of each layer; None: the whole layer."""
    codes: tuple[float, float, float] = (UNBURNT, BURNING, BURNT)
    """The numbers that mean unburnt, burning and burnt, for the kind `states`."""
    oblong: bool = False
    """Whether to treat cells that are not square as squares."""
    missing_is_unburnt: bool = False
    """Whether to treat cells without a value as unburnt."""


def times(layers: Iterable[Layer], meaning: Meaning) -> Times:
    """Computes the times of one fire from its layers."""
    if meaning.kind == "arrival":
        return _of_arrival(list(layers), meaning)
    return _of_stack(layers, meaning)


def states(fire: Times, shape: tuple[int, int], rule: Rule) -> NDArray[np.uint8]:
    """Computes the states of a fire in each step, shape (K, H, W)."""
    arrival, burnt = fire.arrival, fire.burnt
    burns = np.isfinite(arrival)
    if not burns.any():
        raise invalid(fire.name, "cells that burn", "none")
    # A larger cell is burnt once all of its input cells that ever burn are burnt.
    last = resampled(np.where(burns, burnt, -np.inf), shape, rule, latest=True)
    arrival = resampled(arrival, shape, rule)
    burnt = np.where(np.isfinite(arrival), last, np.inf)
    if not np.isfinite(arrival).any():
        raise InvalidArgumentError(
            f"--resample: no cell burns on the grid of {shape[0]} x {shape[1]} cells; use "
            "'earliest'"
        )
    if fire.n_steps * arrival.size > MOST_STATES:
        raise InvalidArgumentError(
            f"{fire.name}: expected at most {MOST_STATES} bytes of states, got "
            f"{fire.n_steps:.15g} steps of {shape[0]} x {shape[1]} cells; use a longer --step or "
            "--every, or a smaller grid"
        )
    sequence = np.empty((fire.n_steps, *shape), np.uint8)
    for k, step in enumerate(sequence):
        np.add(arrival <= k, burnt <= k, out=step, dtype=np.uint8, casting="unsafe")
    return sequence


def _of_arrival(layers: list[Layer], meaning: Meaning) -> Times:
    layer = layers[0]
    if len(layers) != 1:
        raise invalid(layer.name, "one band of arrival times", f"{len(layers)}; choose with --band")
    _check_square(layer, meaning)
    layer = _cropped(layer, meaning)
    arrival = np.where(np.isfinite(layer.values), layer.values, np.inf)
    negative = arrival < 0
    # If every cell has a time, a negative time may mean that the cell never burns.
    if negative.any() and (meaning.begin is None or not np.isinf(arrival).any()):
        raise InvalidArgumentError(
            f"{layer.name}: expected times of at least 0, got {_first(layer, negative)}; if it "
            "means never, give --nodata; if the cell burnt before, --begin 0"
        )
    finite = arrival[np.isfinite(arrival)]
    if not finite.size:
        raise invalid(layer.name, "cells that burn", "none")
    unit = unit_of(layer.clock, meaning.unit, layer.name)
    if unit is None:
        raise invalid(
            "--unit", f"s, min, h or d, as {layer.name} does not state the unit of times", "none"
        )
    step = meaning.step / SECONDS[unit]
    begin = float(finite.min()) if meaning.begin is None else meaning.begin
    # A step shows the fire at the step's time, so a cell that begins to burn later first burns in
    # the next step.
    steps = steps_at(np.maximum(arrival, begin) - begin, step)
    n_steps = int(steps[np.isfinite(steps)].max()) + 1
    date = layer.clock.date(begin * SECONDS[unit])
    return _checked(steps, steps + meaning.burning, n_steps, layer, date)


def _of_stack(layers: Iterable[Layer], meaning: Meaning) -> Times:
    first, place = None, None
    arrival = burnt = np.empty(0)
    schedule = Schedule(step=meaning.step, every=meaning.every, unit=meaning.unit)
    mark = math.nan
    for k, layer in enumerate(layers):
        if first is None or place is None:
            place = layer.place
            _check_square(layer, meaning)
            first = _cropped(layer, meaning)
            arrival = np.full(first.place.shape, np.inf)
            burnt = arrival.copy()
        check_same(layer.place, layer.name, place, first.name)
        layer = _cropped(layer, meaning)
        schedule.add(layer.name, layer.time)
        mark = _add(layer, k, meaning, arrival, burnt, mark)
    if first is None:
        raise invalid("layers", "at least 2", "none")
    steps, n_steps = schedule.steps()
    arrival, burnt = _at(arrival, steps), _at(burnt, steps)
    if meaning.kind == "mask":
        burnt = arrival + meaning.burning
    return _checked(arrival, burnt, n_steps, first, schedule.begin)


def _add(
    layer: Layer,
    k: int,
    meaning: Meaning,
    arrival: NDArray[np.float64],
    burnt: NDArray[np.float64],
    mark: float,
) -> float:
    """Updates the times with layer k; returns the number that marks the cells of a mask."""
    values = layer.values
    missing = np.isnan(values)
    if missing.any():
        if not meaning.missing_is_unburnt:
            raise InvalidArgumentError(
                f"{layer.name}: expected a value in each cell, got none in {missing.sum()} cells, "
                f"the first {_cell(missing)}; --missing-is-unburnt treats them as unburnt"
            )
        values[missing] = meaning.codes[0] if meaning.kind == "states" else 0.0
    _check_flags(layer, meaning)
    if meaning.kind == "states":
        unburnt, burning, done = (values == code for code in meaning.codes)
        known = unburnt | burning | done
        if not known.all():
            raise invalid(layer.name, f"the codes {_numbers(meaning.codes)}", _first(layer, ~known))
    else:
        unburnt, done = values == 0, np.zeros(values.shape, bool)
        if math.isnan(mark) and not unburnt.all():
            mark = float(values[~unburnt][0])
        burning = values == mark
        if not (unburnt | burning).all():
            raise InvalidArgumentError(
                f"{layer.name}: expected 0 and only one other number in all layers, {mark:.6g}, "
                f"got {_first(layer, ~(unburnt | burning))}"
            )
        if meaning.kind == "burning":
            done = unburnt & np.isfinite(arrival)
            unburnt &= ~done
    _check_order(layer, unburnt, burning, arrival, burnt)
    arrival[(burning | done) & np.isinf(arrival)] = k
    burnt[done & np.isinf(burnt)] = k
    return mark


def _check_flags(layer: Layer, meaning: Meaning) -> None:
    """Refuses numbers to which the file's own attributes give another meaning."""
    for number, word in layer.flags:
        if meaning.kind == "states":
            taken = [state for state, code in enumerate(meaning.codes) if code == number]
        elif number == 0:
            taken = [UNBURNT] if meaning.kind == "mask" else [UNBURNT, BURNT]
        else:
            taken = [BURNING, BURNT]
        said = [k for k, words in enumerate(_WORDS) if any(each in word.lower() for each in words)]
        if taken and said and said[0] not in taken:
            raise invalid(
                f"{layer.name}, flag_meanings",
                f"{number:.6g} to mean {' or '.join(STATES[state].name for state in taken)}",
                f"'{word}'; --kind and --codes set the meaning of numbers",
            )


def _check_order(
    layer: Layer,
    unburnt: NDArray[np.bool_],
    burning: NDArray[np.bool_],
    arrival: NDArray[np.float64],
    burnt: NDArray[np.float64],
) -> None:
    """Refuses states that cannot follow the previous layers."""
    for wrong, words in (
        (burning & np.isfinite(burnt), "burnt cells to stay burnt, got {} that burn again"),
        (
            unburnt & np.isfinite(arrival),
            "burning cells not to become unburnt, got {} that are unburnt again",
        ),
    ):
        if wrong.any():
            expected = words.format(wrong.sum())
            where = f"the first {_cell(wrong)}"
            raise InvalidArgumentError(f"{layer.name}: expected {expected}, {where}")


def _cropped(layer: Layer, meaning: Meaning) -> Layer:
    window = crop(layer.place, meaning.crop)
    return replace(layer, values=layer.values[window], place=part(layer.place, window))


def _check_square(layer: Layer, meaning: Meaning) -> None:
    if not meaning.oblong:
        check_square(layer.place, layer.name)


def _checked(
    arrival: NDArray[np.float64],
    burnt: NDArray[np.float64],
    n_steps: int,
    layer: Layer,
    begin: datetime | None,
) -> Times:
    if n_steps < 2:
        raise invalid(layer.name, "at least 2 steps", n_steps)
    return Times(
        arrival=arrival,
        burnt=burnt,
        n_steps=n_steps,
        place=layer.place,
        name=layer.name,
        begin=begin,
    )


def _at(layers: NDArray[np.float64], steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Converts layer numbers to step numbers; infinite numbers stay infinite."""
    numbers = np.where(np.isfinite(layers), layers, len(steps)).astype(np.intp)
    return np.append(steps, np.inf)[numbers]


def _cell(cells: NDArray[np.bool_]) -> str:
    row, column = np.argwhere(cells)[0].tolist()
    return f"in row {row}, column {column}"


def _first(layer: Layer, cells: NDArray[np.bool_]) -> str:
    return f"{layer.values[cells][0]:.9g} {_cell(cells)}"


def _numbers(numbers: Iterable[float]) -> str:
    return ", ".join(f"{number:.6g}" for number in numbers)
