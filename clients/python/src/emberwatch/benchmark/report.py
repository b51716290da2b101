"""Reports of an evaluation: its progress, and a summary of its rows."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from emberwatch._native import FIRST_TRAINING_SEED
from emberwatch.benchmark.rows import Row
from emberwatch.errors import invalid, repr_of


class Progress:
    """The progress of an evaluation, printed each second on a terminal, otherwise at the end."""

    def __init__(self, out: TextIO | None, name: str, seeds: Sequence[int], steps: int) -> None:
        self._out, self._title = out, f"{name}: {_worlds(seeds)}"
        self._n_steps, self._n_done = len(seeds) * steps, 0
        self._begin = self._last = time.monotonic()

    def add(self, n_steps: int, *, ends: bool = False) -> None:
        """Adds steps. The last call has `ends`, also if the evaluation ends early."""
        self._n_done += n_steps
        now, done = time.monotonic(), 100 * self._n_done // self._n_steps
        is_terminal = self._out is not None and self._out.isatty()
        if self._out is not None and (ends or is_terminal and now > self._last + 1.0):
            self._last = now
            line = f"{self._title}, {done} %, {now - self._begin:.0f} s"
            print("\r" * is_terminal + line, end="\n" * ends, file=self._out, flush=True)


def summary(rows: Sequence[Row], *, baseline: str | None = None) -> str:
    """Returns each policy's mean reward per step and its standard error over worlds, in lines.

    Args:
        rows: The rows of one or several policies.
        baseline: The name of a policy in `rows`. If given, the line of each other policy also has
            the mean difference from this policy's rewards, paired by world, with its standard error
            and 95 % interval (Student's t).
    """
    if not rows:
        raise invalid("rows", "at least one", "none")
    policies: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        policies.setdefault((row.policy, row.estimator, row.robots, row.team), []).append(row)
    bases = [each for name, each in policies.items() if name[0] == baseline]
    if baseline is not None and len(bases) != 1:
        names = ", ".join(name for name, *_ in policies)
        raise invalid("baseline", f"the name of one of the policies {names}", repr_of(baseline))
    lines = [
        _line(each) + "".join(_difference(each, base) for base in bases if each is not base)
        for each in policies.values()
    ]
    return "\n".join(lines)


def _line(rows: Sequence[Row]) -> str:
    """Returns the summary of one policy."""
    rewards = np.array([row.mean_reward for row in rows])
    words = f"a step on {_worlds([row.world_seed for row in rows])}"
    if len(rows) == 1:
        return f"{rows[0].policy}: {rewards[0]:.2f} {words}, too few for a standard error"
    return f"{rows[0].policy}: {rewards.mean():.2f} +- {_standard_error(rewards):.2f} {words}"


def _difference(rows: Sequence[Row], base: Sequence[Row]) -> str:
    """Returns the difference of a policy's rewards from another policy's, paired by world."""
    rewards, others = (
        {(row.worlds_fingerprint, row.world_seed, row.steps): row.mean_reward for row in each}
        for each in (rows, base)
    )
    is_known = all(fingerprint for fingerprint, *_ in rewards)
    if (
        rewards.keys() != others.keys()
        or not len(rows) == len(rewards) == len(base)
        or not is_known
    ):
        names = f"{rows[0].policy!r} and {base[0].policy!r}"
        expected = f"the same worlds_fingerprint, seeds and steps of {names}, each world once"
        raise invalid("rows", expected, "others")
    differences = np.array([rewards[world] - others[world] for world in rewards])
    mean, words = differences.mean(), f"; difference from {base[0].policy}"
    if len(differences) == 1:
        return f"{words}: {mean:+.2f}"
    error = _standard_error(differences)
    half = _quantile(len(differences) - 1) * error
    return f"{words}: {mean:+.2f} +- {error:.2f} [{mean - half:+.2f}, {mean + half:+.2f}]"


def _standard_error(values: NDArray[np.float64]) -> float:
    return values.std(ddof=1) / math.sqrt(len(values))


def _quantile(freedom: int) -> float:
    """Returns the bound on |t| with probability 95 %, by degrees of freedom.

    t = sqrt(freedom) tan(angle), where the density of the angle is proportional to
    cos(angle)^(freedom - 1).
    """
    angles = (np.arange(200_000) + 0.5) * (np.pi / 400_000)
    shares = np.cumsum(np.cos(angles) ** (freedom - 1))
    return math.sqrt(freedom) * math.tan(angles[np.searchsorted(shares, 0.95 * shares[-1])])


def _worlds(seeds: Sequence[int]) -> str:
    """Returns the number of worlds in words."""
    n_test = sum(seed < FIRST_TRAINING_SEED for seed in seeds)
    sort = "test " if n_test == len(seeds) else "" if n_test == 0 else f"({n_test} test) "
    return f"{len(seeds)} {sort}{'world' if len(seeds) == 1 else 'worlds'}"
