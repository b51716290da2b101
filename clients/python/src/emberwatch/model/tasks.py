"""Tasks: named, completely specified worlds, with the seeds to test on."""

from dataclasses import dataclass, field
from os import PathLike
from typing import Self

import emberwatch._native as _native
from emberwatch.common.arguments import read_settings


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """The properties of a task that are known before its worlds exist."""

    name: str
    #: Number of moves in a path.
    n_moves: int
    #: Number of robots in each world.
    robots: int
    #: Number of steps in an episode.
    max_steps: int
    test_seeds: range
    #: Prefix of the ids of its environments, such as `WildfireSmall` in
    #: `emberwatch/WildfireSmall-v0`; empty if it has no environments.
    ids: str = field(default="", compare=False)
    #: Version of its worlds, with which these ids end. It rises when the worlds change.
    version: int = field(default=0, compare=False)

    @classmethod
    def named(cls, name: str | PathLike[str]) -> Self:
        """Returns a built-in task by its name, or the task of a file, with its files checked."""
        task = cls.of(read_settings({"task": name}))
        assert task is not None
        return task

    @classmethod
    def of(cls, settings: _native.CheckedSettings) -> Self | None:
        """Returns the task of settings; None if they have no task."""
        if settings.task is None:
            return None
        name, n_moves, robots, max_steps, start, end, ids, version = settings.task
        return cls(
            name=name,
            n_moves=n_moves,
            robots=robots,
            max_steps=max_steps,
            test_seeds=range(start, end),
            ids=ids,
            version=version,
        )


def built_in_tasks() -> dict[str, Task]:
    """Returns the built-in tasks by name."""
    return {name: Task.named(name) for name in _native.built_in("tasks")}
