"""Emberwatch: explore a wildfire that a robot only partly sees, over shared memory.

Importing this package registers its environments with Gymnasium:

    import gymnasium, emberwatch
    env = gymnasium.make("emberwatch/Wildfire-v0")

Without Gymnasium, `connect` talks to a running server and `observe` reads what it publishes.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

from emberwatch import recording
from emberwatch.client import Client, connect
from emberwatch.decisions import Decisions
from emberwatch.env import WildfireEnv, WildfireVectorEnv
from emberwatch.errors import EmberwatchError
from emberwatch.lease import Lease
from emberwatch.moves_env import WildfireMovesEnv, WildfireMovesVectorEnv
from emberwatch.objective_env import WildfireObjectiveEnv, WildfireObjectiveVectorEnv
from emberwatch.observer import Frame, Observer, Outlook, OutlookReader, Truth, TruthReader, observe
from emberwatch.release import VERSION
from emberwatch.replies import Decision, DecisionsInfo, ServerInfo, ServerStatus, WorldInfo
from emberwatch.wire import RobotResult, StepAnswer, StepResult, WorldResult

if TYPE_CHECKING:
    from emberwatch import benchmark as benchmark
    from emberwatch import planning as planning
    from emberwatch import sb3 as sb3
    from emberwatch import wrappers as wrappers
    from emberwatch.parallel import WildfireParallelEnv

__all__ = [
    "Client",
    "Decision",
    "Decisions",
    "DecisionsInfo",
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
    "observe",
    "parallel_env",
    "recording",
]

__version__ = VERSION

#: Steps after which an episode is truncated, unless `gymnasium.make` is told otherwise.
MAX_EPISODE_STEPS = 1000

for _module, _kind, _version, _steps in (
    ("env", "Wildfire", 0, MAX_EPISODE_STEPS),
    ("moves_env", "WildfireMoves", 0, 64 * MAX_EPISODE_STEPS),
    ("objective_env", "WildfireObjective", 1, MAX_EPISODE_STEPS),
):
    gymnasium.register(  # pyright: ignore[reportUnknownMemberType]
        f"emberwatch/{_kind}-v{_version}",
        entry_point=f"emberwatch.{_module}:{_kind}Env",
        vector_entry_point=f"emberwatch.{_module}:{_kind}VectorEnv",
        max_episode_steps=_steps,
    )


#: Modules that are imported when they are first used.
_LATER = frozenset(("benchmark", "planning", "sb3", "wrappers"))


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return import_module(f"{__name__}.{name}")


def parallel_env(**keywords: Any) -> WildfireParallelEnv:
    """All robots of one world as a PettingZoo environment; see `WildfireParallelEnv`.

    Raises `ModuleNotFoundError` without PettingZoo, which ``pip install emberwatch[teams]`` brings.
    """
    try:
        from emberwatch.parallel import WildfireParallelEnv
    except ModuleNotFoundError as error:
        needed = "expected PettingZoo: pip install emberwatch[teams]"
        raise ModuleNotFoundError(f"parallel_env: {needed}; got: {error}") from None

    return WildfireParallelEnv(**keywords)
