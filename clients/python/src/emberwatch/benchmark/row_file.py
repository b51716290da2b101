"""The CSV file of an evaluation, written whole after the last world."""

from __future__ import annotations

import os
import shutil
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from emberwatch.benchmark.rows import HEADER, Row, read, text_of
from emberwatch.common.paths import utf8
from emberwatch.errors import ExistingFileError, InvalidArgumentError, invalid

#: What identifies a world and its scored steps: fingerprint, seed, number of steps.
World = tuple[str, int, int]


class RowFile:
    """A file that rows are written to once."""

    def __init__(self, path: str | os.PathLike[str], *, append: bool) -> None:
        """Creates the folder, and checks that the file can be written.

        Raises:
            ExistingFileError: If the file exists, unless `append` is true.
            InvalidArgumentError: If the file cannot be written.
        """
        # Links are resolved, as renaming a file onto a link would replace the link.
        self.path: Final = Path(os.path.realpath(utf8("csv", path)))
        self._append: Final = append
        self._check_new()
        temporary = _temporary(self.path)
        with self._problems():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            temporary.touch()
            temporary.unlink()

    def check(self, policy: str, worlds: set[World]) -> list[Row]:
        """Returns the rows of the file, to which rows of a policy on these worlds can be added.

        Raises:
            ExistingFileError: If the file exists, unless `append` is true.
            InvalidArgumentError: If the file has the policy's name, other worlds or other columns.
        """
        self._check_new()
        if not os.path.exists(self.path):
            return []
        with self._problems():
            rows = read(self.path)
            if self.path.read_text("utf-8-sig").splitlines()[:1] not in ([], [HEADER]):
                raise invalid("csv", f"{self.path} to have the columns {HEADER}", "others")
        names = {row.policy for row in rows}
        if policy in names:
            raise invalid("name", f"one that is not in {self.path}", repr(policy))
        for name in names:
            if {world_of(row) for row in rows if row.policy == name} != worlds:
                raise InvalidArgumentError(
                    f"csv: {self.path} has rows of {name!r} on other worlds: their seeds, steps, "
                    "model, grid, start, sensor, burn-in, moves or robots differ; choose another "
                    "file"
                )
        return rows

    def save(self, rows: Sequence[Row]) -> None:
        """Writes the file, with the rows that it already had first.

        Raises:
            InvalidArgumentError: If the file cannot be written, or has changed since `check`.
        """
        present = self.check(rows[0].policy, {world_of(row) for row in rows})
        self._replace(self.path, [*present, *rows], is_new=not self._append)

    def save_partial(self, rows: Sequence[Row]) -> Path:
        """Writes the rows of an evaluation that did not finish. Returns the path of their file."""
        path = self.path.with_name(f"{self.path.name}.partial")
        self._replace(path, rows, is_new=False)
        return path

    def _check_new(self) -> None:
        # Unlike `Path.exists`, this is False for names that are too long.
        if os.path.exists(self.path) and not (self._append and self.path.is_file()):
            raise ExistingFileError(
                f"csv: {self.path} already exists: choose another file, or add rows to a file of "
                "rows with append=True"
            )

    def _replace(self, path: Path, rows: Sequence[Row], *, is_new: bool) -> None:
        temporary = _temporary(path)
        with self._problems():
            try:
                temporary.write_text(text_of(rows), encoding="utf-8", newline="")
                if is_new:
                    path.touch(exist_ok=False)  # another process may have written it meanwhile
                elif path.exists():
                    shutil.copymode(path, temporary)
                temporary.replace(path)
            finally:
                temporary.unlink(missing_ok=True)

    @contextmanager
    def _problems(self) -> Generator[None]:
        """Converts system errors to errors that name the file."""
        try:
            yield
        except OSError as error:
            got = f"{self.path}: {error}"
            raise invalid("csv", "a file that can be written", got) from None


def world_of(row: Row) -> World:
    """Returns the world of a row."""
    return row.worlds_fingerprint, row.world_seed, row.steps


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")
