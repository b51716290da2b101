"""Observers: read what happens on an instance, before, while and after a server runs.

Such as `for frame in emberwatch.observe("lab", timeout=10): print(frame.result.reward)`.
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

#: How long to wait for samples of given steps before they are first asked for again, seconds.
_RETRY: Final = 0.02

_Sample = TypeVar("_Sample")
_Step = TypeVar("_Step", bound="Frame | Truth")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobotFrame:
    """What one robot flew and saw, copied."""

    result: RobotResult
    #: What it saw, `(H, W)`: an observation, or 255 where it saw nothing.
    frame: NDArray[np.uint8]
    #: The moves that it flew, `(n_moves,)`; empty after a reset, or if it stayed.
    path: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """A published step of one world, copied."""

    world: int
    result: WorldResult
    #: By robot of the world.
    robots: tuple[RobotFrame, ...]
    #: Samples that this observer missed since the last one it got.
    n_lost: int

    @property
    def frame(self) -> NDArray[np.uint8]:
        """What the team saw, `(H, W)`: an observation, or 255 where nobody saw anything."""
        return np.minimum.reduce([robot.frame for robot in self.robots])

    @property
    def moment(self) -> tuple[int, int, int]:
        """Seed, episode and step."""
        return self.result.moment


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """Published hidden states, copied. For evaluation and pictures, never for learners."""

    world: int
    #: Resets of the world since the server started.
    episode: int
    #: k of the states.
    step: int
    seed: int
    #: The hidden states, `(H, W)`.
    states: NDArray[np.uint8]
    #: Samples that this reader missed since the last one it got.
    n_lost: int

    @property
    def moment(self) -> tuple[int, int, int]:
        """Seed, episode and step."""
        return self.seed, self.episode, self.step


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outlook:
    """What an agent believes about a world and plans there, copied."""

    world: int
    #: Resets of the world since the server started.
    episode: int
    #: k of the state that the belief is about.
    step: int
    seed: int
    #: The belief after that step's frame, `(S, H, W)`, each in 0..=1.
    belief: NDArray[np.float32]
    states: tuple[str, ...]
    policy: str
    belief_from: str
    #: What the last path was for.
    objective: str
    plan_millis: float
    pid: int
    #: The numbers of the robots that the agent flies.
    robots: range
    #: Samples of this agent that this reader missed since the last one it got.
    n_lost: int


class Reader(Closable, Generic[_Sample]):
    """A subscriber of one channel. It never slows whom it reads."""

    def __init__(
        self, instance: str, native: _native.Frames | _native.Truths | _native.Outlooks
    ) -> None:
        self.instance: Final = instance
        self._native = native

    def close(self) -> None:
        self._native.close()

    def receive(self, timeout: float) -> _Sample | None:
        """The next sample; `None` if none comes within `timeout` seconds."""
        fields = self._native.receive(timeout)
        return None if fields is None else self._made(fields)

    def _made(self, fields: dict[str, Any]) -> _Sample:
        raise NotImplementedError


class Observer(Reader[Frame]):
    """Reads the frames of an instance, a sample for each step of a world. Iterate over it."""

    def __init__(
        self, instance: str = "default", *, world: int | None = None, timeout: float | None = None
    ) -> None:
        """Subscribes; see `observe`."""
        super().__init__(instance, _native.Frames(instance, world))
        self._timeout = timeout

    def __iter__(self) -> Iterator[Frame]:
        """Yields frames as they come, until none comes for `timeout`; without one, for ever."""
        while True:
            # In portions, so that time does not overflow.
            frame = self.receive(3600.0 if self._timeout is None else self._timeout)
            if frame is not None:
                yield frame
            elif self._timeout is not None:
                return

    def _made(self, fields: dict[str, Any]) -> Frame:
        return frame_of(fields)


class TruthReader(Reader[Truth]):
    """Reads the hidden states of an instance whose server publishes them."""

    def __init__(self, instance: str = "default") -> None:
        super().__init__(instance, _native.Truths(instance))

    def _made(self, fields: dict[str, Any]) -> Truth:
        return Truth(**fields)


class OutlookReader(Reader[Outlook]):
    """Reads what agents believe, which they publish while there is a reader."""

    def __init__(self, instance: str = "default") -> None:
        super().__init__(instance, _native.Outlooks(instance))

    def _made(self, fields: dict[str, Any]) -> Outlook:
        first, n_robots = fields["robots"]
        fields["states"] = tuple(fields["states"])
        fields["robots"] = range(first, first + n_robots)
        return Outlook(**fields)


class Newest(Generic[_Step]):
    """The newest samples of consecutive worlds: for infos, pictures and rewards by the move."""

    def __init__(self, subscribe: Callable[[], Reader[_Step]], worlds: range) -> None:
        self._subscribe = subscribe
        self._reader: Reader[_Step] | None = subscribe()
        self._worlds = worlds
        self._samples: dict[int, _Step] = {}

    def at(
        self, moments: Sequence[tuple[int, int, int]], timeout: float, first: int = 0
    ) -> list[_Step]:
        """The samples of the worlds from `first` on at these moments.

        Args:
            moments: Seed, episode and step of each world.
            first: The first of these worlds, counted from 0.
        """
        wanted = dict(zip(self._worlds[first:], moments, strict=False))
        begin = asked = time.perf_counter()
        n_asked = n_lost = 0
        while any(self._moment(world) != moment for world, moment in wanted.items()):
            now = time.perf_counter()
            if now - begin > timeout:
                raise RequestTimeoutError(f"nothing was published within {timeout} s")
            # The samples of other worlds may have displaced these: a new reader gets all again.
            # Where it missed nothing, they may just take longer.
            if now - asked > (_RETRY if n_lost else _RETRY * 2**n_asked):
                self.close()
                asked, n_asked, n_lost = now, n_asked + 1, 0
            if self._reader is None:  # also where it was interrupted in between
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
    """The hidden states of worlds in this process; `Newest` has the states of a server."""

    def __init__(self, read: Callable[[range], list[dict[str, Any]]]) -> None:
        self._read = read

    def at(
        self, moments: Sequence[tuple[int, int, int]], _timeout: float, first: int = 0
    ) -> list[Truth]:
        """As `Newest.at`."""
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
    """Observes an instance: an iterator of frames, also a context manager.

    The server publishes every world's current frame as soon as an observer comes. Repeats are
    possible: same episode, same step.

    Args:
        instance: The instance's name; its server may start later.
        world: Only this world; None: all.
        timeout: Iteration ends when no frame comes for so many seconds; None: never.
    """
    if timeout is not None and not timeout >= 0:
        raise invalid("timeout", "seconds, at least 0, or None", timeout)
    return Observer(instance, world=world, timeout=timeout)


def frame_of(fields: dict[str, Any]) -> Frame:
    """A step out of a sample's fields."""
    fields["result"] = WorldResult(*fields["result"])
    fields["robots"] = tuple(
        RobotFrame(result=RobotResult(*result), frame=frame, path=path)
        for result, frame, path in fields["robots"]
    )
    return Frame(**fields)
