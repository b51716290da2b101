"""Scenes of a recording, with the belief of a filter that also predicts through missing steps."""

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

# Maximum number of steps that a belief is predicted at a time, or simulated before the first frame.
# A fire depends only on about the last 5,500 steps, so more would not change the belief.
MOST_PREDICTED = 10_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """The contents of one picture."""

    frame: Frame
    truth: NDArray[np.uint8] | None  # (H, W); None if it is not recorded
    belief: NDArray[np.float32] | None  # the posterior, (S, H, W); None without a model
    since: int  # the first recorded step of the episode, at which the belief began
    n_lost: int  # number of missing steps since then
    mean_reward: float  # of the recorded steps since then


def scenes(records: Iterable[Record], begin: Callable[[int], Belief] | None) -> Iterator[Scene]:
    """Yields a scene for each recorded step of one world. A frame published again counts once.

    `begin` makes the belief before the frame of a step k; None without a model. Warns if worlds of
    another kind follow, from another server, which are left out.
    """
    server = last = belief = None
    truths: dict[tuple[int, int, int], NDArray[np.uint8]] = {}
    since = n_lost = 0
    rewards: list[float] = []
    for record in records:
        if server is not None and _kind(record.server) != _kind(server):
            warnings.warn("worlds of another kind follow, which are left out", stacklevel=2)
            return
        if record.server != server:
            server, last, truths = record.server, None, {}
        if isinstance(record.sample, Truth):
            truths[record.sample.moment] = record.sample.states
            continue
        frame, result = record.sample, record.sample.result
        k = result.step
        if last is None or last.episode != result.episode or last.step > k:
            belief = None if begin is None else begin(k)
            since, n_lost, rewards = k, 0, []
        elif last.step == k:
            continue
        else:
            n_lost += k - last.step - 1
            if belief is not None:
                for _ in range(min(k - last.step, MOST_PREDICTED)):
                    belief.predict()
        last = result
        try:
            if belief is not None:
                belief.correct(frame.frame)
        except EmberwatchError as error:
            raise EmberwatchError(f"step {k}: {error}", error.code) from error
        rewards += [result.reward] if k > 0 else []
        yield Scene(
            frame=frame,
            truth=truths.pop(frame.moment, None),
            belief=None if belief is None else belief.belief,
            since=since,
            n_lost=n_lost,
            mean_reward=sum(rewards) / max(len(rewards), 1),
        )


def _kind(server: ServerInfo) -> tuple[object, ...]:
    """Returns the settings in which two servers must agree so that one filter can follow both."""
    return server.height, server.width, server.n_observations, server.model
