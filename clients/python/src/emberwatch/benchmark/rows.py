"""Rows of the benchmark, and their CSV files."""

from __future__ import annotations

import csv
import io
import os
import shutil
from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from dataclasses import MISSING, astuple, dataclass, fields
from pathlib import Path
from typing import Any, Final

from emberwatch.common.paths import utf8
from emberwatch.errors import (
    ExistingFileError,
    InvalidArgumentError,
    invalid,
    repr_of,
    shortened,
)


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


#: The first line of a file.
_HEADER: Final = ",".join(field.name for field in fields(Row))


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
        raise invalid("csv", f"{path} to have the columns {_HEADER}", error) from None


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


class RowFile:
    """A file that the rows of one policy are written to at once, or appended to."""

    def __init__(
        self, path: str | os.PathLike[str], policy: str, worlds: set[Any], *, append: bool
    ) -> None:
        """Creates the folder, and checks that rows can be written.

        Args:
            path: The file.
            policy: The policy's name, which must not be in the file.
            worlds: The fingerprint, seed and number of steps of each world, as in the file.
            append: Whether the file may exist.
        """
        # Links are resolved, as renaming a file onto a link would replace the link.
        self._path: Final = Path(os.path.realpath(utf8("csv", path)))
        self._partial: Final = self._path.with_name(f"{self._path.name}.partial")
        self._policy, self._worlds, self._append = policy, worlds, append
        self._present()
        check_writable(self._path)

    def save(self, rows: list[Row]) -> None:
        """Writes the file, with the rows that it already had first; checks it again."""
        _write(self._path, self._present() + rows, is_new=not self._append)
        self._partial.unlink(missing_ok=True)

    def save_partial(self, rows: list[Row]) -> str:
        """Writes rows to another file; returns where they are, or the rows if this fails."""
        done = f"{len(rows)} of {len(self._worlds)} worlds finished, their rows"
        try:
            _write(self._partial, rows, is_new=False)
        except InvalidArgumentError:
            return f"{done} could not be saved:\n{_text(rows)}"
        return f"{done} are in {self._partial}"

    def _present(self) -> list[Row]:
        """Returns the rows of the file; checks that rows can be added to them."""
        if not os.path.exists(self._path):  # unlike `Path.exists`, no error if the name is too long
            return []
        if not self._append or not self._path.is_file():
            raise ExistingFileError(
                f"csv: {self._path} already exists: choose another file, or add rows to a file of "
                "rows with append=True"
            )
        rows = read(self._path)
        header = self._path.read_text("utf-8-sig").splitlines()[0] if rows else _HEADER
        if header != _HEADER:
            others = ", ".join(sorted({*header.split(",")} ^ {*_HEADER.split(",")}))
            expected = f"{self._path} to have the columns of evaluate"
            raise invalid("csv", expected, f"other ones: {others or 'another order'}")
        if self._policy in {row.policy for row in rows}:
            raise invalid("name", f"one that is not in {self._path}", repr_of(self._policy))
        worlds = {(row.worlds_fingerprint, row.world_seed, row.steps) for row in rows}
        if rows and worlds != self._worlds:
            raise InvalidArgumentError(
                f"csv: {self._path} has rows of other worlds: their seeds, steps, model, grid, "
                "start, sensor, burn-in, moves or robots differ; choose another file"
            )
        return rows


def check_writable(path: Path) -> None:
    """Creates the folder of a file, and checks that files can be written in it."""
    with _temporary(path):
        pass


def _write(path: Path, rows: list[Row], *, is_new: bool) -> None:
    """Writes a whole file at once, with the mode of the old file. `is_new` refuses an old file."""
    with _temporary(path) as temporary:
        with temporary.open("w", encoding="utf-8", newline="") as file:
            file.write(_text(rows))
            file.flush()
            os.fsync(file.fileno())
        if is_new:
            _link(temporary, path)
        else:
            if path.exists():
                shutil.copymode(path, temporary)
            temporary.replace(path)


def _link(temporary: Path, path: Path) -> None:
    """Gives a file a second name. Fails if another process has created a file of this name."""
    try:
        os.link(temporary, path)
    except OSError:  # perhaps the file system has no hard links
        if os.path.lexists(path):
            raise
        temporary.replace(path)


def _text(rows: Iterable[Row]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(astuple(row) for row in rows)
    return f"{_HEADER}\n{text.getvalue()}"


@contextmanager
def _temporary(path: Path) -> Generator[Path]:
    """Yields a new file in the folder of a path, and removes it. System errors name the path."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
        yield temporary
    except OSError as error:
        got = f"{shortened(str(path))}: {error.strerror or error}"
        raise invalid("csv", "a file that can be written", got) from None
    finally:
        with suppress(OSError):
            temporary.unlink()
