"""A model file with zones, made of a base model without: each zone gets kernels of its own."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from emberwatch.errors import invalid
from emberwatch.landscape.terrain import Zone, factors
from emberwatch.landscape.world import quoted

Table = dict[str, Any]
"""A table of a TOML file, as `tomllib` reads it."""


def check_base(base: Table, zones: Sequence[Zone], state: str, *, is_changed: bool) -> None:
    """Refuses a base whose kernels do not fit; `is_changed`: whether slope or wind count."""
    subject, names = f"model {quoted(base['name'])}", [entry["name"] for entry in base["states"]]
    for key in ("zones", "zone_map", "no_fly"):
        if key in base:
            raise invalid(subject, f"no {key}", "some")
    if state not in names:
        raise invalid("--state", f"one of {', '.join(names)}", f"'{state}'")
    if is_changed and not any(_spreads(entry, state) for entry in base["kernel"]):
        expected = f"a kernel by which '{state}' spreads to neighbours"
        raise invalid(subject, expected, "none; --state names another state")
    biased = [entry["name"] for entry in base["states"][1:] if entry.get("bias", 0.0) > 0.0]
    if biased and not all(zone.burns for zone in zones):
        raise invalid("--unburnable", f"no bias but of '{names[0]}'", f"one of '{biased[0]}'")


def kernels(
    base: Table, zone: Zone, state: str, speed: float, towards: float, *, is_even: bool
) -> list[Table]:
    """The kernel entries of a zone.

    Slope and wind change how `state` spreads to neighbours. `is_even`: neighbours at one distance
    first get the mean of their weights.
    """
    entries = list[Table]()
    for entry in base["kernel"] if zone.burns else _to_first_state(base):
        weights = np.array(entry["weights"], float)
        if is_even:
            weights = _even(weights)
        if _spreads(entry, state):
            weights *= factors(zone.rise, speed, towards, weights.shape)
        # Nobody knows more than six digits of a fire.
        rows = [[float(f"{weight:.6g}") for weight in row] for row in weights.tolist()]
        entries.append({"zone": zone.name} | entry | {"weights": rows})
    return entries


def toml(model: Mapping[str, Any]) -> str:
    """The text of a model file: tables stand last, as TOML demands."""
    lines, tables = list[str](), list[str]()
    for key, value in model.items():
        match value:
            case dict():
                tables += ["", f"[{key}]", *_items(cast("Table", value))]
            case [dict(), *_]:
                for table in cast("list[Table]", value):
                    tables += ["", f"[[{key}]]", *_items(table)]
            case [list(), *_]:
                rows = [f"  {_told(row)}," for row in cast("list[Any]", value)]
                lines += [f"{key} = [", *rows, "]"]
            case _:
                lines.append(f"{key} = {_told(value)}")
    return "\n".join(lines + tables) + "\n"


def _spreads(entry: Table, state: str) -> bool:
    """Whether by this entry neighbours in a state bring cells of other states into it."""
    weights = entry.get("scale", 1.0) * np.array(entry["weights"], float)
    weights[weights.shape[0] // 2, weights.shape[1] // 2] = 0.0
    return entry["from"] == entry["to"] == state != entry.get("own") and bool(weights.any())


def _even(weights: NDArray[np.float64]) -> NDArray[np.float64]:
    rows, columns = np.indices(weights.shape) - np.reshape(weights.shape, (2, 1, 1)) // 2
    squares = rows**2 + columns**2
    means = np.bincount(squares.ravel(), weights.ravel()) / np.bincount(squares.ravel()).clip(1)
    return means[squares]


def _to_first_state(base: Table) -> list[Table]:
    """Kernels by which a cell becomes the first state, whatever is around it."""
    names = [state["name"] for state in base["states"]]
    height, width = base["kernel_size"]
    weights = np.zeros((height, width))
    weights[height // 2, width // 2] = 1.0
    sees_own = any("own" in entry for entry in base["kernel"])
    return [
        ({"own": name} if sees_own else {})
        | {"from": name, "to": names[0], "weights": weights.tolist()}
        for name in names
    ]


def _items(table: Mapping[str, Any]) -> list[str]:
    return [f"{key} = {_told(value)}" for key, value in table.items()]


def _told(value: Any) -> str:
    match value:
        case bool():
            return str(value).lower()
        case str():
            return quoted(value)
        case dict():
            return f"{{ {', '.join(_items(cast('Table', value)))} }}"
        case list():
            return f"[{', '.join(map(_told, cast('list[Any]', value)))}]"
        case _:
            return repr(value)
