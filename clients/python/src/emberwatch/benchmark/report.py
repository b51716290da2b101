"""A summary of an evaluation's rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emberwatch._native import FIRST_TRAINING_SEED
from emberwatch.benchmark.rows import Row
from emberwatch.errors import invalid, repr_of


def summary(rows: Sequence[Row], *, baseline: str | None = None) -> str:
    """Returns each policy's mean reward per step and its standard error over worlds, in lines.

    Args:
        rows: The rows of one or several policies.
        baseline: The name of a policy in `rows`. If given, the line of each other policy also has
            the mean difference from this policy's rewards, paired by world, with its standard
            error.
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
    lines: list[str] = []
    for each in policies.values():
        line = f"{each[0].policy}: {_mean([row.mean_reward for row in each], '.2f')} a step on "
        line += _worlds([row.world_seed for row in each])
        for base in bases if bases != [each] else ():
            line += f"; difference from {baseline}: {_mean(_differences(each, base), '+.2f')}"
        lines.append(line)
    return "\n".join(lines)


def _differences(rows: Sequence[Row], base: Sequence[Row]) -> list[float]:
    """Returns how much more a policy found than another one in each world."""
    rewards, others = (
        {(row.worlds_fingerprint, row.world_seed, row.steps): row.mean_reward for row in each}
        for each in (rows, base)
    )
    is_known = all(fingerprint for fingerprint, *_ in rewards)
    is_once = len(rows) == len(rewards) == len(base)
    if rewards.keys() != others.keys() or not is_once or not is_known:
        names = f"{rows[0].policy!r} and {base[0].policy!r}"
        expected = f"the same worlds_fingerprint, seeds and steps of {names}, each world once"
        raise invalid("rows", expected, "others")
    return [rewards[world] - others[world] for world in rewards]


def _mean(values: list[float], style: str) -> str:
    """Returns the mean and its standard error, which needs several values."""
    given: NDArray[np.float64] = np.array(values)
    error = f" +- {given.std(ddof=1) / math.sqrt(len(values)):.2f}" if len(values) > 1 else ""
    return f"{given.mean():{style}}{error}"


def _worlds(seeds: Sequence[int]) -> str:
    """Returns the number of worlds in words."""
    n_test = sum(seed < FIRST_TRAINING_SEED for seed in seeds)
    sort = "test " if n_test == len(seeds) else "" if n_test == 0 else f"({n_test} test) "
    return f"{len(seeds)} {sort}{'world' if len(seeds) == 1 else 'worlds'}"
