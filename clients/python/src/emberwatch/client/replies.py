"""Replies to JSON requests (PROTOCOL.md sections 6 and 13)."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, TypeVar, cast, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from emberwatch.client.wire import Shape
from emberwatch.errors import bad_answer, invalid, repr_of
from emberwatch.model import Description
from emberwatch.model.airspace import Airspace

_Record = TypeVar("_Record")


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedWorld:
    """A server's description of its recorded hidden states."""

    #: Names, colours, rewards and observations of the states, as TOML text; None if the server
    #: hides them.
    description: str | None
    #: Number of recorded sequences.
    n_sequences: int
    #: Number of steps of the shortest episode.
    n_steps: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerInfo:
    """A server's description of itself and its worlds (PROTOCOL.md section 6, `hello`)."""

    #: Version of the protocol.
    protocol: int
    #: Release of the server.
    build: str
    pid: int
    #: Rows of the grid.
    height: int
    #: Columns of the grid.
    width: int
    #: Number of moves in a path, T.
    n_moves: int
    n_worlds: int
    #: Number of robots in each world, R. Robot r of world w has number w R + r.
    n_robots: int
    #: Number of observed values, O.
    n_observations: int
    #: One name for each observed value.
    observations: tuple[str, ...]
    #: The model as TOML text; None if the server hides it or its worlds were recorded.
    model: str | None
    #: Number of steps that a world is simulated before k = 0.
    burn_in: int
    #: Number of steps after which an episode is truncated; 0: never.
    max_steps: int
    max_clients: int
    #: Which cells a step observes: "path", "full" or "client" (the client decides in each step).
    coverage: str
    #: Whether the server publishes the hidden states.
    publish_truth: bool
    #: Default time without use after which a lease expires, milliseconds.
    lease_millis: int
    #: Time that a step waits for the paths of other robots after the first path arrived,
    #: milliseconds; 0: as long as other clients hold these robots.
    deadline_millis: int
    #: Name of the task that defines the worlds; None: no task.
    task: str | None = None
    #: Hash of every setting that rewards depend on, except seed and policy. It identifies the
    #: worlds. None from servers before release 0.3.
    worlds_fingerprint: str | None = None
    #: The recorded hidden states; None if the worlds are simulated.
    recorded_world: RecordedWorld | None = None
    #: The PID namespace in which `pid` is valid.
    pid_namespace: int | None = None
    #: Where robots may fly and what they see.
    airspace: Airspace = Airspace()  # noqa: RUF009

    @property
    def recorded_states(self) -> Description | None:
        """The description of recorded states; None if there are none, or the server hides it."""
        text = None if self.recorded_world is None else self.recorded_world.description
        return None if text is None else Description.from_toml(text)

    @property
    def shape(self) -> Shape:
        """The sizes that determine the layout of this server's answers."""
        return Shape(self.n_robots, self.height, self.width)


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldInfo:
    """The step, episode and robots of one world."""

    #: Number of the world.
    world: int
    #: The step k.
    step: int
    #: Seed of the episode.
    seed: int
    #: Number of resets since the server started.
    episode: int
    #: Row and column of each robot.
    robots: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldStatus(WorldInfo):
    """The status of one world in a `ServerStatus`."""

    #: Process ID of the client that holds each robot; None if no client holds it.
    holder_pids: tuple[int | None, ...]
    #: Number of paths received for the next step.
    n_paths: int
    #: Whether the world is in its burn-in.
    resetting: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerStatus:
    """A server's load, and the status of its worlds."""

    pid: int
    uptime_millis: int
    #: Number of world steps since the start.
    n_steps: int
    steps_per_second: float
    #: Number of refused requests since the start.
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
    """A belief that an agent left for the next agent of its world."""

    #: The format of the bytes.
    kind: str
    #: Number of resets of the world since the server started.
    episode: int
    #: The step k that the belief is about, which is the world's current step.
    step: int
    data: bytes


def records(kind: type[_Record], reply: Mapping[str, Any]) -> tuple[_Record, ...]:
    """Parses the records of a reply's `worlds`."""
    worlds = reply.get("worlds")
    if not isinstance(worlds, list):
        raise bad_answer("reply", "a list 'worlds'", repr_of(worlds))
    return tuple(record(kind, world) for world in cast("list[Any]", worlds))


def record(kind: type[_Record], keys: Any) -> _Record:
    """Parses a record of a reply. Keys that this release does not know are ignored."""
    if not isinstance(keys, Mapping):
        raise bad_answer("reply", "an object", repr_of(keys))
    given = cast("Mapping[str, Any]", keys)
    values: dict[str, Any] = {}
    for name, types in _types(kind).items():
        if name == "airspace":
            continue
        if name in ("pid_namespace", "task", "worlds_fingerprint") and name not in given:
            continue
        if name == "recorded_world":  # may also be missing
            nested = given.get(name)
            values[name] = None if nested is None else record(RecordedWorld, nested)
            continue
        if name not in given:
            raise bad_answer("reply", f"a key {name!r}", sorted(given))
        value = _as_tuples(given[name])
        if not isinstance(value, types):
            raise bad_answer("reply", f"another {name!r}", repr_of(value))
        values[name] = value
    if kind is ServerInfo:
        shape = values["height"], values["width"]
        values["airspace"] = _airspace(given.get("airspace"), shape)
    return kind(**values)


def _airspace(given: Any, shape: tuple[int, int]) -> Airspace:
    """Parses the airspace of the answer to `hello`, which may be missing."""
    if given is None:
        return Airspace()
    try:
        rows = given.get("no_fly")
        no_fly = None if rows is None else _no_fly(rows, shape)
        return Airspace(radius=given["radius"], no_fly=no_fly)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise bad_answer("reply", "an 'airspace' of the grid", error) from None


def _no_fly(rows: Any, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Parses the no-fly map of the grid from its rows of 0 and 1."""
    try:
        cells = np.array(rows)
    except ValueError:  # rows differ in length
        cells = np.empty(0)
    if cells.shape != shape or cells.dtype.kind != "i" or not np.isin(cells, (0, 1)).all():
        raise invalid("no_fly", f"0 and 1 of shape {shape}", repr_of(rows))
    return cells != 0


def _as_tuples(value: Any) -> Any:
    """Converts lists, and the lists in them, to tuples."""
    return tuple(map(_as_tuples, cast("list[Any]", value))) if isinstance(value, list) else value


@cache
def _types(kind: type[Any]) -> dict[str, Any]:
    """Returns the accepted type of each field of a record.

    A tuple may contain values of any type, and a float field accepts any number.
    """
    wider = {float: int | float}
    return {
        name: tuple if get_origin(hint) is tuple else wider.get(hint, hint)
        for name, hint in get_type_hints(kind).items()
    }
