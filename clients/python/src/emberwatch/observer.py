"""Observers: read what happens on an instance, before, while and after a server runs.

Such as `for frame in emberwatch.observe("lab", timeout=10): print(frame.result.reward)`.
"""

import ctypes
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from traceback import clear_frames
from typing import Any, Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from emberwatch import wire
from emberwatch.channels import Closable, Node, channel_errors, in_turn
from emberwatch.errors import RequestTimeoutError, bad_answer, invalid
from emberwatch.wire import RobotResult, WorldResult

# Seconds to sleep while there is no sample, soon after many came and else: publishing notifies
# nobody, and spinning would take a core from the server.
_BUSY_SLEEP: Final = 500e-6
_CALM_SLEEP: Final = 4e-3

#: How long to wait for samples of given steps before they are first asked for again, seconds.
_RETRY: Final = 0.02

#: How long many samples are expected after many came, seconds.
_BUSY: Final = 1.0

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
    """A subscriber of one channel."""

    def __init__(
        self,
        instance: str,
        service: str,
        header: type[wire.Header],
        decode: Callable[[Any, bytearray, int], _Sample],
        *,
        readers: int,
        buffer: int,
        publishers: int = 1,
    ) -> None:
        self._header, self._decode = header, decode
        #: Samples of others are left out; None: of all worlds.
        self._world: int | None = None
        #: The next sequence number of each publisher: each agent counts its own.
        self._next: dict[int, int] = {}
        self._many = buffer // 4
        self._n_found = 0
        self._busy_at = time.perf_counter()
        with in_turn():
            self._node = node = Node(instance)
            try:
                factory = node.open_publications(service, header, readers, buffer, publishers)
                with channel_errors(f"read {service}", f"{readers} readers"):
                    port = factory.subscriber_builder().buffer_size(buffer).create()
                    self._subscriber: Any = node.keep(port)
                    if publishers == 1:  # the server, which publishes the current state on this
                        wake = node.keep(node.open_wake("wake-server").notifier_builder())
                        node.keep(wake.create()).notify()
                    node.remember_files()
                    node.fill_ports()
            except BaseException:
                node.close()
                raise

    @property
    def instance(self) -> str:
        return self._node.instance

    def close(self) -> None:
        self._subscriber = None
        self._node.close()

    def receive(self, timeout: float) -> _Sample | None:
        """The next sample; `None` if none comes within `timeout` seconds."""
        deadline = time.perf_counter() + timeout
        n_lost = 0
        while True:
            copied = self._wait(max(0.0, deadline - time.perf_counter()))
            if copied is None:
                return None
            header, payload, lost = copied
            n_lost += lost
            if self._world in (None, header.world):
                return self._decode(header, payload, n_lost)

    def _wait(self, timeout: float) -> tuple[Any, bytearray, int] | None:
        self._node.check()
        start = time.perf_counter()
        while True:
            copied = self._take()
            if copied is not None:
                self._n_found += 1
                return copied
            self._node.check_files()
            waited = time.perf_counter() - start
            if not waited < timeout:
                return None
            time.sleep(min(self._interval(), timeout - waited))

    def _take(self) -> tuple[Any, bytearray, int] | None:
        """A sample, copied, if there is one."""
        sample = None
        try:
            with channel_errors("receive a sample"):
                sample = self._subscriber.receive()
            return None if sample is None else self._copied(sample)
        except BaseException as error:
            # Its traceback, which a notebook keeps, keeps what is lent alive, too.
            clear_frames(error.__traceback__)
            raise
        finally:
            sample = None

    def _copied(self, sample: Any) -> tuple[Any, bytearray, int]:
        """Header, payload and the number of samples lost before it."""
        size = ctypes.sizeof(self._header)
        header: Any = self._header.from_buffer_copy(ctypes.string_at(sample.user_header_ptr, size))
        if header.version != wire.VERSION:
            raise bad_answer("sample", f"version {wire.VERSION}", header.version)
        payload = bytearray(ctypes.string_at(sample.payload_ptr, sample.payload().len()))
        publisher = getattr(header, "pid", 0)
        # A smaller number than expected is a new server's.
        lost = max(0, header.sequence - self._next.get(publisher, header.sequence))
        self._next[publisher] = header.sequence + 1
        return header, payload, lost

    def _interval(self) -> float:
        """How long to sleep, now that the buffer is empty."""
        now = time.perf_counter()
        if self._n_found > self._many:
            self._busy_at = now
        self._n_found = 0
        return _BUSY_SLEEP if now - self._busy_at < _BUSY else _CALM_SLEEP


class Observer(Reader[Frame]):
    """Reads the frames of an instance, a sample for each step of a world. Iterate over it.

    It never slows the server.
    """

    def __init__(
        self, instance: str = "default", *, world: int | None = None, timeout: float | None = None
    ) -> None:
        """Subscribes; see `observe`."""
        limits = {"readers": wire.MAX_OBSERVERS, "buffer": wire.FRAME_BUFFER}
        super().__init__(instance, "frames", wire.FrameHeader, frame_from_sample, **limits)
        self._world = world
        self._timeout = timeout

    def __iter__(self) -> Iterator[Frame]:
        """Yields frames as they come, until none comes for `timeout`; without one, for ever."""
        while True:
            # In portions, so that Ctrl-C is heard and time does not overflow.
            frame = self.receive(3600.0 if self._timeout is None else self._timeout)
            if frame is not None:
                yield frame
            elif self._timeout is not None:
                return


class TruthReader(Reader[Truth]):
    """Reads the hidden states of an instance whose server publishes them."""

    def __init__(self, instance: str = "default") -> None:
        limits = {"readers": wire.MAX_TRUTH_READERS, "buffer": wire.TRUTH_BUFFER}
        super().__init__(instance, "truth", wire.TruthHeader, truth_from_sample, **limits)


class OutlookReader(Reader[Outlook]):
    """Reads what agents believe, which they publish while there is a reader."""

    def __init__(self, instance: str = "default") -> None:
        limits = {"readers": wire.MAX_AGENT_READERS, "buffer": wire.AGENT_BUFFER}
        limits["publishers"] = wire.MAX_CLIENTS
        super().__init__(instance, "agent", wire.AgentHeader, outlook_from_sample, **limits)


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


def frame_from_sample(header: Any, payload: bytearray, n_lost: int) -> Frame:
    """A step out of a sample's header and payload, which it keeps."""
    n_robots, grid = header.n_robots, (header.height, header.width)
    if not 1 <= n_robots <= wire.MAX_ROBOTS:
        raise bad_answer("sample", f"1 to {wire.MAX_ROBOTS} robots", n_robots)
    world = WorldResult(*wire.WORLD.unpack(bytes(header.result)))
    wire.check_stayed(world.hovered | world.late, n_robots)
    n_cells = grid[0] * grid[1]
    at = n_robots * (wire.ROBOT.size + n_cells)
    _check_length(min(len(payload), at), at)
    results = [
        RobotResult(*wire.ROBOT.unpack_from(payload, robot * wire.ROBOT.size))
        for robot in range(n_robots)
    ]
    _check_length(len(payload), at + sum(result.n_moves for result in results))
    frames = np.frombuffer(payload, np.uint8, n_robots * n_cells, n_robots * wire.ROBOT.size)
    robots: list[RobotFrame] = []
    for result, frame in zip(results, frames.reshape(n_robots, *grid), strict=True):
        path = np.frombuffer(payload, np.uint8, result.n_moves, at)
        robots.append(RobotFrame(result=result, frame=frame, path=path))
        at += result.n_moves
    return Frame(world=header.world, result=world, robots=tuple(robots), n_lost=n_lost)


def truth_from_sample(header: Any, payload: bytearray, n_lost: int) -> Truth:
    """Hidden states out of a sample's header and payload, which they keep."""
    _check_length(len(payload), header.height * header.width)
    return Truth(
        world=header.world,
        episode=header.episode,
        step=header.step,
        seed=header.seed,
        states=np.frombuffer(payload, np.uint8).reshape(header.height, header.width),
        n_lost=n_lost,
    )


def outlook_from_sample(header: Any, payload: bytearray, n_lost: int) -> Outlook:
    """An outlook out of a sample's header and payload, which it keeps."""
    shape = (header.n_states, header.height, header.width)
    n_bytes = 4 * header.n_states * header.height * header.width
    if len(payload) < n_bytes:
        raise bad_answer("sample", f"{n_bytes} bytes or more", len(payload))
    try:
        intent: dict[str, Any] = json.loads(payload[n_bytes:])
        return Outlook(
            world=header.world,
            episode=header.episode,
            step=header.step,
            seed=header.seed,
            belief=np.frombuffer(payload, np.float32, n_bytes // 4).reshape(shape),
            states=tuple(str(state) for state in intent["states"]),
            policy=str(intent["policy"]),
            belief_from=str(intent["belief_from"]),
            objective=str(intent["objective"]),
            plan_millis=float(intent["plan_millis"]),
            pid=header.pid,
            robots=range(header.first_robot, header.first_robot + header.n_robots),
            n_lost=n_lost,
        )
    except (ValueError, KeyError, TypeError) as error:
        raise bad_answer("sample", "an agent's intent", repr(error)) from error


def _check_length(got: int, expected: int) -> None:
    if got != expected:
        raise bad_answer("sample", f"{expected} bytes", got)
