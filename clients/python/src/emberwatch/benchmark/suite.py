"""Evaluation of a policy on several tasks, for `emberwatch-agent suite` and `leaderboard`."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, cast

from emberwatch.benchmark.evaluation import evaluate
from emberwatch.benchmark.policies import Policy
from emberwatch.benchmark.rows import Row
from emberwatch.common.arguments import as_count
from emberwatch.common.paths import absolute
from emberwatch.errors import invalid
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
        keywords: Keywords of `evaluate`, except `task`, `seeds`, `steps` and `csv`.

    Returns:
        The rows of each task, one for each world, by the task's name.
    """
    if worlds is not None:
        as_count(worlds, "worlds", 1, 2**32 - 1)
    policies = cast("Mapping[str, Any]", policy if isinstance(policy, Mapping) else {})
    sources = list(policies or built_in_tasks() if tasks is None else tasks)
    chosen = [(absolute(source), Task.named(source)) for source in sources]
    for _, task in chosen:
        if policies and task.name not in policies:
            raise invalid("policy", f"one for the task {task.name}", list(policies))
    folder = Path(folder).absolute()
    return {
        task.name: evaluate(
            policies[task.name] if policies else cast("Any", policy),
            name=name,
            task=source,
            seeds=task.test_seeds[:worlds],
            steps=task.max_steps,
            csv=folder / task.name / (re.sub("[/+]", "_", name) + ".csv"),
            **keywords,
        )
        for source, task in chosen
    }
