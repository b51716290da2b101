"""The rows of a file that `evaluate` and `suite` keep, run again, or refuse."""

import contextvars
import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import WORLDS
from environments import LIVELY, MOVES, WILDFIRE
from failures import refuses
from numpy.typing import NDArray
from processes import server

from emberwatch.benchmark import Row, evaluate, read, suite

TASK = """
name = "lab"
model = "{model}"
height = 7
width = 9
moves = 4
burn_in = {burn_in}
max_steps = {steps}
test_seeds = {{ start = 3, end = 6 }}
"""

#: Draws the actions of a world; digests of policies do not include it.
SHAPE: contextvars.ContextVar[tuple[int, ...]] = contextvars.ContextVar("SHAPE", default=())


def always(move: int) -> Callable[[Any], NDArray[np.int64]]:
    return lambda frames: np.full((len(frames), *SHAPE.get()), move)


def go(path: Path, move: int = 3, *, name: str = "mine", **changes: Any) -> tuple[list[Row], str]:
    """Returns the rows and the messages of a short evaluation."""
    said = io.StringIO()
    keywords = {**WORLDS, "observation": "frame", "seeds": range(3, 6), "steps": 5, **changes}
    rows = evaluate(always(move), name=name, csv=path, progress=said, **keywords)
    return rows, said.getvalue()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "mine.csv"


def test_rows_on_other_worlds_are_refused_by_name(file: Path) -> None:
    go(file)
    kept = file.read_bytes()
    changes: list[dict[str, Any]] = [{"n_moves": 5}, {"robots": 2}]
    for change in (*changes, {"start": "centre"}, {"seeds": range(6, 8), "width": 10}):
        for name in ("mine", "other"):
            with refuses("csv: .*mine.csv has 3 rows of other worlds, of the policies 'mine': "):
                go(file, name=name, **change)
    assert file.read_bytes() == kept


#: Changes that count as another policy, whose rows are run again.
CHANGED: list[dict[str, Any]] = [
    {"move": 1},
    {"deterministic": False},
    {"estimator": "guess"},
    {"observation": "image"},
    {"observation": "local", "window": 5},
    {"env": WILDFIRE},
]


def test_changed_policies_or_settings_are_run_again(file: Path) -> None:
    rows, _ = go(file)
    for change in CHANGED:
        token = SHAPE.set((4,) if "env" in change else ())
        first, (rows, said) = rows, go(file, **change)
        _, again = go(file, **change)
        SHAPE.reset(token)
        assert f"mine: 3 rows kept in {file}, not run again. Data that the policy" in again, change
        assert f"mine: 3 rows already in {file} run again: from another policy or other s" in said
        for one, other in zip(rows, first, strict=True):
            assert one.policy_fingerprint != other.policy_fingerprint, change
            assert one.worlds_fingerprint == other.worlds_fingerprint, change
        assert read(file) == rows
    file.unlink()
    rows, _ = go(file)
    again, said = go(file, env=MOVES, start="corner", sensor_radius=0, batch=2)
    assert again == rows and "3 rows kept" in said, "defaults that are named"


def test_a_servers_equal_worlds_count_as_the_same(file: Path) -> None:
    rows, _ = go(file)
    flags = {"height": 7, "width": 9, "moves": 4, "model": LIVELY, "burn_in": 60}
    running = server(worlds=4, publish_truth=True, **flags)
    keywords = {"observation": "frame", "steps": 5, "instance": running.instance}
    said = io.StringIO()
    keywords |= {"name": "mine", "seeds": range(3, 6), "csv": file, "progress": said}
    again = evaluate(always(3), **keywords)
    assert again == rows and "3 rows kept" in said.getvalue()
    other = server(worlds=4, **flags | {"burn_in": 61})
    keywords["instance"] = other.instance
    with refuses("rows of other worlds, of the policies 'mine'"):
        evaluate(always(3), **keywords)


def test_a_changed_policy_replaces_all_its_rows(file: Path) -> None:
    go(file)
    rows, said = go(file, 1, seeds=range(5, 7))
    assert "1 row already in" in said and "run again, 2 removed" in said
    assert read(file) == rows and [row.world_seed for row in rows] == [5, 6]


def test_rows_with_other_numbers_of_steps_are_refused(file: Path) -> None:
    go(file)
    with refuses("has steps 5 of 'mine' on world 3, expected 6: choose another"):
        go(file, steps=6)
    with refuses("has recent_steps 10 of 'mine' on world 3, expected 2: choose"):
        go(file, recent_steps=2)
    # Rows of another policy may have another number of steps.
    go(file, name="other", steps=6)
    assert len(read(file)) == 6


def without_fingerprints(path: Path) -> None:
    """Turns a file into a file of an older release."""
    lines = path.read_text().splitlines()
    path.write_text("".join(",".join(line.split(",")[:-3]) + "\n" for line in lines))


def test_own_rows_of_older_releases_are_refused(file: Path) -> None:
    go(file)
    without_fingerprints(file)
    assert [row.worlds_fingerprint for row in read(file)] == [""] * 3
    with refuses("has rows of 'mine' from an older release, without a fingerprint of their worlds"):
        go(file)
    # Rows of other policies stay if the same numbers of cells burn in their worlds.
    old = read(file)
    with refuses(r"burning cells in world 3 \('mine'\), got"):
        go(file, name="other", burn_in=61)
    assert read(file) == old
    rows, _ = go(file, name="other")
    assert read(file) == old + rows


def test_files_of_older_releases_are_read(file: Path) -> None:
    head = "policy,estimator,world_seed,steps,mean_reward,mean_distinct_cells,hit_rate,"
    head += "mean_fire_cells,mean_plan_millis,brier,moves"
    file.write_text(f"{head}\nmine,none,3,5,1.5,4.0,0.5,7.0,0.1,,8\n")
    (row,) = read(file)
    assert (row.moves, row.robots, row.team, row.mean_repeated) == (8, 1, "alone", 0.0)
    assert row.recent_steps is None


def test_a_file_saved_by_a_spreadsheet_is_read(file: Path) -> None:
    rows, _ = go(file)
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    again, said = go(file)
    assert again == rows == read(file) and "3 rows kept" in said


def test_a_row_with_invalid_values_is_refused(file: Path) -> None:
    go(file)
    text = file.read_text()
    bad = ("mine,none,3", "mine" + ",1" * 60, "mine,none,x" + ",1" * 20)
    for content in (*(f"{text}{line}\n" for line in bad), "policy,steps\nmine,3\n", "\x00\xff"):
        file.write_text(content, "latin-1")
        with refuses("csv: expected .*mine.csv to have the columns policy,"):
            go(file)


def run_suite(folder: Path, move: int = 3, **changes: Any) -> tuple[list[Row], str]:
    """Returns the rows and the messages of a suite of one task."""
    values = {"model": LIVELY, "burn_in": 60, "steps": 5, **changes}
    name = values.pop("name", "mine")
    source = folder / "task.toml"
    source.write_text(TASK.format(**values))
    said = io.StringIO()
    keywords = {"name": name, "folder": folder / "out", "observation": "frame"}
    rows = suite(always(move), tasks=[source], progress=said, **keywords)
    return rows["lab"], said.getvalue()


def test_a_suite_reuses_rows_and_reruns_changed_ones(tmp_path: Path) -> None:
    rows, _ = run_suite(tmp_path)
    again, said = run_suite(tmp_path)
    assert again == rows and "mine: 3 rows kept in " in said
    for change in ({"burn_in": 50}, {"model": "wildfire-small"}, {"steps": 6}, {"move": 1}):
        first, (rows, said) = rows, run_suite(tmp_path, **change)
        assert "mine: 3 rows already in " in said and " run again: " in said
        assert read(tmp_path / "out" / "lab.csv") == rows != first


def test_a_suite_keeps_other_policies_rows_on_old_worlds(tmp_path: Path) -> None:
    file = tmp_path / "out" / "lab.csv"
    old, _ = run_suite(tmp_path, name="old")
    with pytest.warns(UserWarning, match="lab.csv has rows of old on other worlds") as warned:
        rows, _ = run_suite(tmp_path, burn_in=50)
    assert warned[0].filename == __file__
    assert read(file) == rows + old
    without_fingerprints(file)
    with pytest.warns(UserWarning, match="lab.csv has rows of old on other worlds"):
        again, said = run_suite(tmp_path, burn_in=50)
    assert read(file) == again + [
        replace(row, worlds_fingerprint="", policy_fingerprint="") for row in old
    ]
    assert "3 rows already in" in said


def test_a_suite_refuses_tasks_with_equal_names(tmp_path: Path) -> None:
    with refuses("tasks: expected tasks with different names, got small, small"):
        suite(always(3), name="mine", folder=tmp_path, tasks=["small", "small"])
    assert list(tmp_path.iterdir()) == []


def test_worlds_that_change_during_a_run_are_refused(file: Path, tmp_path: Path) -> None:
    model = tmp_path / "model.toml"
    text = Path(LIVELY).read_text()
    model.write_text(text)

    def rewrites(frames: Any) -> NDArray[np.int64]:
        model.write_text(text.replace("name = ", "name = 'other' # ", 1))
        return np.zeros(len(frames), np.int64)

    keywords = {**WORLDS, "model": model, "observation": "frame", "steps": 2, "progress": None}
    with refuses("worlds: changed since the evaluation began"):
        evaluate(rewrites, name="mine", seeds=range(3, 5), batch=1, csv=file, **keywords)
    assert [row.world_seed for row in read(file)] == [3]
