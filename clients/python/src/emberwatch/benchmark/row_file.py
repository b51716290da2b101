"""A CSV file of rows that several processes, of Python and of the agent, may write to at once."""

from __future__ import annotations

import os
import stat
import sys
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, NamedTuple, Self

from emberwatch.benchmark.rows import Row, read, write
from emberwatch.common.arguments import repr_of
from emberwatch.common.paths import utf8
from emberwatch.errors import InvalidArgumentError, invalid

#: Seconds to wait for another writer, and seconds between attempts. Writers hold the lock for
#: milliseconds, but `emberwatch-agent compare --csv` holds it until it ends.
_PATIENCE: Final = 60.0
_INTERVAL: Final = 0.02


class Mark(NamedTuple):
    """The properties of a row that decide whether an evaluation can reuse it."""

    worlds_fingerprint: str
    policy_fingerprint: str
    steps: int
    recent_steps: int | None

    @classmethod
    def of(cls, row: Row) -> Self:
        """Returns these properties of a row."""
        return cls(row.worlds_fingerprint, row.policy_fingerprint, row.steps, row.recent_steps)


class Kind(NamedTuple):
    """A policy in one kind of team. A file has at most one row of each kind for each world."""

    policy: str
    robots: int
    team: str

    @classmethod
    def of(cls, row: Row) -> Self:
        """Returns the policy of a row and its kind of team."""
        return cls(row.policy, row.robots, row.team)


@dataclass(frozen=True, slots=True)
class Found:
    """The rows of a policy that are in a file."""

    #: Rows with the same worlds, policy and settings, by seed.
    kept: dict[int, Row]
    #: Rows with the policy's name that come from another policy, other settings or other worlds.
    stale: tuple[Row, ...]
    #: If the file is a cache: names of other policies whose rows are on other or unknown worlds.
    elsewhere: tuple[str, ...]


class RowFile:
    """Rows in a CSV file. Each change locks the file, rereads it, and replaces it as a whole.

    The lock is `flock` on the file itself, so that no writer overwrites another writer's rows.
    """

    def __init__(self, path: str | os.PathLike[str], *, is_cache: bool = False) -> None:
        """Stores the path; does not open the file.

        Args:
            path: The file, which may be missing or empty.
            is_cache: Whether to accept rows on other worlds. If so, such rows of the policy are
                replaced, and such rows of other policies stay. Otherwise, a file with such rows is
                refused.
        """
        if not isinstance(path, str | os.PathLike):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise invalid("csv", "the path of a file", repr_of(path))
        # Links are resolved, as renaming a file onto a link would replace the link.
        self.path: Final = Path(os.path.realpath(utf8("csv", path)))
        self._is_cache: Final = is_cache
        self._kind: Kind | None = None
        self._mark: Mark | None = None
        #: Marks of the policy's rows that new rows will replace.
        self._stale: set[Mark] = set()
        self._rows: list[Row] = []
        self._is_new = False

    def __enter__(self) -> Self:
        """Reads the rows, and checks that the file can be replaced."""
        with self._problems():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._is_new = not self.path.exists()
            try:
                with self._locked():
                    self._rows = read(self.path)
                    # Detects a folder without write access now, instead of after the evaluation.
                    self._temporary.touch()
                    self._temporary.unlink()
            except OSError:
                self._remove_empty()
                raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Removes the file if it was created here and has no rows."""
        with self._problems():
            self._remove_empty()

    def find(self, kind: Kind, mark: Mark) -> Found:
        """Finds the rows of a policy in the file, and selects this policy for `add`.

        Raises:
            InvalidArgumentError: If the file is not a cache, and has rows of other worlds, or rows
                of the policy with other numbers of steps.
        """
        self._kind, self._mark = kind, mark
        own = [row for row in self._rows if self._is_own(row)]
        if not self._is_cache:
            self._check_worlds(self._rows)
            self._check_steps(own, mark)
        kept = {row.world_seed: row for row in own if Mark.of(row) == mark}
        stale = tuple(row for row in own if Mark.of(row) != mark)
        self._stale = {Mark.of(row) for row in stale}
        others = [row for row in self._rows if not self._is_own(row) and self._is_cache]
        elsewhere = {row.policy for row in others if not self._is_of_worlds(row)}
        return Found(kept, stale, tuple(sorted(elsewhere)))

    def add(self, rows: Sequence[Row]) -> None:
        """Adds rows, and drops all rows of the policy whose mark differs.

        Raises:
            InvalidArgumentError: If another process has meanwhile written conflicting rows, or if
                the file cannot be written.
        """
        seeds = {row.world_seed for row in rows}
        with self._problems(), self._locked() as descriptor:
            present = read(self.path)
            self._check_meanwhile(present, rows)
            others = [
                row
                for row in present
                if not self._is_own(row)
                or (Mark.of(row) == self._mark and row.world_seed not in seeds)
            ]
            merged = sorted(
                [*others, *rows],
                key=lambda row: (row.policy, row.world_seed, row.estimator, row.robots, row.team),
            )
            self._replace(merged, os.fstat(descriptor).st_mode)

    @property
    def _temporary(self) -> Path:
        """The path of the temporary file, which only the holder of the lock uses."""
        return self.path.with_name(f".{self.path.name}.tmp")

    def _remove_empty(self) -> None:
        if self._is_new and self.path.exists():
            with self._locked() as descriptor:
                if os.fstat(descriptor).st_size == 0:
                    self.path.unlink()

    def _replace(self, rows: Sequence[Row], mode: int) -> None:
        try:
            with self._temporary.open("w", newline="", encoding="utf-8") as file:
                os.fchmod(file.fileno(), stat.S_IMODE(mode))
                write(file, rows)
            self._temporary.replace(self.path)
        except OSError:
            self._temporary.unlink(missing_ok=True)
            raise

    def _is_own(self, row: Row) -> bool:
        return Kind.of(row) == self._kind

    def _is_of_worlds(self, row: Row) -> bool:
        return self._mark is not None and row.worlds_fingerprint == self._mark.worlds_fingerprint

    def _check_worlds(self, rows: Sequence[Row]) -> None:
        """Refuses rows of other worlds, and rows of the policy without a fingerprint of worlds."""
        wrong = [row for row in rows if row.worlds_fingerprint and not self._is_of_worlds(row)]
        if wrong:
            names = ", ".join(sorted({repr(row.policy) for row in wrong}))
            raise InvalidArgumentError(
                f"csv: {self.path} has {len(wrong)} rows of other worlds, of the policies "
                f"{names}: their model, grid, start, sensor, burn-in, moves or robots differ; "
                "choose another file"
            )
        old = [row.policy for row in rows if self._is_own(row) and not row.worlds_fingerprint]
        if old:
            raise InvalidArgumentError(
                f"csv: {self.path} has rows of {old[0]!r} from an older release, without a "
                "fingerprint of their worlds: choose another file or name"
            )

    def _check_steps(self, own: Sequence[Row], mark: Mark) -> None:
        for row in own:
            for what in ("steps", "recent_steps"):
                got, expected = getattr(row, what), getattr(mark, what)
                if got != expected:
                    raise InvalidArgumentError(
                        f"csv: {self.path} has {what} {got} of {row.policy!r} on world "
                        f"{row.world_seed}, expected {expected}: choose another file or name"
                    )

    def _check_meanwhile(self, present: Sequence[Row], rows: Sequence[Row]) -> None:
        """Refuses conflicting rows that other processes have written since `find`."""
        own = {Mark.of(row) for row in present if self._is_own(row)}
        if self._mark is not None and own - self._stale - {self._mark}:
            raise InvalidArgumentError(
                f"csv: another process has written rows of {rows[0].policy!r} to {self.path}, from "
                "another policy or with other settings: choose another file or name"
            )
        if self._is_cache:
            return
        self._check_worlds(present)
        fire = {(row.world_seed, row.steps): row.mean_fire_cells for row in rows}
        for row in present:  # rows of older releases have no fingerprint
            expected = fire.get((row.world_seed, row.steps), row.mean_fire_cells)
            if not row.worlds_fingerprint and row.mean_fire_cells != expected:
                raise InvalidArgumentError(
                    f"csv: {self.path} has {row.mean_fire_cells} burning cells in world "
                    f"{row.world_seed} ({row.policy!r}), got {expected}: another model, grid or "
                    "burn-in; choose another file"
                )

    @contextmanager
    def _locked(self) -> Generator[int]:
        """Locks the file, which is created if it is missing; yields its descriptor."""
        deadline = time.monotonic() + _PATIENCE
        if sys.platform == "win32":
            raise InvalidArgumentError(
                "csv: writing needs a system with flock, such as Linux, got Windows"
            )
        while True:
            # Without O_NONBLOCK, opening a pipe would block.
            flags = os.O_RDWR | os.O_CREAT | os.O_NONBLOCK
            descriptor = os.open(self.path, flags, 0o666)
            try:
                self._check_regular(descriptor)
                self._lock(descriptor, deadline)
                if self._is_named(descriptor):
                    yield descriptor
                    return
            finally:
                os.close(descriptor)

    def _lock(self, descriptor: int, deadline: float) -> None:
        while True:
            try:
                import fcntl  # not on Windows

                return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise InvalidArgumentError(
                        f"csv: another process has held {self.path} for {_PATIENCE:g} s, such as "
                        "`emberwatch-agent compare --csv`: wait until it ends, or choose another "
                        "file"
                    ) from None
            time.sleep(_INTERVAL)

    def _is_named(self, descriptor: int) -> bool:
        """Returns whether the path still names the open file, which a writer may have replaced."""
        try:
            return os.path.samestat(os.fstat(descriptor), os.stat(self.path))
        except FileNotFoundError:
            return False

    def _check_regular(self, descriptor: int) -> None:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise invalid("csv", "a regular file", f"{self.path}, which is a device or a pipe")

    @contextmanager
    def _problems(self) -> Generator[None]:
        """Converts system errors to errors that name the file."""
        try:
            yield
        except OSError as error:
            got = f"the folder {self.path}" if self.path.is_dir() else f"{self.path}"
            if error.filename not in (None, str(self.path), str(self._temporary)):
                got += f", in {error.filename}"
            expected = "a file that can be written"
            raise invalid("csv", expected, f"{got}: {error.strerror or error}") from None
