"""Model files with zones, made from a base model without zones: each zone gets its own kernels."""

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
    """Refuses an unsuitable base model; `is_changed`: whether slope or wind change its kernels."""
    subject, names = f"model {quoted(base['name'])}", [entry["name"] for entry in base["states"]]
    for key in ("zones", "zone_map", "no_fly"):
        if key in base:
            raise invalid(subject, f"a base model without `{key}`", "one with it")
    if state not in names:
        raise invalid("--state", f"one of {', '.join(names)}", f"'{state}'")
    if is_changed and not any(_spreads(entry, state) for entry in base["kernel"]):
        expected = f"a kernel by which '{state}' spreads to neighbours"
        raise invalid(subject, expected, "none; choose another state with --state")
    biased = [entry["name"] for entry in base["states"][1:] if entry.get("bias", 0.0) > 0.0]
    if biased and not all(zone.burns for zone in zones):
        expected = f"a model in which only '{names[0]}' has a bias"
        raise invalid("--unburnable", expected, f"one in which '{biased[0]}' has a bias")


def kernels(
    base: Table, zone: Zone, state: str, speed: float, towards: float, *, is_even: bool
) -> list[Table]:
    """Returns the kernel entries of a zone.

    Slope and wind change the spread of `state` to neighbours. `is_even`: whether neighbours at the
    same distance first get the mean of their weights.
    """
    entries = list[Table]()
    for entry in base["kernel"] if zone.burns else _to_first_state(base):
        weights = np.array(entry["weights"], float)
        if is_even:
            weights = _even(weights)
        if _spreads(entry, state):
            weights *= factors(zone.rise, speed, towards, weights.shape)
        # Six digits suffice, because no fire's weights are known more precisely.
        rows = [[float(f"{weight:.6g}") for weight in row] for row in weights.tolist()]
        entries.append({"zone": zone.name} | entry | {"weights": rows})
    return entries


def toml(model: Mapping[str, Any]) -> str:
    """Returns the text of a model file. Tables come last, as TOML requires."""
    lines, tables = list[str](), list[str]()
    for key, value in model.items():
        match value:
            case dict():
                tables += ["", f"[{key}]", *_items(cast("Table", value))]
            case [dict(), *_]:
                for table in cast("list[Table]", value):
                    tables += ["", f"[[{key}]]", *_items(table)]
            case [list(), *_]:
                rows = [f"  {_value(row)}," for row in cast("list[Any]", value)]
                lines += [f"{key} = [", *rows, "]"]
            case _:
                lines.append(f"{key} = {_value(value)}")
    return "\n".join(lines + tables) + "\n"


def _spreads(entry: Table, state: str) -> bool:
    """Returns whether a kernel entry spreads `state` from neighbours to cells in other states."""
    weights = entry.get("scale", 1.0) * np.array(entry["weights"], float)
    weights[weights.shape[0] // 2, weights.shape[1] // 2] = 0.0
    return entry["from"] == entry["to"] == state != entry.get("own") and bool(weights.any())


def _even(weights: NDArray[np.float64]) -> NDArray[np.float64]:
    rows, columns = np.indices(weights.shape) - np.reshape(weights.shape, (2, 1, 1)) // 2
    squares = rows**2 + columns**2
    means = np.bincount(squares.ravel(), weights.ravel()) / np.bincount(squares.ravel()).clip(1)
    return means[squares]


def _to_first_state(base: Table) -> list[Table]:
    """Returns kernels that change a cell to the first state, whatever its neighbours' states."""
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
    return [f"{key} = {_value(value)}" for key, value in table.items()]


def _value(value: Any) -> str:
    match value:
        case bool():
            return str(value).lower()
        case str():
            return quoted(value)
        case dict():
            return f"{{ {', '.join(_items(cast('Table', value)))} }}"
        case list():
            return f"[{', '.join(map(_value, cast('list[Any]', value)))}]"
        case _:
            return repr(value)
