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


class RowFile:
    """A file that the rows of one policy are written to once, or appended to."""

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        append: bool,
        policy: str,
        worlds: set[tuple[str, int, int]],
    ) -> None:
        """Creates the folder, and checks that the rows can be written.

        Args:
            path: The file.
            append: Whether the file may exist.
            policy: The policy's name.
            worlds: The fingerprint, seed and number of steps of each world.

        Raises:
            ExistingFileError: If the file exists, unless `append` is true.
            InvalidArgumentError: If the file cannot be written, or has rows of the same policy or
                of other worlds, or has other columns.
        """
        # Links are resolved, as renaming a file onto a link would replace the link.
        self.path: Final = Path(os.path.realpath(utf8("csv", path)))
        self._append, self._policy, self._worlds = append, policy, worlds
        self._present()
        check_writable(self.path)

    def save(self, rows: Sequence[Row]) -> None:
        """Writes the file, with the rows that it already had first.

        Removes the partial file of an earlier evaluation.

        Raises:
            InvalidArgumentError: If the file cannot be written, or has changed meanwhile.
        """
        self._replace(self.path, [*self._present(), *rows], is_new=not self._append)
        self._partial().unlink(missing_ok=True)

    def save_partial(self, rows: Sequence[Row]) -> Path:
        """Writes the rows of an evaluation that did not finish. Returns the path of their file."""
        self._replace(self._partial(), rows, is_new=False)
        return self._partial()

    def _partial(self) -> Path:
        return self.path.with_name(f"{self.path.name}.partial")

    def _present(self) -> list[Row]:
        """Returns the rows of the file; checks that rows can be added to them."""
        if not os.path.exists(self.path):  # unlike `Path.exists`, no error if the name is too long
            return []
        if not self._append or not self.path.is_file():
            raise ExistingFileError(
                f"csv: {self.path} already exists: choose another file, or add rows to a file of "
                "rows with append=True"
            )
        with _problems(self.path, "read"):
            rows = read(self.path)
            header = self.path.read_text("utf-8-sig").partition("\n")[0].rstrip("\r")
        if header not in ("", HEADER):
            others = {*header.split(",")} ^ {*HEADER.split(",")}
            got = ", ".join(sorted(others)) or "another order"
            expected = f"{self.path} to have the columns of evaluate"
            raise invalid("csv", expected, f"other ones: {got}")
        worlds: dict[str, set[tuple[str, int, int]]] = {}
        for row in rows:
            world = (row.worlds_fingerprint, row.world_seed, row.steps)
            worlds.setdefault(row.policy, set()).add(world)
        if self._policy in worlds:
            raise invalid("name", f"one that is not in {self.path}", repr(self._policy))
        for policy, found in worlds.items():
            if found != self._worlds:
                raise InvalidArgumentError(
                    f"csv: {self.path} has rows of {policy!r} on other worlds: their seeds, steps, "
                    "model, grid, start, sensor, burn-in, moves or robots differ; choose another "
                    "file"
                )
        return rows

    def _replace(self, path: Path, rows: Sequence[Row], *, is_new: bool) -> None:
        temporary = _temporary(path)
        with _problems(self.path, "written"):
            try:
                with temporary.open("w", encoding="utf-8", newline="") as file:
                    file.write(text_of(rows))
                    file.flush()
                    os.fsync(file.fileno())
                if is_new:
                    _link(temporary, path)
                else:
                    if path.exists():
                        shutil.copymode(path, temporary)
                    temporary.replace(path)
            finally:
                temporary.unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """Creates the folder of a file, and checks that files can be written in it."""
    temporary = _temporary(path)
    with _problems(path, "written"):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
        temporary.unlink()


def _link(temporary: Path, path: Path) -> None:
    """Gives a file a second name. Fails if another process has created a file of this name."""
    try:
        os.link(temporary, path)
    except OSError:  # perhaps the file system has no hard links
        if os.path.lexists(path):
            raise
        temporary.replace(path)


@contextmanager
def _problems(path: Path, done: str) -> Generator[None]:
    """Converts system errors to errors that name the file."""
    try:
        yield
    except OSError as error:
        raise invalid("csv", f"a file that can be {done}", f"{path}: {error}") from None


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")
