"""CSV files of rows: written by several processes, and files that cannot be written."""

import fcntl
import itertools
import os
import resource
import signal
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import WORLDS
from environments import LIVELY
from failures import refuses
from processes import script

from emberwatch.benchmark import Row, evaluate, read, row_file
from emberwatch.benchmark.row_file import Kind, Mark, RowFile

WRITER = """
import sys, numpy as np
from emberwatch.benchmark import evaluate
name, csv, model = sys.argv[1:]
sys.stdin.readline()  # so that both begin together
evaluate(
    lambda frames: np.ones(len(frames), int), name=name, csv=csv, seeds=range(20), batch=1, steps=3,
    model=model, height=7, width=9, n_moves=4, burn_in=60, observation="frame", progress=None,
)
print("done")
"""


def row(policy: str, seed: int, **changes: Any) -> Row:
    values: dict[str, Any] = {
        **{"policy": policy, "estimator": "none", "world_seed": seed, "steps": 5},
        **{"mean_reward": 0.5, "mean_distinct_cells": 4.0, "hit_rate": 0.1, "mean_fire_cells": 9.0},
        **{"mean_plan_millis": 0.1, "brier": "", "moves": 4, "recent_steps": 10},
        **{"worlds_fingerprint": "ab" * 8, "policy_fingerprint": "cd" * 8},
    }
    return Row(**values | changes)


MARK = Mark.of(row("mine", 0))


def opened(path: Path, policy: str = "mine", mark: Mark = MARK) -> RowFile:
    """Opens a file and searches it for the rows of a policy."""
    file = RowFile(path)
    with file:
        file.find(Kind(policy, 1, "alone"), mark)
    return file


def calls_of(csv: object) -> int:
    """Returns how often a policy acts before a file is refused."""
    calls = itertools.count()

    def still(frames: Any) -> Any:
        next(calls)
        return np.zeros(len(frames), int)

    keywords = {**WORLDS, "observation": "frame", "seeds": [3], "steps": 2, "progress": None}
    with refuses("^csv: expected "):
        evaluate(still, name="mine", csv=csv, **keywords)
    return next(calls)


def test_two_processes_writing_one_file_lose_no_rows(tmp_path: Path) -> None:
    file = tmp_path / "rows.csv"
    writers = [script(WRITER, name, file, LIVELY) for name in ("first", "second")]
    for writer in writers:
        writer.say()
    assert [writer.line() for writer in writers] == ["done"] * 2
    assert Counter(row.policy for row in read(file)) == {"first": 20, "second": 20}


def test_rows_written_meanwhile_are_kept_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    first, second = opened(path), opened(path, mark=MARK._replace(policy_fingerprint="ef" * 8))
    first.add([row("mine", 0)])
    with refuses("csv: another process has written rows of 'mine' to .*, from another policy or"):
        second.add([row("mine", 0, policy_fingerprint="ef" * 8)])
    first.add([row("mine", 1)])
    assert read(path) == [row("mine", 0), row("mine", 1)]
    # Two halves of an evaluation may run at once; rows of other worlds are refused.
    path = tmp_path / "halves.csv"
    halves = opened(path), opened(path)
    for seed, half in enumerate(halves * 2):
        half.add([row("mine", seed)])
    assert [row.world_seed for row in read(path)] == [0, 1, 2, 3]
    path = tmp_path / "worlds.csv"
    mine = opened(path)
    other = MARK._replace(worlds_fingerprint="00" * 8)
    opened(path, "other", other).add([row("other", 3, worlds_fingerprint="00" * 8)])
    with refuses("has 1 rows of other worlds, of the policies 'other'"):
        mine.add([row("mine", 0)])
    assert [row.policy for row in read(path)] == ["other"]


def test_a_file_locked_by_another_process_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(row_file, "_PATIENCE", 0.1)
    path = tmp_path / "rows.csv"
    with path.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with refuses("csv: another process has held .*rows.csv for 0.1 s"):
            opened(path)
    opened(path)


def test_a_replaced_file_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    mine = opened(path)
    path.touch()
    with path.open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        thread = threading.Thread(target=mine.add, args=([row("mine", 0)],))
        thread.start()
        replacement = tmp_path / "replacement"
        with replacement.open("w") as file:
            row_file.write(file, [row("other", 0)])
        replacement.replace(path)
    thread.join()
    assert [row.policy for row in read(path)] == ["mine", "other"]


def test_unwritable_files_are_refused_before_the_policy_acts(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    os.mkfifo(tmp_path / "pipe")
    no_place_for_a_second = tmp_path / ("x" * 251 + ".csv")
    names = "/proc/rows.csv", "/dev/full", "/dev/null", "a\x00b", 7, tmp_path
    for csv in (*names, tmp_path / "file/rows.csv", tmp_path / "pipe", no_place_for_a_second):
        assert calls_of(csv) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "pipe"]


def test_a_full_disk_is_reported_and_keeps_old_rows(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    file = opened(path)
    file.add([row("mine", 0)])
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
        with refuses("csv: expected a file that can be written, got .*rows.csv: File too large"):
            file.add([row("mine", seed) for seed in range(1, 50)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, ignored)
    assert read(path) == [row("mine", 0)] and list(tmp_path.iterdir()) == [path]


def test_a_run_without_rows_leaves_no_file(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    keywords = {**WORLDS, "observation": "frame", "seeds": [3], "steps": 2, "progress": None}
    with pytest.raises(ZeroDivisionError):
        evaluate(lambda _: 1 / 0, name="mine", csv=path, **keywords)
    assert not path.exists()
    # An empty file that existed before has no rows, and is kept.
    path.touch()
    assert read(path) == []
    with pytest.raises(ZeroDivisionError):
        evaluate(lambda _: 1 / 0, name="mine", csv=path, **keywords)
    assert path.exists()


def test_links_and_file_modes_are_preserved(tmp_path: Path) -> None:
    path, link = tmp_path / "rows.csv", tmp_path / "link.csv"
    path.touch(0o640)
    link.symlink_to(path)
    opened(link).add([row("mine", 0)])
    assert link.is_symlink() and read(path) == [row("mine", 0)]
    assert path.stat().st_mode & 0o777 == 0o640
