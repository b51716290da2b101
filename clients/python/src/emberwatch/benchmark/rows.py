"""Rows of the benchmark, and their form in CSV files."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterable
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any, Final, TextIO

from emberwatch.errors import invalid


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A policy on one world: a line of the CSV file, as `emberwatch-agent compare` writes it."""

    policy: str
    #: Where its belief came from: `none`, `known_model`, or a name of your own.
    estimator: str
    world_seed: int
    #: Scored steps of the world.
    steps: int
    mean_reward: float
    mean_distinct_cells: float
    #: Distinct visited cells on target, as a share of the distinct visited cells.
    hit_rate: float
    #: Of the whole world: the same for every policy.
    mean_fire_cells: float
    mean_plan_millis: float
    #: Empty: only the agent program scores beliefs.
    brier: str
    #: Moves of a path.
    moves: int
    #: Robots of the world; the numbers above are those of all of them together.
    robots: int = 1
    #: What they share: `alone`, `shared` (what they see), or a word of your own.
    team: str = "alone"
    #: Share of their visits to cells that another robot visited in the same step.
    mean_repeated: float = 0.0
    #: The figures of merit (docs/figures-of-merit.md). Steps until a robot first visited a burning
    #: cell; None: never, or a row of an old file.
    steps_to_detection: int | None = None
    #: Burning cells of the world in that step.
    burning_cells_at_detection: int | None = None
    #: Steps for which a cell counts as seen after a visit.
    recent_steps: int | None = None
    #: Share of the burning cells that were seen in the last steps.
    burning_seen_share: float | None = None
    #: Moves from the nearest robot to the nearest burning cell that was not.
    front_distance: float | None = None
    #: Share of the grid that was ever seen.
    grid_seen_share: float | None = None
    #: Mean of ln P of a visited cell's observation; None: only the agent program scores beliefs.
    log_likelihood: float | None = None
    #: Identifies the worlds, whatever their seed: equal for two rows if and only if model, grid,
    #: moves, robots, sensor, start and burn-in are. Empty in rows of old files.
    worlds_fingerprint: str = ""
    #: Identifies the policy and all settings that its actions depend on. Empty in old files.
    policy_fingerprint: str = ""
    #: Processor seconds of training for the world's task. None: only `emberwatch-agent suite` says.
    training_seconds: float | None = None


_HEADER: Final = [field.name for field in fields(Row)]
#: First columns that older files lack: training, fingerprints, likelihoods, merit, or teams.
_LATER: Final = (
    "training_seconds",
    "worlds_fingerprint",
    "log_likelihood",
    "steps_to_detection",
    "robots",
)
_HEADERS: Final = [_HEADER, *(_HEADER[: _HEADER.index(column)] for column in _LATER)]


def read(path: str | os.PathLike[str]) -> list[Row]:
    """Returns the rows of a CSV file of `evaluate` or `emberwatch-agent compare`.

    An empty file has none. A byte order mark, as spreadsheets write it, is skipped.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            lines = csv.DictReader(file)
            if lines.fieldnames is None:
                return []
            if lines.fieldnames not in _HEADERS:
                raise ValueError(",".join(lines.fieldnames))
            return [_row(line) for line in lines]
    except (ValueError, TypeError, csv.Error) as error:
        raise invalid("csv", f"{path} to have the columns {','.join(_HEADER)}", error) from None


def write(file: TextIO, rows: Iterable[Row]) -> None:
    """Writes a header and rows."""
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(_HEADER)
    writer.writerows(astuple(row) for row in rows)


def _row(line: dict[Any, Any]) -> Row:
    if None in line or None in line.values():  # under None are values without a column
        raise ValueError(f"a row with too many or too few values: {list(line.values())}")
    kinds: dict[str, Callable[[str], Any]] = {"int": int, "float": float, "str": str}

    def value(kind: str, text: str) -> Any:
        kind, _, optional = kind.partition(" | ")
        return None if optional and not text else kinds[kind](text)

    values = {
        field.name: value(str(field.type), line[field.name])
        for field in fields(Row)
        if field.name in line
    }
    return Row(**values)
