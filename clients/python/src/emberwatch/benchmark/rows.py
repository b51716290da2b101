"""Rows of the benchmark, and their CSV format."""

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
    """The score of a policy on one world: a line of the CSV file of `emberwatch-agent compare`.

    Means are over the scored steps.
    """

    #: Name of the policy.
    policy: str
    #: Name of the estimator of the policy's belief: `none`, `known_model`, or a name of your
    #: choice.
    estimator: str
    world_seed: int
    #: Number of scored steps.
    steps: int
    #: Mean reward of all robots together.
    mean_reward: float
    #: Mean number of distinct visited cells.
    mean_distinct_cells: float
    #: Share of the distinct visited cells that were in the state that pays most.
    hit_rate: float
    #: Mean number of cells of the whole world in the state that pays most, the same for all
    #: policies.
    mean_fire_cells: float
    #: Mean time that the policy took to choose the actions of a step, milliseconds.
    mean_plan_millis: float
    #: Brier score of the belief. Empty in rows that Python writes, because only the agent program
    #: scores beliefs.
    brier: str
    #: Number of moves in a path.
    moves: int
    #: Number of robots in the world. The values above are for all robots together.
    robots: int = 1
    #: What the robots share: `alone` (nothing), `shared` (what they see), or a word of your choice.
    team: str = "alone"
    #: Share of the visits that repeat another robot's visit to the same cell in the same step.
    mean_repeated: float = 0.0
    #: The first of the figures of merit (docs/figures-of-merit.md): number of steps until a robot
    #: first visited a burning cell. None if no robot ever did, and in rows of old files.
    steps_to_detection: int | None = None
    #: Number of the world's burning cells in the step of that first visit.
    burning_cells_at_detection: int | None = None
    #: Number of steps for which a cell counts as seen after a visit.
    recent_steps: int | None = None
    #: Mean share of the burning cells that count as seen.
    burning_seen_share: float | None = None
    #: Mean smallest number of moves from a robot to a burning cell that does not count as seen.
    front_distance: float | None = None
    #: Share of the grid that a robot visited at any time.
    grid_seen_share: float | None = None
    #: Mean of ln P(y) over the observations y of visited cells. None in rows that Python writes.
    log_likelihood: float | None = None
    #: Identifies the worlds apart from their seeds. Equal for two rows if and only if model, grid,
    #: moves, robots, sensor, start and burn-in are equal. Empty in rows of old files.
    worlds_fingerprint: str = ""
    #: Identifies the policy and all settings that its actions depend on. Empty in old files.
    policy_fingerprint: str = ""
    #: Processor seconds of the training for the task. None except in `emberwatch-agent suite`.
    training_seconds: float | None = None


_HEADER: Final = [field.name for field in fields(Row)]
#: The first column of each group of columns that a release added at the end, newest first.
_LATER: Final = (
    "training_seconds",
    "worlds_fingerprint",
    "log_likelihood",
    "steps_to_detection",
    "robots",
)
_HEADERS: Final = [_HEADER, *(_HEADER[: _HEADER.index(column)] for column in _LATER)]


def read(path: str | os.PathLike[str]) -> list[Row]:
    """Reads the rows of a CSV file of `evaluate` or `emberwatch-agent compare`.

    An empty file has no rows. A byte order mark, as spreadsheets write it, is skipped.

    Raises:
        InvalidArgumentError: If the file has other columns, or an invalid row.
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
    if None in line or None in line.values():  # the key None holds surplus values
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
