"""What a recording tells of one world, step by step: records in, steps out."""

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emberwatch.observer import Frame, Truth
from emberwatch.recording import Record
from emberwatch.replies import ServerInfo

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
            truths[sample.seed, sample.episode, sample.step] = sample.states
            if len(truths) * sample.states.size > _MOST_WAITING:
                del truths[next(iter(truths))]
            continue
        result, n_lost = sample.result, None
        if last is not None and last[0] == result.episode and last[1] <= result.step:
            n_lost = result.step - last[1] - 1
        last = result.episode, result.step
        if n_lost != -1:
            truth = truths.pop((result.seed, *last), None)
            yield Step(server=record.server, frame=sample, truth=truth, n_lost=n_lost)


def _kind(server: ServerInfo) -> tuple[object, ...]:
    """What must be equal for one filter to follow two servers' worlds."""
    return server.height, server.width, server.n_observations, server.model
