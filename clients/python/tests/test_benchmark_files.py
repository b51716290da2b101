"""The files that `evaluate` and `suite` write: whole, new or appended to, or partial."""

import importlib
import io
import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import WORLDS
from environments import LIVELY
from failures import refuses

from emberwatch.benchmark import Row, evaluate, read, suite
from emberwatch.errors import ExistingFileError

TASK = f"""
name = "lab"
model = "{LIVELY}"
height = 7
width = 9
moves = 4
burn_in = 60
max_steps = 5
test_seeds = {{ start = 3, end = 6 }}
"""


def go(
    csv: object, name: str = "mine", policy: Callable[[Any], Any] | None = None, **changes: Any
) -> list[Row]:
    """Evaluates a policy that by default never acts."""
    keywords = {**WORLDS, "observation": "frame", "seeds": range(3, 6), "steps": 5, **changes}
    keywords = {"progress": None, "batch": 1} | keywords
    return evaluate(policy or (lambda _: pytest.fail("acts")), name=name, csv=csv, **keywords)


def up(frames: Any) -> Any:
    return np.zeros(len(frames), int)


def stops_in_the_last_world(stop: Callable[[], object]) -> Callable[[Any], Any]:
    steps = iter(range(1000))
    return lambda frames: stop() if next(steps) == 50 else up(frames)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "mine.csv"


def test_a_policy_whose_module_was_edited_is_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    for move in (3, 1):
        (tmp_path / "my_rules.py").write_text(f"def move(): return {move}  # edited")
        sys.modules.pop("my_rules", None)
        rules = importlib.import_module("my_rules")
        rows = go(tmp_path / f"{move}.csv", policy=lambda it: np.full(len(it), rules.move()))  # noqa: B023
        assert rewards(rows) == rewards(go(None, policy=lambda it: np.full(len(it), move)))  # noqa: B023
    assert rewards(read(tmp_path / "3.csv")) != rewards(rows)


class Tree:
    """Imitates a decision tree, whose fitted state lies outside of its attributes."""

    def __init__(self, move: int) -> None:
        self._fitted = memoryview(bytes([move]))

    def predict(self, seen: Any) -> Any:
        return np.full(len(seen), self._fitted[0])


def test_a_fitted_tree_that_was_swapped_is_played(tmp_path: Path) -> None:
    rows = [rewards(go(tmp_path / f"{move}.csv", policy=Tree(move))) for move in (3, 1)]
    assert rows == [rewards(go(None, policy=Tree(move))) for move in (3, 1)]
    assert rows[0] != rows[1]


def rewards(rows: list[Row]) -> list[float]:
    return [row.mean_reward for row in rows]


def test_a_file_is_written_whole_and_an_existing_one_refused(file: Path) -> None:
    csv = file.parent / "new" / "mine.csv"

    def act(frames: Any) -> Any:
        assert not csv.exists()
        return up(frames)

    rows = go(csv, policy=act)
    assert read(csv) == rows and os.listdir(csv.parent) == ["mine.csv"]
    file.touch()
    assert csv.stat().st_mode == file.stat().st_mode
    kept = csv.read_bytes()
    with refuses("csv: .*mine.csv already exists: choose another file, or add rows") as refused:
        go(csv)
    assert isinstance(refused.value, FileExistsError) and csv.read_bytes() == kept


def test_other_policies_are_appended(file: Path, tmp_path: Path) -> None:
    first = go(file, policy=up, append=True)
    file.chmod(0o640)
    link = tmp_path / "link.csv"
    link.symlink_to(file)
    second = go(link, "other", up, append=True, batch=3)
    assert read(file) == first + second and link.is_symlink()
    assert file.stat().st_mode & 0o777 == 0o640
    kept = file.read_bytes()
    with refuses("name: expected one that is not in .*mine.csv, got 'other'"):
        go(file, "other", append=True)
    changes: list[dict[str, Any]] = [{"n_moves": 5}, {"robots": 2}, {"start": "centre"}]
    for change in (*changes, {"steps": 6}, {"seeds": range(3, 7)}, {"burn_in": 61}):
        with refuses("csv: .*mine.csv has rows of '(mine|other)' on other worlds: their seeds, st"):
            go(file, "third", append=True, **change)
    assert file.read_bytes() == kept


def test_a_file_that_is_written_meanwhile_is_kept(file: Path) -> None:
    go(file.with_name("other.csv"), "other", up)

    def act(frames: Any) -> Any:
        file.write_bytes(file.with_name("other.csv").read_bytes())
        return up(frames)

    with pytest.raises(ExistingFileError) as raised:
        go(file, policy=act)
    assert raised.value.__notes__ == [f"3 of 3 worlds finished, their rows are in {file}.partial"]
    assert {row.policy for row in read(file)} == {"other"}
    assert len(read(f"{file}.partial")) == 3


def test_an_interrupted_evaluation_leaves_the_finished_rows(file: Path) -> None:
    whole, said = go(file, policy=up), io.StringIO()
    note = f"2 of 3 worlds finished, their rows are in {file}.partial"

    def check(error: BaseException) -> None:
        assert error.__notes__ == [note]
        rows = read(f"{file}.partial")
        assert [(it.policy, it.world_seed) for it in rows] == [("other", 3), ("other", 4)]
        assert read(file) == whole and len(list(file.parent.iterdir())) == 2
        Path(f"{file}.partial").unlink()

    with pytest.raises(ZeroDivisionError) as raised:
        policy = stops_in_the_last_world(lambda: 1 / 0)
        go(file, "other", policy, append=True, progress=said)
    check(raised.value)
    assert f"other: 3 test worlds, 0 s, stopped: {note}\n" in said.getvalue()
    with pytest.raises(KeyboardInterrupt) as stopped:
        go(file, "other", stops_in_the_last_world(interrupt), append=True)
    check(stopped.value)
    Path(f"{file}.partial").touch()
    go(file, "third", up, append=True)
    with pytest.raises(ZeroDivisionError) as raised:
        go(None, policy=stops_in_the_last_world(lambda: 1 / 0))
    with pytest.raises(ZeroDivisionError):
        go(file, "other", lambda _: 1 / 0, append=True)
    assert not hasattr(raised.value, "__notes__") and list(file.parent.iterdir()) == [file]


def interrupt() -> None:
    signal.raise_signal(signal.SIGINT)


def test_unwritable_files_are_refused_before_the_policy_acts(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    os.mkfifo(tmp_path / "pipe")
    too_long = tmp_path / ("x" * 249 + ".csv")
    for append in (False, True):
        # Not even root can create a file in /proc.
        for csv in ("/proc/rows.csv", tmp_path / "file/rows.csv", too_long):
            with refuses("^csv: expected a file that can be written, got .*: "):
                go(csv, append=append)
        for csv in (tmp_path, "/dev/full", tmp_path / "pipe"):
            with refuses("^csv: .* already exists"):
                go(csv, append=append)
        for csv in ("a\x00b", 7):
            with refuses("^csv: expected "):
                go(csv, append=append)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "pipe"]


def test_a_full_disk_keeps_the_old_file_and_shows_the_rows(file: Path) -> None:
    go(file, policy=up)
    kept, limits = file.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

    def fill(frames: Any) -> Any:
        resource.setrlimit(resource.RLIMIT_FSIZE, (500, limits[1]))
        return up(frames)

    try:
        with refuses("csv: expected a file that can be written, got .*: .*File too large") as full:
            go(file, "other", fill, append=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, ignored)
    assert file.read_bytes() == kept and list(file.parent.iterdir()) == [file]
    words, _, text = full.value.__notes__[0].partition(":\n")
    assert words == "3 of 3 worlds finished, their rows could not be saved"
    (file.parent / "rescued.csv").write_text(text)
    assert [row.world_seed for row in read(file.parent / "rescued.csv")] == [3, 4, 5]


def test_files_of_other_programs_are_read(file: Path) -> None:
    rows = go(file, policy=up)
    text = file.read_text()
    file.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())  # a spreadsheet's
    rows += go(file, "other", up, append=True)
    assert read(file) == rows
    lines = [
        f"{line},{end}\n" for line, end in zip(text.splitlines(), ("new", *"abc"), strict=True)
    ]
    file.write_text("".join(lines))
    assert read(file) == rows[:3]
    with refuses("csv: expected .*mine.csv to have the columns of evaluate, got other ones: new"):
        go(file, "other", append=True)
    bad = ("mine,none,3", "mine" + ",1" * 60, "mine,none,x" + ",1" * 20)
    for content in (*(f"{text}{line}\n" for line in bad), "policy,steps\nmine,3\n", "\x00\xff"):
        file.write_text(content, "latin-1")
        with refuses("csv: expected .*mine.csv to have the columns policy,"):
            read(file)


def test_a_suite_writes_one_file_for_each_task_and_policy(tmp_path: Path) -> None:
    source, folder = tmp_path / "task.toml", tmp_path / "out"
    source.write_text(TASK)
    keywords: dict[str, Any] = {"folder": folder, "observation": "frame", "progress": None}
    for name, stem in (("mine", "mine"), ("known+x/beam", "known_x_beam")):
        rows = suite(up, name=name, tasks=[source], **keywords)
        assert list(rows) == ["lab"] and read(folder / "lab" / f"{stem}.csv") == rows["lab"]
        assert [(row.world_seed, row.steps) for row in rows["lab"]] == [(3, 5), (4, 5), (5, 5)]
    with refuses("folder: .*lab/mine.csv already exists: remove it, choose another name or fol"):
        suite(lambda _: pytest.fail("acts"), name="mine", tasks=["small", source], **keywords)
    for name in ("", "x" * 65, "a b", "ä", "a\n", 7):
        with refuses("name: expected 1 to 64 letters, digits and -_./., got "):
            suite(up, name=name, tasks=[source], **keywords)
    with refuses("tasks: expected tasks with different names, got small, small"):
        suite(up, name="new", tasks=["small", "small"], **keywords)
    with refuses("tasks: expected at least one task, got none"):
        suite(up, name="new", tasks=[], **keywords)
    with refuses("append: expected a file in csv, got none"):
        go(None, append=True)
    with refuses("append: suite sets it; leave it out"):
        suite(up, name="new", append=True, **keywords)


def test_worlds_that_change_during_a_run_are_refused(tmp_path: Path) -> None:
    model = tmp_path / "model.toml"
    text = Path(LIVELY).read_text()
    model.write_text(text)

    def rewrites(frames: Any) -> Any:
        model.write_text(text.replace("name = ", "name = 'other' # ", 1))
        return up(frames)

    with refuses("worlds: changed since the evaluation began"):
        go(None, policy=rewrites, model=model)
