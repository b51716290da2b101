"""Replies to requests (PROTOCOL.md section 6), which the native module makes."""

from dataclasses import dataclass
from typing import NamedTuple

from emberwatch.model import Description
from emberwatch.model.airspace import Airspace


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


class LeftBelief(NamedTuple):
    """A belief that an agent left for the next agent of its world."""

    #: The format of the bytes.
    kind: str
    #: Number of resets of the world since the server started.
    episode: int
    #: The step k that the belief is about, which is the world's current step.
    step: int
    data: bytes
