"""Observers of an instance: readers of frames, hidden states and beliefs.

For example `for frame in emberwatch.observe("lab", timeout=10): print(frame.result.reward)`. An
observer may be opened before the server starts, and stays open when the server ends.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

import emberwatch._native as _native
from emberwatch.client.connection import Closable
from emberwatch.client.wire import RobotResult, WorldResult
from emberwatch.errors import EmberwatchError, RequestTimeoutError, invalid

#: Seconds to wait for the samples of given steps before a new reader is opened.
_RETRY: Final = 0.02

_Sample = TypeVar("_Sample")
_Step = TypeVar("_Step", bound="Frame | Truth")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobotFrame:
    """The path and the frame of one robot in one step. Arrays are copies."""

    result: RobotResult
    #: The robot's frame, `(H, W)`: the observed value of each cell, 255 in unobserved cells.
    frame: NDArray[np.uint8]
    #: The moves that the robot flew, `(n_moves,)`; empty after a reset, or if the robot hovered.
    path: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """A published step of one world. Arrays are copies."""

    #: Number of the world.
    world: int
    result: WorldResult
    #: One entry for each robot of the world.
    robots: tuple[RobotFrame, ...]
    #: Number of samples that this observer missed since the last one that it received.
    n_lost: int

    @property
    def frame(self) -> NDArray[np.uint8]:
        """The team's frame, `(H, W)`: observed values, 255 in cells that no robot observed."""
        return np.minimum.reduce([robot.frame for robot in self.robots])

    @property
    def moment(self) -> tuple[int, int, int]:
        """Seed, episode and step."""
        return self.result.moment


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """The published hidden states of one world, for evaluation and pictures, never for learners."""

    #: Number of the world.
    world: int
    #: Number of resets of the world since the server started.
    episode: int
    #: The step k.
    step: int
    #: Seed of the episode.
    seed: int
    #: The hidden states X_k, `(H, W)`; a copy.
    states: NDArray[np.uint8]
    #: Number of samples that this reader missed since the last one that it received.
    n_lost: int

    @property
    def moment(self) -> tuple[int, int, int]:
        """Seed, episode and step."""
        return self.seed, self.episode, self.step


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outlook:
    """An agent's published belief about a world, and its last plan there."""

    #: Number of the world.
    world: int
    #: Number of resets of the world since the server started.
    episode: int
    #: The step k.
    step: int
    #: Seed of the episode.
    seed: int
    #: The posterior belief about X_k, `(S, H, W)`, probabilities; a copy.
    belief: NDArray[np.float32]
    #: Names of the S states.
    states: tuple[str, ...]
    #: Name of the agent's policy.
    policy: str
    #: Name of the estimator that computes the belief.
    belief_from: str
    #: The objective of the last path.
    objective: str
    #: Milliseconds that planning the last path took.
    plan_millis: float
    #: Process ID of the agent.
    pid: int
    #: The numbers of the robots that the agent flies.
    robots: range
    #: Number of this agent's samples that this reader missed since the last one that it received.
    n_lost: int


class Reader(Closable, Generic[_Sample]):
    """A subscriber of one channel. A slow reader loses samples; it never delays the publisher."""

    def __init__(
        self, instance: str, native: _native.Frames | _native.Truths | _native.Outlooks
    ) -> None:
        self.instance: Final = instance
        self._native = native

    def close(self) -> None:
        self._native.close()

    def receive(self, timeout: float) -> _Sample | None:
        """Returns the next sample; `None` if none arrives within `timeout` seconds."""
        fields = self._native.receive(timeout)
        return None if fields is None else self._made(fields)

    def _made(self, fields: dict[str, Any]) -> _Sample:
        raise NotImplementedError


class Observer(Reader[Frame]):
    """A reader of the frames of an instance: one sample for each step of each world.

    Iterate over it, or call `receive`.
    """

    def __init__(
        self, instance: str = "default", *, world: int | None = None, timeout: float | None = None
    ) -> None:
        """Subscribes; see `observe`."""
        super().__init__(instance, _native.Frames(instance, world))
        self._timeout = timeout

    def __iter__(self) -> Iterator[Frame]:
        """Yields frames as they arrive, until none arrives for `timeout` seconds (None: never)."""
        while True:
            # Waits an hour at a time, because an infinite wait would overflow.
            frame = self.receive(3600.0 if self._timeout is None else self._timeout)
            if frame is not None:
                yield frame
            elif self._timeout is not None:
                return

    def _made(self, fields: dict[str, Any]) -> Frame:
        return frame_of(fields)


class TruthReader(Reader[Truth]):
    """A reader of the hidden states of an instance, if its server publishes them."""

    def __init__(self, instance: str = "default") -> None:
        super().__init__(instance, _native.Truths(instance))

    def _made(self, fields: dict[str, Any]) -> Truth:
        return Truth(**fields)


class OutlookReader(Reader[Outlook]):
    """A reader of the beliefs of the agents of an instance.

    Agents publish their beliefs only while there is a reader.
    """

    def __init__(self, instance: str = "default") -> None:
        super().__init__(instance, _native.Outlooks(instance))

    def _made(self, fields: dict[str, Any]) -> Outlook:
        first, n_robots = fields["robots"]
        fields["states"] = tuple(fields["states"])
        fields["robots"] = range(first, first + n_robots)
        return Outlook(**fields)


class Newest(Generic[_Step]):
    """The newest samples of consecutive worlds, for infos, pictures and rewards of single moves."""

    def __init__(self, subscribe: Callable[[], Reader[_Step]], worlds: range) -> None:
        self._subscribe = subscribe
        self._reader: Reader[_Step] | None = subscribe()
        self._worlds = worlds
        self._samples: dict[int, _Step] = {}

    def at(
        self, moments: Sequence[tuple[int, int, int]], timeout: float, first: int = 0
    ) -> list[_Step]:
        """Waits for the samples of the given moments, and returns them.

        Args:
            moments: Seed, episode and step of consecutive worlds.
            timeout: Seconds to wait.
            first: Index of the first of these worlds.
        """
        wanted = dict(zip(self._worlds[first:], moments, strict=False))
        begin = asked = time.perf_counter()
        n_asked = n_lost = 0
        while any(self._moment(world) != moment for world, moment in wanted.items()):
            now = time.perf_counter()
            if now - begin > timeout:
                raise RequestTimeoutError(f"the step was not published within {timeout} s")
            # If this reader lost samples, the awaited ones may be among them. A new reader
            # receives the current sample of each world. Without losses, the wait doubles each time.
            if now - asked > (_RETRY if n_lost else _RETRY * 2**n_asked):
                self.close()
                asked, n_asked, n_lost = now, n_asked + 1, 0
            if self._reader is None:  # closed above, or an earlier call was interrupted there
                self._reader = self._subscribe()
            sample = self._reader.receive(min(timeout, _RETRY))
            if sample is not None:
                n_lost += sample.n_lost
                if sample.world in self._worlds:
                    self._samples[sample.world] = sample
        return [self._samples[world] for world in wanted]

    def close(self) -> None:
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()

    def _moment(self, world: int) -> tuple[int, int, int] | None:
        sample = self._samples.get(world)
        return None if sample is None else sample.moment


class Present(Closable):
    """The current hidden states of worlds in this process, with the interface of `Newest`."""

    def __init__(self, read: Callable[[range], list[dict[str, Any]]]) -> None:
        self._read = read

    def at(
        self, moments: Sequence[tuple[int, int, int]], _timeout: float, first: int = 0
    ) -> list[Truth]:
        """Returns the hidden states of the given moments, as `Newest.at` does."""
        truths = [Truth(**fields) for fields in self._read(range(first, first + len(moments)))]
        got = [truth.moment for truth in truths]
        if got != list(moments):
            raise EmberwatchError(f"truth: expected worlds at {moments}, got {got}", "late")
        return truths

    def close(self) -> None:
        pass


def observe(
    instance: str = "default", *, world: int | None = None, timeout: float | None = None
) -> Observer:
    """Observes an instance. Returns an iterator of frames, which is also a context manager.

    The server publishes the current frame of every world when an observer connects, so the same
    step of the same episode may arrive twice.

    Args:
        instance: The instance's name. Its server may start later.
        world: The only world to observe; None: all worlds.
        timeout: Seconds without a frame after which the iteration ends; None: it never ends.
    """
    if timeout is not None and not timeout >= 0:
        raise invalid("timeout", "seconds of at least 0, or None", timeout)
    return Observer(instance, world=world, timeout=timeout)


def frame_of(fields: dict[str, Any]) -> Frame:
    """Makes a `Frame` from the fields of a sample."""
    fields["result"] = WorldResult(*fields["result"])
    fields["robots"] = tuple(
        RobotFrame(result=RobotResult(*result), frame=frame, path=path)
        for result, frame, path in fields["robots"]
    )
    return Frame(**fields)
