"""Rows of the benchmark, and the CSV files that hold them."""

from __future__ import annotations

import csv
import itertools
import os
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any, Final

from emberwatch.errors import InvalidArgumentError, invalid


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


_HEADER: Final = [field.name for field in fields(Row)]
#: The same of older files: without likelihoods, figures of merit, or teams.
_HEADERS: Final = [
    _HEADER[: _HEADER.index(end)] for end in ("log_likelihood", "steps_to_detection", "robots")
]


class RowFile:
    """Rows in a CSV file, which is replaced whole whenever some are added."""

    def __init__(self, path: Path) -> None:
        self._path = path
        if path.is_dir():
            raise invalid("csv", "a file", f"the folder {path}")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._rows = read(path) if path.exists() else []

    def done(
        self, kind: tuple[str, str, int, str], steps: int, n_moves: int, recent_steps: int
    ) -> dict[int, Row]:
        """What a policy has done already, by seed."""
        own = [
            row for row in self._rows if (row.policy, row.estimator, row.robots, row.team) == kind
        ]
        for row in own:
            if (row.steps, row.moves) != (steps, n_moves):
                raise InvalidArgumentError(
                    f"csv: {self._path} has {row.steps} steps of {row.moves} moves of "
                    f"{row.policy!r} on world {row.world_seed}, expected {steps} of "
                    f"{n_moves}: choose another file or name"
                )
            if row.recent_steps not in (None, recent_steps):
                raise InvalidArgumentError(
                    f"csv: {self._path} has recent_steps {row.recent_steps} of {row.policy!r}, "
                    f"expected {recent_steps}: choose another file or name"
                )
        return {row.world_seed: row for row in own}

    def add(self, rows: Sequence[Row]) -> None:
        for row, other in itertools.product(rows, self._rows):
            same = (row.world_seed, row.steps) == (other.world_seed, other.steps)
            if same and row.mean_fire_cells != other.mean_fire_cells:
                raise InvalidArgumentError(
                    f"csv: {self._path} has {other.mean_fire_cells} burning cells of world "
                    f"{row.world_seed} ({other.policy!r}), got {row.mean_fire_cells} (another "
                    "model, grid or burn-in): choose another file"
                )
        self._rows += rows
        self._rows.sort(
            key=lambda row: (row.policy, row.world_seed, row.estimator, row.robots, row.team)
        )
        temporary = self._path.with_name(f".{self._path.name}.{os.getpid()}.tmp")
        with temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(_HEADER)
            writer.writerows(astuple(row) for row in self._rows)
        temporary.replace(self._path)


def read(path: str | os.PathLike[str]) -> list[Row]:
    """The rows of a CSV file of `evaluate` or `emberwatch-agent compare`."""
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            lines = csv.DictReader(file)
            if lines.fieldnames not in (_HEADER, *_HEADERS):
                raise ValueError(lines.fieldnames)
            return [_row(line) for line in lines]
    except (ValueError, TypeError) as error:
        raise invalid("csv", f"{path} to have the columns {','.join(_HEADER)}", error) from None


def _row(line: dict[str, Any]) -> Row:
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
