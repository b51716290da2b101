"""The files that `evaluate` and `suite` write: whole, new or appended to, or partial."""

import importlib
import io
import os
import resource
import signal
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import play
from environments import LIVELY
from failures import refuses

from emberwatch.benchmark import Row, read, suite
from emberwatch.errors import ExistingFileError


def go(csv: object, name: str = "mine", policy: Any = None, **changes: Any) -> list[Row]:
    """Evaluates a policy that by default never acts."""
    policy = policy or (lambda _: pytest.fail("acts"))
    return play(policy, name, csv=csv, **{"batch": 1} | changes)


def always(move: int) -> Callable[[Any], Any]:
    return lambda frames: np.full(len(frames), move)


up = always(0)


def after(n_calls: int, call: Callable[[], object]) -> Callable[[Any], Any]:
    """Returns a policy like `up` that once calls a function; 20 calls are a world."""
    calls = iter(range(1000))

    def act(frames: Any) -> Any:
        if next(calls) == n_calls:
            call()
        return up(frames)

    return act


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "mine.csv"


def check_plays(policies: Callable[[int], Any], folder: Path) -> None:
    """Checks that policies that make one move score as functions that make this move."""
    scores = []
    for move in (3, 1):
        both = go(folder / f"{move}.csv", policy=policies(move)), go(None, policy=always(move))
        (one,) = {tuple(row.mean_reward for row in rows) for rows in both}
        scores.append(one)
    assert scores[0] != scores[1]


def test_a_policy_whose_module_was_edited_is_played(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def edited(move: int) -> Any:
        (tmp_path / "my_rules.py").write_text(f"def move(): return {move}  # edited")
        sys.modules.pop("my_rules", None)
        rules = importlib.import_module("my_rules")
        return lambda frames: np.full(len(frames), rules.move())

    check_plays(edited, tmp_path)


class Tree:
    """Imitates a decision tree, whose fitted state lies outside of its attributes."""

    def __init__(self, move: int) -> None:
        self._fitted = memoryview(bytes([move]))

    def predict(self, seen: Any) -> Any:
        return np.full(len(seen), self._fitted[0])


def test_a_fitted_tree_that_was_swapped_is_played(tmp_path: Path) -> None:
    check_plays(Tree, tmp_path)


def test_a_file_is_written_whole_and_an_existing_one_refused(file: Path) -> None:
    csv = file.parent / "new" / "mine.csv"
    rows = go(csv, policy=after(59, lambda: csv.exists() and pytest.fail("not whole")))
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
    for change in ({"n_moves": 5}, {"robots": 2}, {"steps": 6}, {"seeds": range(3, 7)}):
        with refuses("csv: .*mine.csv has rows of other worlds: their seeds, steps, model, gr"):
            go(file, "third", append=True, **change)
    assert file.read_bytes() == kept


def control_c() -> None:
    signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("stop", [control_c, lambda: 1 / 0])
def test_an_interrupted_evaluation_leaves_the_finished_rows(file: Path, stop: Any) -> None:
    cause = KeyboardInterrupt if stop is control_c else ZeroDivisionError
    whole, said = go(file, policy=up), io.StringIO()
    with pytest.raises(cause) as raised:
        go(file, "other", after(10, stop), append=True)
    assert not hasattr(raised.value, "__notes__") and list(file.parent.iterdir()) == [file]
    with pytest.raises(cause) as raised:
        go(file, "other", after(50, stop), append=True, progress=said)
    assert said.getvalue() == "other: 3 test worlds, 80 %, 0 s\n"
    assert raised.value.__notes__ == [f"2 of 3 worlds finished, their rows are in {file}.partial"]
    rows = read(f"{file}.partial")
    assert [(it.policy, it.world_seed) for it in rows] == [("other", 3), ("other", 4)]
    assert read(file) == whole and len(list(file.parent.iterdir())) == 2
    go(file, "other", up, append=True)
    assert list(file.parent.iterdir()) == [file]


def test_a_file_that_is_written_meanwhile_is_kept(file: Path) -> None:
    with pytest.raises(ExistingFileError) as raised:
        go(file, policy=after(50, file.touch))
    assert raised.value.__notes__ == [f"3 of 3 worlds finished, their rows are in {file}.partial"]
    assert read(file) == [] and len(read(f"{file}.partial")) == 3


def test_unwritable_files_are_refused_before_the_policy_acts(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    os.mkfifo(tmp_path / "pipe")
    refused = "^csv: expected a file that can be written, got .*: "
    for csv, problem in (
        ("/proc/rows.csv", refused),  # not even root can create a file there
        (tmp_path / "file/rows.csv", refused),
        (tmp_path / ("x" * 249 + ".csv"), refused),
        (tmp_path, "^csv: .* already exists"),
        ("/dev/full", "^csv: .* already exists"),
        (tmp_path / "pipe", "^csv: .* already exists"),
        ("a\x00b", "^csv: expected UTF-8"),
        (7, "^csv: expected text or a path"),
    ):
        with refuses(problem):
            go(csv, append=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "pipe"]


def test_a_full_disk_keeps_the_old_file_and_shows_the_rows(file: Path) -> None:
    go(file, policy=up)
    kept, limits = file.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    fill = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (500, limits[1]))
    try:
        with refuses("csv: expected a file that can be written, got .*: .*File too large") as full:
            go(file, "other", after(50, fill), append=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, ignored)
    assert file.read_bytes() == kept and list(file.parent.iterdir()) == [file]
    words, _, text = full.value.__notes__[0].partition(":\n")
    assert words == "3 of 3 worlds finished, their rows could not be saved"
    file.write_text(text)
    assert [row.world_seed for row in read(file)] == [3, 4, 5]


def test_files_of_other_programs_are_read(file: Path) -> None:
    rows = go(file, policy=up)
    text = file.read_text()
    file.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())  # a spreadsheet's
    rows += go(file, "other", up, append=True)
    assert read(file) == rows
    lines = zip(text.splitlines(), ("new", *"abc"), strict=True)
    file.write_text("".join(f"{line},{end}\n" for line, end in lines))
    assert read(file) == rows[:3]
    with refuses("csv: expected .*mine.csv to have the columns of evaluate, got other ones: new"):
        go(file, "other", append=True)
    bad = ("mine,none,3", "mine" + ",1" * 60, "mine,none,x" + ",1" * 20)
    for content in (*(f"{text}{line}\n" for line in bad), "policy,steps\nmine,3\n", "\x00\xff"):
        file.write_text(content, "latin-1")
        with refuses("csv: expected .*mine.csv to have the columns policy,"):
            read(file)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"tasks": ["team", "small"]}, "folder: .*small/mine.csv already exists: remove it, choos"),
        ({"name": "a b"}, "name: expected 1 to 64 letters, digits and -_./., got 'a b'"),
        ({"tasks": ["small", "small"]}, "tasks: expected tasks with different names, got small, s"),
        ({"tasks": ["ash"]}, "task ash: No such file"),
        ({"tasks": []}, "tasks: expected at least one task, got none"),
        ({"worlds": 0}, "worlds: expected an integer within 1 to 4294967295, got 0"),
        ({"policy": {"team": up}}, "policy: expected one for the task small, got team"),
    ],
)
def test_a_suite_is_refused_before_it_runs(tmp_path: Path, changes: Any, problem: str) -> None:
    (tmp_path / "small").mkdir()
    (tmp_path / "small" / "mine.csv").touch()
    chosen = {"policy": up, "name": "mine", "tasks": ["small"], "folder": tmp_path} | changes
    with refuses(problem):
        suite(**chosen)


def test_worlds_that_change_during_a_run_are_refused(tmp_path: Path) -> None:
    model = tmp_path / "model.toml"
    text = Path(LIVELY).read_text()
    model.write_text(text)
    changed = text.replace("name = ", "name = 'other' # ", 1)
    with refuses("worlds: changed since the evaluation began"):
        go(None, policy=after(0, lambda: model.write_text(changed)), model=model)


def test_a_policy_may_change_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.toml").write_bytes(Path(LIVELY).read_bytes())
    monkeypatch.chdir(tmp_path)
    moves = after(3, partial(monkeypatch.chdir, "/"))
    rows = go("rows.csv", policy=moves, model="mine.toml")
    assert len(read(tmp_path / "rows.csv")) == len(rows) > 1
