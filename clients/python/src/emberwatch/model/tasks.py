"""Tasks: named, completely specified worlds, with the seeds to test on."""

import tomllib
from dataclasses import dataclass
from os import PathLike, fspath
from pathlib import Path
from typing import Self

import emberwatch._native as _native
from emberwatch.common.arguments import check_settings
from emberwatch.common.paths import BYTE_ORDER_MARK, utf8


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
    ids: str = ""

    @classmethod
    def named(cls, name: str | PathLike[str]) -> Self:
        """Returns a built-in task by its name, or the task of a file, which is checked first."""
        check_settings({"task": utf8("task", name)})
        text = _native.built_in("tasks").get(fspath(name))
        return cls.from_toml(Path(name).read_text("utf-8") if text is None else text)

    @classmethod
    def from_toml(cls, text: str) -> Self:
        """Parses the text of a file that has been checked."""
        file = tomllib.loads(text.removeprefix(BYTE_ORDER_MARK))
        return cls(
            name=file["name"],
            n_moves=file["moves"],
            robots=file.get("robots", 1),
            max_steps=file["max_steps"],
            test_seeds=range(file["test_seeds"]["start"], file["test_seeds"]["end"]),
            ids=file.get("listing", {}).get("ids", ""),
        )


def built_in_tasks() -> dict[str, Task]:
    """Returns the built-in tasks by name."""
    files = _native.built_in("tasks").items()
    return {name: Task.from_toml(text) for name, text in files}
