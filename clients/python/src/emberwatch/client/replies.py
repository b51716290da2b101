"""What comes back on JSON requests (PROTOCOL.md sections 6 and 13)."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, TypeVar, cast, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from emberwatch.client.wire import Shape
from emberwatch.common.arguments import told
from emberwatch.errors import bad_answer, invalid
from emberwatch.model import Description, color_from_hex
from emberwatch.model.airspace import Airspace, Zones

_Record = TypeVar("_Record")


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedWorld:
    """What a server tells of recorded hidden states."""

    #: Their names, colours, rewards and readings as TOML text; None if the server hides it.
    description: str | None
    n_sequences: int
    #: Steps of the shortest episode.
    n_steps: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerInfo:
    """How a server describes itself (PROTOCOL.md section 6, `hello`)."""

    protocol: int
    build: str
    pid: int
    height: int
    width: int
    n_moves: int
    n_worlds: int
    #: Robots of each world, R: robot r of world w has number w R + r.
    n_robots: int
    n_observations: int
    observations: tuple[str, ...]
    #: The model as TOML text; None if the server hides it or its worlds were recorded.
    model: str | None
    burn_in: int
    #: Steps until an episode is truncated; 0: never.
    max_steps: int
    max_clients: int
    #: Which cells a step observes: "path", "full" or "client" (as the step asks).
    coverage: str
    publish_truth: bool
    lease_millis: int
    #: How long the other robots have after the first path of a step; 0: as long as they hold it.
    deadline_millis: int
    #: The task that its worlds are, by its name.
    task: str | None = None
    #: Identifies the worlds: a hash of every setting that a reward depends on, besides seed and
    #: policy. None from servers before release 0.3.
    worlds_fingerprint: str | None = None
    #: None of simulated worlds.
    recorded_world: RecordedWorld | None = None
    #: That of the number `pid`.
    pid_namespace: int | None = None
    #: Where robots may fly and what they see.
    airspace: Airspace = Airspace()  # noqa: RUF009
    #: Zones of land; None where all cells are alike.
    zones: Zones | None = None

    @property
    def recorded_states(self) -> Description | None:
        """What recorded worlds say of their states; None if there are none, or it is hidden."""
        text = None if self.recorded_world is None else self.recorded_world.description
        return None if text is None else Description.from_toml(text)

    @property
    def shape(self) -> Shape:
        """What the answers of this server depend on."""
        return Shape(self.n_robots, self.height, self.width)


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldInfo:
    """Where one world stands."""

    world: int
    step: int
    seed: int
    episode: int
    #: The cell of each robot.
    robots: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldStatus(WorldInfo):
    """One world in a `ServerStatus`."""

    #: The process that holds each robot, if any.
    holder_pids: tuple[int | None, ...]
    #: Paths that have come for the next step.
    n_paths: int
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
    """What an agent left about a world to the next."""

    #: Says what the bytes are.
    kind: str
    episode: int
    #: The step k at which it was left: the present one.
    step: int
    data: bytes


def records(kind: type[_Record], reply: Mapping[str, Any]) -> tuple[_Record, ...]:
    """The records of a reply's worlds."""
    worlds = reply.get("worlds")
    if not isinstance(worlds, list):
        raise bad_answer("reply", "a list 'worlds'", repr(worlds))
    return tuple(record(kind, world) for world in cast("list[Any]", worlds))


def record(kind: type[_Record], keys: Any) -> _Record:
    """A record from a reply; keys that this release does not know are ignored."""
    if not isinstance(keys, Mapping):
        raise bad_answer("reply", "an object", repr(keys))
    given = cast("Mapping[str, Any]", keys)
    values: dict[str, Any] = {}
    for name, types in _types(kind).items():
        if name in ("airspace", "zones"):
            continue
        if name in ("pid_namespace", "task", "worlds_fingerprint") and name not in given:
            continue
        if name == "recorded_world":  # it may be missing, too
            nested = given.get(name)
            values[name] = None if nested is None else record(RecordedWorld, nested)
            continue
        if name not in given:
            raise bad_answer("reply", f"a key {name!r}", sorted(given))
        value = _as_tuples(given[name])
        if not isinstance(value, types):
            raise bad_answer("reply", f"another {name!r}", repr(value))
        values[name] = value
    if kind is ServerInfo:
        values |= _land(given, (values["height"], values["width"]))
    return kind(**values)


def _land(given: Mapping[str, Any], shape: tuple[int, int]) -> dict[str, Airspace | Zones]:
    """What the answer to `hello` says of airspace and zones; both may be missing."""
    land: dict[str, Airspace | Zones] = {}
    airspace, zones = given.get("airspace"), given.get("zones")
    try:
        if airspace is not None:
            kept = {name: airspace[name] for name in ("radius", "n_rings", "pays")}
            rows = airspace.get("no_fly")
            no_fly = None if rows is None else _cells("no_fly", rows, shape, 2) != 0
            land["airspace"] = Airspace(**kept, no_fly=no_fly)
        if zones is not None:
            names, colors = (tuple(map(str, zones[name])) for name in ("names", "colors"))
            if len(names) != len(tuple(map(color_from_hex, colors))):
                raise invalid("colors", len(names), len(colors))
            cells = _cells("map", zones["map"], shape, len(names))
            land["zones"] = Zones(names=names, colors=colors, map=cells)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise bad_answer("reply", "'airspace' and 'zones' of the grid", error) from None
    return land


def _cells(what: str, rows: Any, shape: tuple[int, int], n_values: int) -> NDArray[np.uint8]:
    """A map of the grid from its rows, which have numbers below `n_values`."""
    try:
        cells = np.array(rows)
    except ValueError:  # rows differ in length
        cells = np.empty(0)
    is_map = cells.shape == shape and cells.dtype.kind == "i"
    if not is_map or ((cells < 0) | (cells >= n_values)).any():
        raise invalid(what, f"integers below {n_values} of shape {shape}", told(rows))
    return cells.astype(np.uint8)


def _as_tuples(value: Any) -> Any:
    """Lists, and those in them, as tuples."""
    return tuple(map(_as_tuples, cast("list[Any]", value))) if isinstance(value, list) else value


@cache
def _types(kind: type[Any]) -> dict[str, Any]:
    """What each field of a record may be: a tuple of anything, and any number for a float."""
    wider = {float: int | float}
    return {
        name: tuple if get_origin(hint) is tuple else wider.get(hint, hint)
        for name, hint in get_type_hints(kind).items()
    }
