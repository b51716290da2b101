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
from emberwatch.errors import invalid


class Progress:
    """The progress of an evaluation, printed each second on a terminal, otherwise at the end."""

    def __init__(self, out: TextIO | None, name: str, seeds: Sequence[int], steps: int) -> None:
        self._out = out
        self._title = f"{name}: {_worlds(seeds)}"
        self._n_steps, self._n_done = len(seeds) * steps, 0
        self._begin = self._last = time.monotonic()

    def add(self, n_steps: int) -> None:
        self._n_done += n_steps
        now = time.monotonic()
        if self._out is not None and self._out.isatty() and now - self._last > 1.0:
            self._last = now
            left = (now - self._begin) * (self._n_steps / self._n_done - 1.0)
            print(f"\r{self._title}, {left:.0f} s left ", end="", file=self._out)

    def end(self, words: str = "") -> None:
        """Prints the time that the evaluation took, and possibly why it ended early."""
        if self._out is not None:
            start = "\r" if self._out.isatty() else ""
            line = f"{start}{self._title}, {time.monotonic() - self._begin:.0f} s{words}"
            print(f"{line}{' ' * 20}".rstrip(), file=self._out)


def summary(rows: Sequence[Row], *, baseline: str | None = None) -> str:
    """Returns each policy's mean reward per step and its standard error, one line per policy.

    Errors and intervals are over worlds, so they need at least two worlds.

    Args:
        rows: The rows of one or several policies.
        baseline: The name of a policy in `rows`. If given, the line of each other policy also has
            the mean difference from this policy's rewards, paired by world, with its standard error
            and 95 % interval (Student's t).

    Raises:
        InvalidArgumentError: If there are no rows. With `baseline`, also if not exactly one policy
            has this name, or if worlds or numbers of steps differ.
    """
    if not rows:
        raise invalid("rows", "at least one", "none")
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.policy, row.estimator, row.robots, row.team), []).append(row)
    policies = list(groups.values())
    if baseline is None:
        return "\n".join(map(_line, policies))
    base = _baseline(policies, baseline)
    return "\n".join(
        _line(each) + ("" if each is base else _difference(each, base)) for each in policies
    )


def _line(rows: Sequence[Row]) -> str:
    """Returns the summary of one policy."""
    rewards = np.array([row.mean_reward for row in rows])
    words = f"a step on {_worlds([row.world_seed for row in rows])}"
    if len(rows) == 1:
        return f"{rows[0].policy}: {rewards[0]:.2f} {words}, too few for a standard error"
    return f"{rows[0].policy}: {rewards.mean():.2f} +- {_standard_error(rewards):.2f} {words}"


def _baseline(policies: Sequence[list[Row]], name: str) -> list[Row]:
    """Returns the rows of a policy; checks that the rows of all policies can be compared."""
    found = [rows for rows in policies if rows[0].policy == name]
    if len(found) != 1:
        names = ", ".join(rows[0].policy for rows in policies)
        raise invalid("baseline", f"the name of one of the policies {names}", repr(name))
    worlds = sorted({row.worlds_fingerprint for rows in policies for row in rows})
    if len(worlds) > 1 or not worlds[0]:
        got = ", ".join(map(repr, worlds))
        raise invalid("rows", "the same worlds_fingerprint in all rows", got)
    return found[0]


def _difference(rows: Sequence[Row], base: Sequence[Row]) -> str:
    """Returns the difference of a policy's rewards from another policy's, paired by world."""
    rewards, others = (
        {(row.world_seed, row.steps): row.mean_reward for row in each} for each in (rows, base)
    )
    if rewards.keys() != others.keys() or len(rewards) != len(rows) or len(rewards) != len(base):
        names = f"{rows[0].policy!r} and {base[0].policy!r}"
        raise invalid("rows", f"one for each of the same worlds and steps of {names}", "others")
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
    angle = angles[np.searchsorted(shares, 0.95 * shares[-1])]
    return math.sqrt(freedom) * math.tan(angle)


def _worlds(seeds: Sequence[int]) -> str:
    """Returns the number of worlds in words."""
    n_test = sum(seed < FIRST_TRAINING_SEED for seed in seeds)
    sort = "test " if n_test == len(seeds) else "" if n_test == 0 else f"({n_test} test) "
    return f"{len(seeds)} {sort}{'world' if len(seeds) == 1 else 'worlds'}"
