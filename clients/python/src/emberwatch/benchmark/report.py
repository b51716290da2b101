"""Reports of an evaluation: its progress, and a summary of its rows."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

import numpy as np

from emberwatch._native import FIRST_TRAINING_SEED
from emberwatch.benchmark.rows import Row
from emberwatch.errors import invalid


class Progress:
    """The progress of an evaluation, printed each second on a terminal, otherwise at the end."""

    def __init__(self, out: TextIO | None, name: str, seeds: Sequence[int]) -> None:
        n_test = sum(seed < FIRST_TRAINING_SEED for seed in seeds)
        sort = {0: "", len(seeds): "test "}.get(n_test, f"({n_test} of them test) ")
        self._out, self._name = out, name
        self._title = f"{name}: {len(seeds)} {sort}{_plural('world', len(seeds))}"
        self._n_steps = self._n_done = 0
        self._begin = self._last = time.monotonic()

    def begin(self, n_steps: int) -> None:
        """Starts the clock; `n_steps`: number of steps of all worlds together."""
        self._n_steps, self._n_done = n_steps, 0
        self._begin = self._last = time.monotonic()

    def found(self, file: Path, *, n_kept: int, n_again: int, n_dropped: int) -> None:
        """Reports how many rows with this name in the file are reused, rerun or removed."""
        if n_kept:
            self._say(
                f"{n_kept} {_plural('row', n_kept)} kept in {file}, not run again. Data that the "
                "policy reads at run time, such as files, is not compared: if it has changed, "
                "choose another name"
            )
        if n_again + n_dropped:
            dropped = f", {n_dropped} removed" if n_dropped else ""
            self._say(
                f"{n_again} {_plural('row', n_again)} already in {file} run again{dropped}: from "
                "another policy or other settings"
            )

    def add(self, n_steps: int) -> None:
        self._n_done += n_steps
        now = time.monotonic()
        if self._out is not None and self._out.isatty() and now - self._last > 1.0:
            self._last = now
            left = (now - self._begin) * (self._n_steps / self._n_done - 1.0)
            share = 100 * self._n_done // self._n_steps
            print(f"\r{self._title}, {share} %, {left:.0f} s left ", end="", file=self._out)

    def end(self) -> None:
        if self._out is not None:
            start = "\r" if self._out.isatty() else ""
            seconds = time.monotonic() - self._begin
            print(f"{start}{self._title}, {seconds:.0f} s{' ' * 20}".rstrip(), file=self._out)

    def _say(self, words: str) -> None:
        if self._out is not None:
            print(f"{self._name}: {words}", file=self._out)


def summary(rows: Sequence[Row]) -> str:
    """Returns each policy's mean reward per step and its standard error, one line per policy.

    The standard error is over worlds, so it needs at least two worlds.

    Raises:
        InvalidArgumentError: If there are no rows.
    """
    if not rows:
        raise invalid("rows", "at least one", "none")
    groups: dict[tuple[str, str, int, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.policy, row.estimator, row.robots, row.team), []).append(row)
    return "\n".join(map(_line, groups.values()))


def _line(rows: Sequence[Row]) -> str:
    """Returns the summary of one policy."""
    rewards = np.array([row.mean_reward for row in rows])
    n_test = sum(row.world_seed < FIRST_TRAINING_SEED for row in rows)
    sort = "test " if n_test == len(rows) else "" if n_test == 0 else f"({n_test} test) "
    words = f"a step on {len(rows)} {sort}{_plural('world', len(rows))}"
    if len(rows) == 1:
        return f"{rows[0].policy}: {rewards[0]:.2f} {words}, too few for a standard error"
    error = rewards.std(ddof=1) / math.sqrt(len(rows))
    return f"{rows[0].policy}: {rewards.mean():.2f} +- {error:.2f} {words}"


def _plural(word: str, number: int) -> str:
    return word if number == 1 else f"{word}s"
