"""What observers of an instance receive: frames, hidden states and beliefs.

For example `for frame in emberwatch.observe("lab", timeout=10): print(frame.result.reward)`. An
observer may be opened before the server starts, and stays open when the server ends.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from emberwatch._native import Observer as Observer
from emberwatch._native import OutlookReader as OutlookReader
from emberwatch._native import TruthReader as TruthReader
from emberwatch.client.wire import RobotResult, WorldResult
from emberwatch.errors import EmberwatchError, RequestTimeoutError

#: Observes the frames of an instance.
observe: Final = Observer

#: Seconds to wait for the samples of given steps before a new reader is opened.
_RETRY: Final = 0.02


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


class Newest:
    """The newest published hidden states of consecutive worlds."""

    def __init__(self, instance: str, worlds: range) -> None:
        self._instance = instance
        self._reader: TruthReader | None = TruthReader(instance)
        self._worlds = worlds
        self._samples: dict[int, Truth] = {}

    def at(
        self, moments: Sequence[tuple[int, int, int]], timeout: float, first: int = 0
    ) -> list[Truth]:
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
                self._reader = TruthReader(self._instance)
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


class Present:
    """The current hidden states of worlds in this process, with the interface of `Newest`."""

    def __init__(self, read: Callable[[range], list[Truth]]) -> None:
        self._read = read

    def at(
        self, moments: Sequence[tuple[int, int, int]], _timeout: float, first: int = 0
    ) -> list[Truth]:
        """Returns the hidden states of the given moments, as `Newest.at` does."""
        truths = self._read(range(first, first + len(moments)))
        got = [truth.moment for truth in truths]
        if got != list(moments):
            raise EmberwatchError(f"truth: expected worlds at {moments}, got {got}", "late")
        return truths

    def close(self) -> None:
        pass
