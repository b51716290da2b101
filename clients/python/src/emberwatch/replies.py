"""JSON requests and what comes back (PROTOCOL.md sections 6 and 13)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar, cast

from emberwatch import wire
from emberwatch.errors import GarbledAnswerError, refusal
from emberwatch.ports import Bell, RequestPort

_Record = TypeVar("_Record")


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerInfo:
    """What a server says of itself (PROTOCOL.md section 6, `hello`)."""

    protocol: int
    build: str
    pid: int
    height: int
    width: int
    n_moves: int
    n_worlds: int
    n_observations: int
    observations: tuple[str, ...]
    #: The model as TOML text; None if the server hides it.
    model: str | None
    burn_in: int
    #: Steps until an episode is truncated; 0: never.
    max_steps: int
    max_clients: int
    #: Which cells a step observes: "path", "full" or "client" (as the step asks).
    coverage: str
    publish_truth: bool
    lease_millis: int


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldInfo:
    """Where one world stands."""

    world: int
    step: int
    seed: int
    episode: int
    robot: tuple[int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldStatus:
    """One world in a `ServerStatus`."""

    world: int
    step: int
    seed: int
    episode: int
    robot: tuple[int, int]
    #: The process that holds it, if any.
    holder_pid: int | None
    #: Whether it is in its burn-in.
    resetting: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerStatus:
    """What is going on at a server."""

    pid: int
    uptime_millis: int
    n_steps: int
    steps_per_second: float
    n_refused: int
    n_clients: int
    n_observers: int
    worlds: tuple[WorldStatus, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class DecisionsInfo:
    """What an agent that serves decisions says of itself."""

    protocol: int
    build: str
    pid: int
    instance: str
    world: int
    height: int
    width: int
    n_moves: int
    max_steps: int
    states: tuple[str, ...]
    #: What can be decided, by position: each state, then "entropy".
    objectives: tuple[str, ...]
    planner: str
    #: Names of the numbers in a decision's summary.
    summary: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """What came of a decision: the step's result, and a summary of the belief about the next.

    `seed` and `n_target_cells` are not for learners.
    """

    step: int
    reward: float
    n_target_cells: int
    n_visited: int
    n_hits: int
    robot: tuple[int, int]
    terminated: bool
    truncated: bool
    seed: int
    episode: int
    #: What was decided; None after a reset.
    objective: int | None
    #: Numbers from 0 to 1, as `DecisionsInfo.summary` names them.
    summary: tuple[float, ...]


def ask(
    port: RequestPort[wire.ControlReply],
    bell: Bell,
    sequence: int,
    request: Mapping[str, Any],
    timeout: float,
) -> dict[str, Any]:
    """One JSON request and its reply, on `control` or a channel like it.

    Raises:
        RefusedError: One of its subclasses, if it is refused.
        RequestTimeoutError, ServerGoneError, GarbledAnswerError: If there is no good answer.
    """
    what = f"{request['op']!r}"
    header = wire.CONTROL_REQUEST.pack(
        wire.VERSION, 0, sequence, bell.listener_low, bell.listener_high
    )
    head, payload = port.exchange(header, json.dumps(request).encode(), what, timeout)
    try:
        reply = json.loads(payload)
    except ValueError as error:
        raise GarbledAnswerError(f"answer to {what}: expected JSON, got {error}") from None
    if not isinstance(reply, dict):
        raise GarbledAnswerError(f"answer to {what}: expected an object, got {reply!r}")
    keys = cast("dict[str, Any]", reply)
    if head.status != 0:
        raise refusal(head.status, int(keys.get("detail", 0)), keys.get("message"))
    wire.check_answer(f"answer to {what}", head, sequence)
    return keys


def items(reply: Mapping[str, Any], key: str) -> list[Any]:
    """The list under a key of a reply.

    Raises:
        GarbledAnswerError: If there is none.
    """
    found = reply.get(key)
    if not isinstance(found, list):
        raise GarbledAnswerError(f"reply: expected a list {key!r}, got {found!r}")
    return cast("list[Any]", found)


def record(kind: type[_Record], keys: Mapping[str, Any]) -> _Record:
    """A record from a reply; keys that this release does not know are ignored.

    Raises:
        GarbledAnswerError: Naming a key that is missing.
    """
    names = [field.name for field in fields(kind)]  # pyright: ignore[reportArgumentType]
    missing = [name for name in names if name not in keys]
    if missing:
        raise GarbledAnswerError(f"reply: expected a key {missing[0]!r}, got {sorted(keys)}")
    values = {name: keys[name] for name in names}
    for name, value in values.items():
        if isinstance(value, list):
            values[name] = tuple(cast("list[Any]", value))
    return kind(**values)
