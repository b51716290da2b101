"""Records in, scenes out: the known model's filter runs along, also where steps are missing."""

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

# After a longer gap the belief begins again: a fire depends on the last 5,500 steps or so.
_MOST_LOST = 10_000
_MOST_WAITING = 1 << 26  # cells of hidden states that wait for their frames


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """A recorded step.

    Attributes:
        server: The server that simulated it.
        frame: What the robots saw and flew, and the step's result.
        truth: Hidden states, `(H, W)`; None where they are not recorded.
        n_lost: Steps right before it that are not recorded; None where a new episode begins.
    """

    server: ServerInfo
    frame: Frame
    truth: NDArray[np.uint8] | None
    n_lost: int | None


def steps(records: Iterable[Record]) -> Iterator[Step]:
    """The steps of the one world that the records are of; a frame published again counts once.

    Warns:
        UserWarning: Another server's worlds follow, of another kind; they are left out.
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
    """Which steps k to show: every n-th from the first to the last."""

    first: int
    last: float
    every: int

    def shows(self, step: Step) -> bool:
        k = step.frame.result.step
        return self.first <= k <= self.last and (k - self.first) % self.every == 0

    def shows_gap(self, step: Step) -> bool:
        """Whether the steps right before it that are not recorded are shown, in one scene."""
        k, n_lost = step.frame.result.step, step.n_lost or 0
        return 0 < n_lost <= _MOST_LOST and self.first < k and k - n_lost <= self.last


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """What one picture shows. Parts that are not recorded are None.

    Attributes:
        step: The step, or the one behind a gap.
        k: Number of the step shown: of a gap the last.
        is_gap: Whether it stands for the steps before `step` that are not recorded.
        paths: Each robot's cells, the start first, `(n, 2)`.
        belief: The posterior, of a gap the predictor, `(S, H, W)`; None where no model is known.
        since: The step at which the belief began.
        n_lost: Steps since then that are not recorded.
        mean_reward: Of the recorded steps since then.
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
    """The scenes to show.

    Args:
        steps: Every step there is, also those that are not shown.
        selection: Which to show.
        begin: The belief before the frame of a step k; None where no model is known.
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
    """What must be equal for one filter to follow two servers' worlds."""
    return server.height, server.width, server.n_observations, server.model
