"""Rows of the benchmark, and their CSV files."""

from __future__ import annotations

import csv
import os
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from dataclasses import MISSING, astuple, dataclass, fields
from pathlib import Path
from typing import Any, TextIO

from emberwatch.common.paths import utf8
from emberwatch.errors import ExistingFileError, invalid, shortened


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The score of a policy on one world: a line of the CSV file of `emberwatch-agent compare`.

    Means are over the scored steps, of all robots together. None means that there was nothing to
    measure, or that the file has no such column. The figures of merit, from `steps_to_detection`
    to `grid_seen_share`, are defined in docs/figures-of-merit.md.
    """

    policy: str
    #: The policy's belief: `none`, `known`, or a name of your choice.
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
    burning_seen_share: float | None = None
    front_distance: float | None = None
    grid_seen_share: float | None = None
    #: Mean of ln P(y) over the observations y of visited cells; None in rows of Python.
    log_likelihood: float | None = None
    #: Equal for two rows if and only if model, grid, moves, robots, sensor, start and burn-in are.
    worlds_fingerprint: str = ""
    #: Processor seconds of the training for the task; only in rows of `emberwatch-agent suite`.
    training_seconds: float | None = None


def read(path: str | os.PathLike[str]) -> list[Row]:
    """Reads the rows of a CSV file of `evaluate` or `emberwatch-agent compare`.

    An empty file has no rows. Unknown columns are ignored.

    Raises:
        InvalidArgumentError: If the file lacks columns, or has an invalid row.
    """
    try:
        # Spreadsheets write a byte order mark.
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            return [_row(line) for line in csv.DictReader(file)]
    except (ValueError, csv.Error) as error:
        columns = ",".join(field.name for field in fields(Row))
        raise invalid("csv", f"{path} to have the columns {columns}", error) from None


def _row(line: dict[Any, Any]) -> Row:
    if None in line or None in line.values():  # the key None holds surplus values
        raise ValueError(f"a row with too many or too few values: {list(line.values())}")
    kinds = {"int": int, "float": float, "str": str}
    values: dict[str, Any] = {}
    for field in fields(Row):
        kind, _, optional = str(field.type).partition(" | ")
        text = line.get(field.name)
        if text is not None:
            values[field.name] = None if optional and not text else kinds[kind](text)
        elif field.default is MISSING:
            raise ValueError(f"no column {field.name}")
    return Row(**values)


@contextmanager
def new_file(path: str | os.PathLike[str]) -> Generator[TextIO]:
    """Creates a file and its folder. Removes the file if an exception is raised."""
    whole = os.path.abspath(utf8("csv", path))
    try:
        os.makedirs(os.path.dirname(whole), exist_ok=True)
        file = open(whole, "x", encoding="utf-8", newline="")
    except FileExistsError as error:
        raise ExistingFileError(
            f"csv: {error.filename} already exists: choose another file"
        ) from None
    except OSError as error:
        got = f"{shortened(whole)}: {error.strerror}"
        raise invalid("csv", "a file that can be written", got) from None
    try:
        with file:
            yield file
    except BaseException:
        os.unlink(whole)
        raise


def write(rows: Iterable[Row], file: TextIO) -> None:
    """Writes a file of rows."""
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(field.name for field in fields(Row))
    writer.writerows(astuple(row) for row in rows)
