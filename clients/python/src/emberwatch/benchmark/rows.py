"""Rows of the benchmark, their CSV files, and their summary."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emberwatch._native import FIRST_TRAINING_SEED
from emberwatch.common.paths import utf8
from emberwatch.errors import ExistingFileError, invalid, repr_of, shortened


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
def new_rows(path: str | os.PathLike[str] | None) -> Generator[list[Row]]:
    """Creates a file and its folder, and writes the rows of the list that it yields at the end.

    Removes the file if an exception is raised. Without a path, writes nothing.
    """
    rows: list[Row] = []
    if path is None:
        yield rows
        return
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
            yield rows
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(field.name for field in fields(Row))
            writer.writerows(astuple(row) for row in rows)
    except BaseException:
        os.unlink(whole)
        raise


def summary(rows: Sequence[Row], *, baseline: str | None = None) -> str:
    """Returns each policy's mean reward per step and its standard error over worlds, in lines.

    Args:
        rows: The rows of one or several policies.
        baseline: The name of a policy in `rows`. If given, the line of each other policy also has
            the mean difference from this policy's rewards, paired by world, with its standard
            error.
    """
    if not rows:
        raise invalid("rows", "at least one", "none")
    policies: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        policies.setdefault((row.policy, row.estimator, row.robots, row.team), []).append(row)
    bases = [each for name, each in policies.items() if name[0] == baseline]
    if baseline is not None and len(bases) != 1:
        names = ", ".join(name for name, *_ in policies)
        raise invalid("baseline", f"the name of one of the policies {names}", repr_of(baseline))
    lines: list[str] = []
    for each in policies.values():
        line = f"{each[0].policy}: {_mean([row.mean_reward for row in each], '.2f')} a step on "
        line += _worlds([row.world_seed for row in each])
        for base in bases if bases != [each] else ():
            line += f"; difference from {baseline}: {_mean(_differences(each, base), '+.2f')}"
        lines.append(line)
    return "\n".join(lines)


def _differences(rows: Sequence[Row], base: Sequence[Row]) -> list[float]:
    """Returns how much more a policy found than another one in each world."""
    rewards, others = (
        {(row.worlds_fingerprint, row.world_seed, row.steps): row.mean_reward for row in each}
        for each in (rows, base)
    )
    is_known = all(fingerprint for fingerprint, *_ in rewards)
    is_once = len(rows) == len(rewards) == len(base)
    if rewards.keys() != others.keys() or not is_once or not is_known:
        names = f"{rows[0].policy!r} and {base[0].policy!r}"
        expected = f"the same worlds_fingerprint, seeds and steps of {names}, each world once"
        raise invalid("rows", expected, "others")
    return [rewards[world] - others[world] for world in rewards]


def _mean(values: list[float], style: str) -> str:
    """Returns the mean and its standard error, which needs several values."""
    given: NDArray[np.float64] = np.array(values)
    error = f" +- {given.std(ddof=1) / math.sqrt(len(values)):.2f}" if len(values) > 1 else ""
    return f"{given.mean():{style}}{error}"


def _worlds(seeds: Sequence[int]) -> str:
    """Returns the number of worlds in words."""
    n_test = sum(seed < FIRST_TRAINING_SEED for seed in seeds)
    sort = "test " if n_test == len(seeds) else "" if n_test == 0 else f"({n_test} test) "
    return f"{len(seeds)} {sort}{'world' if len(seeds) == 1 else 'worlds'}"
