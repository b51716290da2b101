"""Emberwatch: explore a wildfire that a robot can only partly observe.

Importing this package registers its environments with Gymnasium:

    import gymnasium, emberwatch
    env = gymnasium.make("emberwatch/Wildfire-v0")

Worlds are simulated in this process, or with `instance="lab"` by a running `emberwatch-server`. To
work without Gymnasium, `connect` to a running server, or `observe` what it publishes.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

from emberwatch._native import VERSION
from emberwatch.client import recording
from emberwatch.client.client import Client, Lease, connect, embed
from emberwatch.client.observer import (
    Frame,
    Observer,
    Outlook,
    OutlookReader,
    Truth,
    TruthReader,
    observe,
)
from emberwatch.client.replies import ServerInfo, ServerStatus, WorldInfo
from emberwatch.client.wire import RobotResult, StepAnswer, StepResult, WorldResult
from emberwatch.envs.moves_env import WildfireMovesEnv, WildfireMovesVectorEnv
from emberwatch.envs.objective_env import WildfireObjectiveEnv, WildfireObjectiveVectorEnv
from emberwatch.envs.path_env import WildfireEnv, WildfireVectorEnv
from emberwatch.errors import EmberwatchError, TrainingOnTestWorldsWarning
from emberwatch.model.tasks import Task, built_in_tasks

if TYPE_CHECKING:
    from emberwatch import benchmark as benchmark
    from emberwatch import planning as planning
    from emberwatch import sb3 as sb3
    from emberwatch import wrappers as wrappers
    from emberwatch.envs.parallel import WildfireParallelEnv

__all__ = [
    "Client",
    "EmberwatchError",
    "Frame",
    "Lease",
    "Observer",
    "Outlook",
    "OutlookReader",
    "RobotResult",
    "ServerInfo",
    "ServerStatus",
    "StepAnswer",
    "StepResult",
    "Task",
    "TrainingOnTestWorldsWarning",
    "Truth",
    "TruthReader",
    "WildfireEnv",
    "WildfireMovesEnv",
    "WildfireMovesVectorEnv",
    "WildfireObjectiveEnv",
    "WildfireObjectiveVectorEnv",
    "WildfireVectorEnv",
    "WorldInfo",
    "WorldResult",
    "connect",
    "embed",
    "observe",
    "parallel_env",
    "recording",
]

__version__ = VERSION


def _register(task: Task, /, **keywords: Any) -> None:
    """Registers the three environments of a task, with `keywords` as defaults."""
    for module, kind, first, steps in (
        ("path_env", "", 0, task.max_steps),
        ("moves_env", "Moves", 0, task.n_moves * task.max_steps),
        ("objective_env", "Objective", 1, task.max_steps),
    ):
        gymnasium.register(  # pyright: ignore[reportUnknownMemberType]
            f"emberwatch/{task.ids}{kind}-v{first + task.version}",
            entry_point=f"emberwatch.envs.{module}:Wildfire{kind}Env",
            vector_entry_point=f"emberwatch.envs.{module}:Wildfire{kind}VectorEnv",
            max_episode_steps=steps,
            kwargs=keywords,
        )


_TASKS = built_in_tasks()
# The default worlds are registered without `task`, so that keywords may change any setting.
_register(_TASKS.pop("wildfire"))
for _name, _task in _TASKS.items():
    _register(_task, task=_name)


#: Modules that are imported on first use.
_LATER = frozenset(("benchmark", "planning", "sb3", "wrappers"))


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return import_module(f"{__name__}.{name}")


def parallel_env(**keywords: Any) -> WildfireParallelEnv:
    """Makes a PettingZoo environment of all robots of one world; see `WildfireParallelEnv`.

    Raises:
        ModuleNotFoundError: If PettingZoo is missing: ``pip install emberwatch[teams]``.
    """
    try:
        from emberwatch.envs.parallel import WildfireParallelEnv
    except ModuleNotFoundError as error:
        needed = "expected PettingZoo: pip install emberwatch[teams]"
        raise ModuleNotFoundError(f"parallel_env: {needed}; got: {error}") from None

    return WildfireParallelEnv(**keywords)
