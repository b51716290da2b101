"""Scenes of a recording, with a filter that also predicts through missing steps."""

import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emberwatch.belief import Belief
from emberwatch.client.observer import Frame, Truth
from emberwatch.client.recording import Record
from emberwatch.client.replies import ServerInfo
from emberwatch.errors import EmberwatchError
from emberwatch.model.moves import fly

# Maximum number of missing steps over which the belief is predicted. After a longer gap the belief
# starts again, because a fire depends only on about the last 5,500 steps.
_MOST_LOST = 10_000
_MOST_WAITING = 1 << 26  # maximum number of cells of hidden states that wait for their frames


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """A recorded step.

    Attributes:
        server: The server that simulated it.
        frame: The robots' frames and paths, and the step's result.
        truth: The hidden states, `(H, W)`; None if they are not recorded.
        n_lost: Number of missing steps right before this one; None if a new episode begins.
    """

    server: ServerInfo
    frame: Frame
    truth: NDArray[np.uint8] | None
    n_lost: int | None


def steps(records: Iterable[Record]) -> Iterator[Step]:
    """Yields the steps of the records of one world. A frame that was published again counts once.

    Warns:
        UserWarning: If worlds of another kind follow, from another server. These worlds are left
            out.
    """
    server: ServerInfo | None = None
    last: tuple[int, int] | None = None
    truths: dict[tuple[int, int, int], NDArray[np.uint8]] = {}
    for record in records:
        if record.server != server:
            if server is not None and _kind(record.server) != _kind(server):
                warnings.warn("worlds of another kind follow, which are left out", stacklevel=2)
                return
            server, last, truths = record.server, None, {}
        sample = record.sample
        if isinstance(sample, Truth):
            truths[sample.moment] = sample.states
            if len(truths) * sample.states.size > _MOST_WAITING:
                del truths[next(iter(truths))]
            continue
        result, n_lost = sample.result, None
        if last is not None and last[0] == result.episode and last[1] <= result.step:
            n_lost = result.step - last[1] - 1
        last = result.episode, result.step
        if n_lost != -1:
            truth = truths.pop(result.moment, None)
            yield Step(server=record.server, frame=sample, truth=truth, n_lost=n_lost)


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """The steps k to show: every `every`-th one from `first` to `last`."""

    first: int
    last: float
    every: int

    def shows(self, step: Step) -> bool:
        k = step.frame.result.step
        return self.first <= k <= self.last and (k - self.first) % self.every == 0

    def shows_gap(self, step: Step) -> bool:
        """Returns whether the missing steps right before `step` are shown, in one scene."""
        k, n_lost = step.frame.result.step, step.n_lost or 0
        return 0 < n_lost <= _MOST_LOST and self.first < k and k - n_lost <= self.last


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """The contents of one picture. Parts that are not recorded are None.

    Attributes:
        step: The shown step, or the step after a gap.
        k: Number of the shown step; in a gap, the last missing one.
        is_gap: Whether the scene stands for the missing steps before `step`.
        paths: The cells of each robot, `(n, 2)`, its start first.
        belief: The posterior, or in a gap the predictor, `(S, H, W)`; None without a model.
        since: The step at which the belief began.
        n_lost: Number of missing steps since the belief began.
        mean_reward: Mean reward of the recorded steps since the belief began.
    """

    step: Step
    k: int
    is_gap: bool = False
    paths: list[NDArray[np.intp]] | None = None
    belief: NDArray[np.float32] | None
    since: int
    n_lost: int
    mean_reward: float = 0.0


def scenes(
    steps: Iterable[Step], selection: Selection, begin: Callable[[int], Belief] | None
) -> Iterator[Scene]:
    """Yields the scenes to show.

    Args:
        steps: All recorded steps, including the ones that are not shown.
        selection: The steps to show.
        begin: Makes the belief before the frame of a step k; None without a model.
    """
    known: Belief | None = None
    since = n_lost = n_rewards = 0
    total = 0.0
    for step in steps:
        k = step.frame.result.step
        if step.n_lost is None or step.n_lost > _MOST_LOST:
            known = None if begin is None else begin(k)
            since, n_lost, n_rewards, total = k, 0, 0, 0.0
        else:
            n_lost += step.n_lost
            _predict(known, step.n_lost)
            if selection.shows_gap(step):
                belief = known and known.belief
                yield Scene(
                    step=step, k=k - 1, is_gap=True, belief=belief, since=since, n_lost=n_lost
                )
            _predict(known, 1)
        try:
            if known is not None:
                known.correct(step.frame.frame)
        except EmberwatchError as error:
            raise EmberwatchError(f"step {k}: {error}", error.code) from error
        if k > 0:
            n_rewards, total = n_rewards + 1, total + step.frame.result.reward
        if selection.shows(step):
            yield Scene(
                step=step,
                k=k,
                paths=_paths(step),
                belief=known and known.belief,
                since=since,
                n_lost=n_lost,
                mean_reward=total / max(n_rewards, 1),
            )


def _predict(known: Belief | None, n_steps: int) -> None:
    if known is not None:
        for _ in range(n_steps):
            known.predict()


def _paths(step: Step) -> list[NDArray[np.intp]]:
    return [
        np.array([robot.result.start, *fly(robot.result.start, robot.path, step.server)], np.intp)
        for robot in step.frame.robots
    ]


def _kind(server: ServerInfo) -> tuple[object, ...]:
    """Returns the settings in which two servers must agree so that one filter can follow both."""
    return server.height, server.width, server.n_observations, server.model
