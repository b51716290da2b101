"""JSON requests and what comes back (PROTOCOL.md sections 6 and 13)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, TypeVar, cast, get_origin, get_type_hints

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
class Grant:
    """The reply to `acquire`, without its worlds."""

    lease: int
    ttl_millis: int


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftBeliefInfo:
    """The reply to `belief`."""

    kind: str
    seed: int
    episode: int
    step: int
    length: int
    offset: int
    data: str


class LeftBelief(NamedTuple):
    """What an agent left about a world to the next.

    Attributes:
        kind: Says what the bytes are.
        episode: The episode it is about.
        step: The step k at which it was left: the present one.
        data: The bytes.
    """

    kind: str
    episode: int
    step: int
    data: bytes


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
    except (ValueError, RecursionError) as error:
        raise GarbledAnswerError(f"answer to {what}: expected JSON, got {error}") from None
    if not isinstance(reply, dict):
        raise GarbledAnswerError(f"answer to {what}: expected an object, got {reply!r}")
    keys = cast("dict[str, Any]", reply)
    if head.status != 0:
        detail, message = keys.get("detail"), keys.get("message")
        raise refusal(
            head.status,
            detail if isinstance(detail, int) else 0,
            message if isinstance(message, str) else None,
        )
    wire.check_answer(f"answer to {what}", head, sequence)
    return keys


def records(kind: type[_Record], reply: Mapping[str, Any]) -> tuple[_Record, ...]:
    """The records of a reply's worlds.

    Raises:
        GarbledAnswerError: If one is missing or of another type.
    """
    worlds = reply.get("worlds")
    if not isinstance(worlds, list):
        raise GarbledAnswerError(f"reply: expected a list 'worlds', got {worlds!r}")
    return tuple(record(kind, world) for world in cast("list[Any]", worlds))


def record(kind: type[_Record], keys: Any) -> _Record:
    """A record from a reply; keys that this release does not know are ignored.

    Raises:
        GarbledAnswerError: Naming what is missing or of another type.
    """
    if not isinstance(keys, Mapping):
        raise GarbledAnswerError(f"reply: expected an object, got {keys!r}")
    given = cast("Mapping[str, Any]", keys)
    values: dict[str, Any] = {}
    for name, types in _types(kind).items():
        if name not in given:
            raise GarbledAnswerError(f"reply: expected a key {name!r}, got {sorted(given)}")
        value = tuple(given[name]) if isinstance(given[name], list) else given[name]
        if not isinstance(value, types):
            raise GarbledAnswerError(f"reply: expected another {name!r}, got {value!r}")
        values[name] = value
    return kind(**values)


@cache
def _types(kind: type[Any]) -> dict[str, Any]:
    """What each field of a record may be: a tuple of anything, and any number for a float."""
    wider = {float: int | float}
    return {
        name: tuple if get_origin(hint) is tuple else wider.get(hint, hint)
        for name, hint in get_type_hints(kind).items()
    }
