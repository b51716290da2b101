"""Observers: read what happens on an instance, before, while and after a server runs.

Such as `for frame in emberwatch.observe("lab", timeout=10): print(frame.result.reward)`.
"""

from __future__ import annotations

import ctypes
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch import wire
from emberwatch.channels import Closing, Node, guard, in_turn
from emberwatch.errors import GarbledAnswerError, SettingError
from emberwatch.wire import StepResult

#: How long to sleep between two looks, seconds, while much comes and while little does: publishing
#: wakes nobody, and spinning would take a core from the server.
_BUSY_LOOK: Final = 500e-6
_CALM_LOOK: Final = 4e-3

#: How long much is expected after it came, seconds.
_BUSY: Final = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """A published frame, copied.

    Attributes:
        world: The world.
        result: The step's result.
        frame: What was seen, `(H, W)`: an observation, or 255 where nothing was seen.
        path: The moves flown, `(n_moves,)`; empty after a reset.
        start: Where the path began, `(row, col)`.
        n_lost: Samples that this observer missed since the last one it got.
    """

    world: int
    result: StepResult
    frame: NDArray[np.uint8]
    path: NDArray[np.uint8]
    start: tuple[int, int]
    n_lost: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """Published hidden states, copied. For evaluation and pictures, never for learners.

    Attributes:
        world: The world.
        episode: Resets of the world since the server started.
        step: k of the states.
        seed: Seed of the episode.
        states: The hidden states, `(H, W)`.
        n_lost: Samples that this reader missed since the last one it got.
    """

    world: int
    episode: int
    step: int
    seed: int
    states: NDArray[np.uint8]
    n_lost: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outlook:
    """What an agent believes of a world and wants there, copied.

    Attributes:
        world: The world.
        episode: Resets of the world since the server started.
        step: k of the state that the belief is about.
        seed: Seed of the episode.
        belief: The belief after that step's frame, `(S, H, W)`, float32, each in 0..=1.
        states: Names of its states.
        policy: The agent's policy.
        belief_from: Where the belief comes from.
        objective: What the last path was for.
        plan_millis: Time that its plan took, milliseconds.
        pid: The agent's process.
        n_lost: Samples of this agent that this reader missed since the last one it got.
    """

    world: int
    episode: int
    step: int
    seed: int
    belief: NDArray[np.float32]
    states: tuple[str, ...]
    policy: str
    belief_from: str
    objective: str
    plan_millis: float
    pid: int
    n_lost: int


class _Reader(Closing):
    """A subscriber of one channel."""

    def __init__(
        self,
        instance: str,
        service: str,
        header: type[wire.Header],
        limits: tuple[int, int],
        *,
        publishers: int = 1,
    ) -> None:
        self._header = header
        self._next: dict[int, int] = {}
        self._much = limits[1] // 4
        self._n_found = 0
        self._busy = time.perf_counter()
        self._node = Node(instance)
        try:
            readers, buffer = limits
            factory = self._node.open_publications(
                service, header, readers, buffer, publishers=publishers
            )
            with in_turn(), guard(f"read {service} (are there more than {readers} readers?)"):
                port = factory.subscriber_builder().buffer_size(buffer).create()
                self._subscriber: Any = self._node.keep(port)
                if publishers == 1:  # the server, which shows where its worlds are
                    wake = self._node.keep(self._node.open_wake("wake-server").notifier_builder())
                    self._node.keep(wake.create()).notify()
        except BaseException:
            self._node.close()
            raise

    @property
    def instance(self) -> str:
        """The instance's name."""
        return self._node.instance

    def close(self) -> None:
        """Stops reading. Again is fine."""
        self._subscriber = None
        self._node.close()

    def _sample(self, timeout: float) -> tuple[Any, bytearray, int] | None:
        """Header, payload and number of lost samples; `None` if nothing comes in time."""
        self._node.check()
        start = time.perf_counter()
        while True:
            with guard("receive a sample"):
                sample = self._subscriber.receive()
            if sample is not None:
                self._n_found += 1
                break
            waited = time.perf_counter() - start
            if not waited < timeout:
                return None
            time.sleep(min(self._interval(), timeout - waited))
        size = ctypes.sizeof(self._header)
        header: Any = self._header.from_buffer_copy(ctypes.string_at(sample.user_header_ptr, size))
        if header.version != wire.VERSION:
            raise GarbledAnswerError(
                f"sample: expected version {wire.VERSION}, got {header.version}"
            )
        payload = bytearray(ctypes.string_at(sample.payload_ptr, sample.payload().len()))
        # A smaller number than expected is a new server's. Each agent counts its own.
        publisher = getattr(header, "pid", 0)
        lost = max(0, header.sequence - self._next.get(publisher, header.sequence))
        self._next[publisher] = header.sequence + 1
        return header, payload, lost

    def _interval(self) -> float:
        """How long to sleep, now that the buffer is empty."""
        now = time.perf_counter()
        if self._n_found > self._much:
            self._busy = now
        self._n_found = 0
        return _BUSY_LOOK if now - self._busy < _BUSY else _CALM_LOOK


class Observer(_Reader):
    """Reads the frames of an instance; iterate over it. Never slows the server."""

    def __init__(
        self, instance: str = "default", *, world: int | None = None, timeout: float | None = None
    ) -> None:
        """Subscribes; see `observe`."""
        super().__init__(
            instance, "frames", wire.FrameHeader, (wire.MAX_OBSERVERS, wire.FRAME_BUFFER)
        )
        self._world = world
        self._timeout = timeout

    def receive(self, timeout: float) -> Frame | None:
        """The next frame; `None` if none comes within so many seconds.

        Raises:
            GarbledAnswerError: If what comes makes no sense.
        """
        deadline = time.perf_counter() + timeout
        n_lost = 0
        while True:
            sample = self._sample(max(0.0, deadline - time.perf_counter()))
            if sample is None:
                return None
            header, payload, lost = sample
            n_lost += lost
            if self._world is None or header.world == self._world:
                return frame_from_sample(header, payload, n_lost)

    def __iter__(self) -> Iterator[Frame]:
        """Yields frames as they come, until none comes for `timeout`; without one, for ever."""
        while True:
            # In portions, so that Ctrl-C is heard and time does not overflow.
            frame = self.receive(3600.0 if self._timeout is None else self._timeout)
            if frame is not None:
                yield frame
            elif self._timeout is not None:
                return


class TruthReader(_Reader):
    """Reads the hidden states of an instance whose server publishes them."""

    def __init__(self, instance: str = "default") -> None:
        """Subscribes.

        Raises:
            ChannelError: If iceoryx2 fails, also when there are more than 4 readers.
        """
        super().__init__(
            instance, "truth", wire.TruthHeader, (wire.MAX_TRUTH_READERS, wire.TRUTH_BUFFER)
        )

    def receive(self, timeout: float) -> Truth | None:
        """The next hidden states; `None` if none come within so many seconds.

        Raises:
            GarbledAnswerError: If what comes makes no sense.
        """
        sample = self._sample(timeout)
        if sample is None:
            return None
        return truth_from_sample(*sample)


class OutlookReader(_Reader):
    """Reads what agents believe, which they show now and then while somebody reads."""

    def __init__(self, instance: str = "default") -> None:
        """Subscribes.

        Raises:
            ChannelError: If iceoryx2 fails, also when there are more than 4 readers.
        """
        limits = (wire.MAX_AGENT_READERS, wire.AGENT_BUFFER)
        publishers = wire.MAX_CLIENTS
        super().__init__(instance, "agent", wire.AgentHeader, limits, publishers=publishers)

    def receive(self, timeout: float) -> Outlook | None:
        """The next one; `None` if none comes within so many seconds.

        Raises:
            GarbledAnswerError: If what comes makes no sense.
        """
        sample = self._sample(timeout)
        return None if sample is None else outlook_from_sample(*sample)


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

    Raises:
        SettingError: If a value is impossible.
        ChannelError: If iceoryx2 fails, also when there are more than 16 observers.
    """
    if timeout is not None and not timeout >= 0:
        raise SettingError(f"timeout: expected seconds, at least 0, or None, got {timeout}")
    return Observer(instance, world=world, timeout=timeout)


def frame_from_sample(header: Any, payload: bytearray, n_lost: int) -> Frame:
    """A frame out of a sample's header and payload, which it keeps.

    Raises:
        GarbledAnswerError: If the lengths do not agree.
    """
    n_cells = header.height * header.width
    _check_length(len(payload), n_cells + header.n_moves)
    return Frame(
        world=header.world,
        result=StepResult(*wire.RESULT.unpack(bytes(header.result))),
        frame=np.frombuffer(payload, np.uint8, n_cells).reshape(header.height, header.width),
        path=np.frombuffer(payload, np.uint8, offset=n_cells),
        start=(header.start_row, header.start_col),
        n_lost=n_lost,
    )


def truth_from_sample(header: Any, payload: bytearray, n_lost: int) -> Truth:
    """Hidden states out of a sample's header and payload, which they keep.

    Raises:
        GarbledAnswerError: If the lengths do not agree.
    """
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
    """An outlook out of a sample's header and payload, which it keeps.

    Raises:
        GarbledAnswerError: If the lengths do not agree, or the text is not what it should be.
    """
    shape = (header.n_states, header.height, header.width)
    n_bytes = 4 * header.n_states * header.height * header.width
    if len(payload) < n_bytes:
        raise GarbledAnswerError(f"sample: expected {n_bytes} bytes or more, got {len(payload)}")
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
            n_lost=n_lost,
        )
    except (ValueError, KeyError, TypeError) as error:
        raise GarbledAnswerError(f"sample: expected an agent's intent, got {error!r}") from error


def _check_length(got: int, expected: int) -> None:
    if got != expected:
        raise GarbledAnswerError(f"sample: expected {expected} bytes, got {got}")
