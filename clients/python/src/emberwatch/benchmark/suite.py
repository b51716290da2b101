"""Evaluation of a policy on several tasks, for `emberwatch-agent suite` and `leaderboard`."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, cast

from emberwatch.benchmark.evaluation import evaluate
from emberwatch.benchmark.policies import Policy
from emberwatch.benchmark.row_file import check_writable
from emberwatch.benchmark.rows import Row
from emberwatch.common.arguments import as_integer, repr_of
from emberwatch.errors import ExistingFileError, InvalidArgumentError, invalid
from emberwatch.model.tasks import Task, built_in_tasks

#: Keywords of `evaluate` that a suite sets itself.
_SET: Final = ("task", "seeds", "steps", "csv", "append")

#: Names that are safe as a file's name, once `/` and `+` are replaced.
_NAME: Final = re.compile(r"[A-Za-z0-9_./+-]{1,64}")


def suite(
    policy: Policy | Any,
    *,
    name: str,
    folder: str | os.PathLike[str] = "suite",
    tasks: Iterable[str | os.PathLike[str]] | None = None,
    worlds: int | None = None,
    **keywords: Any,
) -> dict[str, list[Row]]:
    """Scores a policy on the test worlds of tasks, for `emberwatch-agent suite --out FOLDER`.

    Args:
        policy: A policy as in `evaluate`, for all tasks; or a mapping from the name of each task to
            its policy.
        name: The policy's name in tables: 1 to 64 letters, digits and `-_./+`.
        folder: The folder of the rows. Each task has a folder in it, with a file `NAME.csv` for
            each policy, in which `/` and `+` of the name are `_`. No file may exist yet.
        tasks: Names of tasks or task files; None: all built-in tasks, or the tasks of the mapping.
        worlds: Number of worlds of each task, from its first test seed on; None: all of them.
        keywords: Keywords of `evaluate`, except `task`, `seeds`, `steps`, `csv` and `append`.

    Returns:
        The rows of each task, one for each world, by the task's name.
    """
    for keyword in _SET:
        if keyword in keywords:
            raise InvalidArgumentError(f"{keyword}: suite sets it; leave it out")
    if not isinstance(name, str) or not _NAME.fullmatch(name):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise invalid("name", "1 to 64 letters, digits and -_./+", repr_of(name))
    if worlds is not None and (as_integer(worlds) or 0) < 1:
        raise invalid("worlds", "at least 1", repr_of(worlds))
    by_task = cast("Mapping[str, Any]", policy) if isinstance(policy, Mapping) else None
    sources = list(by_task or built_in_tasks() if tasks is None else tasks)
    if not sources:
        raise invalid("tasks", "at least one task", "none")
    chosen = [(source, Task.named(source)) for source in sources]
    names = [task.name for _, task in chosen]
    if len(set(names)) < len(names):
        raise invalid("tasks", "tasks with different names", ", ".join(names))
    for task_name in names:
        if by_task is not None and task_name not in by_task:
            raise invalid("policy", f"one for the task {task_name}", ", ".join(by_task))
    stem = name.replace("/", "_").replace("+", "_")
    files = {task_name: Path(folder) / task_name / f"{stem}.csv" for task_name in names}
    for file in files.values():
        if os.path.lexists(file):
            raise ExistingFileError(
                f"folder: {file} already exists: remove it, choose another name or folder, or "
                "leave its task out with tasks="
            )
        check_writable(file)
    return {
        task.name: evaluate(
            cast("Any", policy) if by_task is None else by_task[task.name],
            name=name,
            task=source,
            seeds=task.test_seeds[:worlds],
            csv=files[task.name],
            **keywords,
        )
        for source, task in chosen
    }
