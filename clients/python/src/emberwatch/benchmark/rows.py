"""Rows of the benchmark, and their CSV format."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable
from dataclasses import MISSING, astuple, dataclass, fields
from pathlib import Path
from typing import Any, Final

from emberwatch.errors import invalid


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The score of a policy on one world: a line of the CSV file of `emberwatch-agent compare`.

    Means are over the scored steps, of all robots together. None means that there was nothing to
    measure, or that the file has no such column. The figures of merit, from `steps_to_detection`
    to `grid_seen_share`, are defined in docs/figures-of-merit.md.
    """

    policy: str
    #: The policy's belief: `none`, `known_model`, or a name of your choice.
    estimator: str
    world_seed: int
    #: Number of scored steps.
    steps: int
    mean_reward: float
    #: Mean number of distinct visited cells.
    mean_distinct_cells: float
    #: Share of the distinct visited cells that were in the state that pays most.
    hit_rate: float
    #: Mean number of cells of the whole world in that state, the same for all policies.
    mean_fire_cells: float
    #: Mean time that the policy took to choose the actions of a step, milliseconds.
    mean_plan_millis: float
    #: Brier score of the belief. Empty in rows of Python, because only the agent scores beliefs.
    brier: str
    #: Number of moves in a path.
    moves: int
    robots: int = 1
    #: What the robots share: `alone` (nothing), `shared` (what they see), or a word of your choice.
    team: str = "alone"
    #: Share of the visits that repeat another robot's visit to the same cell in the same step.
    mean_repeated: float = 0.0
    steps_to_detection: int | None = None
    burning_cells_at_detection: int | None = None
    recent_steps: int | None = None
    burning_seen_share: float | None = None
    front_distance: float | None = None
    grid_seen_share: float | None = None
    #: Mean of ln P(y) over the observations y of visited cells; None in rows of Python.
    log_likelihood: float | None = None
    #: Equal for two rows if and only if model, grid, moves, robots, sensor, start and burn-in are.
    worlds_fingerprint: str = ""
    #: Processor seconds of the training for the task; only in rows of `emberwatch-agent suite`.
    training_seconds: float | None = None


#: The first line of a file.
HEADER: Final = ",".join(field.name for field in fields(Row))
_NEEDED: Final = {field.name for field in fields(Row) if field.default is MISSING}


def read(path: str | os.PathLike[str]) -> list[Row]:
    """Reads the rows of a CSV file of `evaluate` or `emberwatch-agent compare`.

    An empty file has no rows. Unknown columns are ignored.

    Raises:
        InvalidArgumentError: If the file lacks columns, or has an invalid row.
    """
    try:
        # Spreadsheets write a byte order mark.
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            lines = csv.DictReader(file)
            columns = lines.fieldnames or []
            if columns and not _NEEDED.issubset(columns):
                raise ValueError(",".join(columns))
            return [_row(line) for line in lines]
    except (ValueError, TypeError, csv.Error) as error:
        raise invalid("csv", f"{path} to have the columns {HEADER}", error) from None


def text_of(rows: Iterable[Row]) -> str:
    """Returns the text of a CSV file with these rows."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(astuple(row) for row in rows)
    return f"{HEADER}\n{text.getvalue()}"


def _row(line: dict[Any, Any]) -> Row:
    if None in line or None in line.values():  # the key None holds surplus values
        raise ValueError(f"a row with too many or too few values: {list(line.values())}")
    kinds = {"int": int, "float": float, "str": str}
    values: dict[str, Any] = {}
    for field in fields(Row):
        kind, _, optional = str(field.type).partition(" | ")
        if field.name in line:
            text = line[field.name]
            values[field.name] = None if optional and not text else kinds[kind](text)
    return Row(**values)
