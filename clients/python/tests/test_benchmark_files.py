"""The files that `evaluate` and `suite` write: whole and new."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import play
from failures import refuses

from emberwatch.benchmark import Row, read, suite


def go(csv: object, name: str = "mine", policy: Any = None, **changes: Any) -> list[Row]:
    """Evaluates a policy that by default never acts."""
    policy = policy or (lambda _: pytest.fail("acts"))
    return play(policy, name, csv=csv, **{"batch": 1} | changes)


def up(frames: Any) -> Any:
    return np.zeros(len(frames), int)


def test_rows_are_read_as_they_were_written(tmp_path: Path) -> None:
    file = tmp_path / "new" / "mine.csv"
    rows = go(file, policy=up)
    assert read(file) == rows and os.listdir(file.parent) == ["mine.csv"]
    kept = file.read_bytes()
    with refuses("csv: .*mine.csv already exists: choose another file") as refused:
        go(file)
    assert isinstance(refused.value, FileExistsError) and file.read_bytes() == kept
    text = file.read_text()
    file.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())  # a spreadsheet's
    assert read(file) == rows
    lines = zip(text.splitlines(), ("new", *"abc"), strict=True)
    file.write_text("".join(f"{line},{end}\n" for line, end in lines))
    assert read(file) == rows, "a new column"
    bad = ("mine,none,3", "mine" + ",1" * 60, "mine,none,x" + ",1" * 20)
    for content in (*(f"{text}{line}\n" for line in bad), "policy,steps\nmine,3\n", "\x00\xff"):
        file.write_text(content, "latin-1")
        with refuses("csv: expected .*mine.csv to have the columns policy,"):
            read(file)


def test_an_evaluation_that_ends_early_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def stop(_: Any) -> None:
        os.chdir("/")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        go("mine.csv", policy=stop)
    assert not list(tmp_path.iterdir())


def test_unwritable_files_are_refused_before_the_policy_acts(tmp_path: Path) -> None:
    for csv, problem in (
        ("/proc/rows.csv", "^csv: expected a file that can be written, got /proc/rows.csv: "),
        (tmp_path, "^csv: .* already exists"),
        (7, "^csv: expected text or a path"),
    ):
        with refuses(problem):
            go(csv)


def test_a_suite_writes_a_file_for_each_task(tmp_path: Path) -> None:
    options: dict[str, Any] = {"name": "my/rule", "worlds": 1, "tasks": ["small"]}
    options |= {"folder": tmp_path, "progress": None, "observation": "frame"}
    rows = suite({"small": up}, **options)
    assert read(tmp_path / "small" / "my_rule.csv") == rows["small"]
    assert [(row.world_seed, row.steps) for row in rows["small"]] == [(0, 300)]
    with refuses("csv: .*small/my_rule.csv already exists"):
        suite(up, **options)
    with refuses("policy: expected one for the task small, got ..team"):
        suite({"team": up}, **options)
    with refuses("worlds: expected an integer within 1 to 4294967295, got 0"):
        suite(up, **options | {"worlds": 0})
