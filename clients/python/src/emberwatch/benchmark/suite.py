"""Evaluation of a policy on several tasks, for `emberwatch-agent suite` and `leaderboard`."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, cast

from emberwatch.benchmark.evaluation import evaluate
from emberwatch.benchmark.policies import Policy
from emberwatch.benchmark.rows import Row, check_writable
from emberwatch.common.arguments import as_count
from emberwatch.common.paths import absolute
from emberwatch.errors import ExistingFileError, invalid, repr_of, shortened
from emberwatch.model.tasks import Task, built_in_tasks


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
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9_./+-]{1,64}", name):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise invalid("name", "1 to 64 letters, digits and -_./+", repr_of(name))
    if worlds is not None:
        as_count(worlds, "worlds", 1, 2**32 - 1)
    policies = cast("Mapping[str, Any]", policy) if isinstance(policy, Mapping) else None
    sources = list(policies or built_in_tasks() if tasks is None else tasks)
    if not sources:
        raise invalid("tasks", "at least one task", "none")
    chosen = [(absolute(source), Task.named(source)) for source in sources]
    names = [task.name for _, task in chosen]
    if len(set(names)) < len(names):
        raise invalid("tasks", "tasks with different names", shortened(", ".join(names)))
    files: dict[str, Path] = {}
    for task in names:
        if policies is not None and task not in policies:
            raise invalid("policy", f"one for the task {task}", shortened(", ".join(policies)))
        files[task] = Path(os.path.abspath(folder), task, re.sub("[/+]", "_", name) + ".csv")
        if os.path.lexists(files[task]):
            raise ExistingFileError(
                f"folder: {files[task]} already exists: remove it, choose another name or folder, "
                "or leave its task out with tasks="
            )
        check_writable(files[task])
    return {
        task.name: evaluate(
            cast("Any", policy) if policies is None else policies[task.name],
            name=name,
            task=source,
            seeds=task.test_seeds[:worlds],
            steps=task.max_steps,
            csv=files[task.name],
            append=False,
            **keywords,
        )
        for source, task in chosen
    }
