"""Rounds of several environments, which alternate, so that noise affects all of them alike."""

from __future__ import annotations

import contextlib
import os
import statistics
import subprocess
import time
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np

import emberwatch

NO_END = 2**31 - 1


class Trivial(gymnasium.Env[Any, Any]):
    """An environment with the spaces of another one that simulates nothing."""

    def __init__(self, observation_space: Any, action_space: Any) -> None:
        self.observation_space, self.action_space = observation_space, action_space
        self._seen = observation_space.sample()

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self._seen, {}

    def step(self, action: Any) -> Any:
        return self._seen, 0.0, False, False, {}


def race(makers: dict[str, Callable[[], Any]], n_envs: int, n_steps: int, rounds: int) -> None:
    """Steps environments in alternating rounds. Prints the medians over rounds of p50 and p99."""
    peers = {name: maker() for name, maker in makers.items()}
    found: dict[str, list[tuple[float, float, float]]] = {name: [] for name in peers}
    actions: dict[str, list[Any]] = {}
    for name, envs in peers.items():
        envs.reset()
        actions[name] = [envs.action_space.sample() for _ in range(64)]
    for turn in range(rounds + 1):
        for name, envs in peers.items():
            micros: list[float] = []
            for step in range(n_steps if turn > 0 else n_steps // 10):
                start = time.perf_counter()
                envs.step(actions[name][step % 64])
                micros.append((time.perf_counter() - start) * 1e6)
            if turn > 0:  # the first round warms up
                p50, p99 = np.percentile(micros, (50, 99))
                found[name].append((p50, p99, n_envs * 1e6 / statistics.fmean(micros)))
    for name, envs in peers.items():
        p50, p99, rates = (spread(it) for it in zip(*found[name], strict=True))
        print(f"{n_envs:3} {name:36} p50 {p50}  p99 {p99} us  {rates} steps/s", flush=True)
        envs.close()


def spread(values: Any) -> str:
    """Returns the median with the minimum and the maximum."""
    return f"{statistics.median(values):8,.1f} ({min(values):,.1f} to {max(values):,.1f})"


@contextlib.contextmanager
def server(*flags: str) -> Iterator[tuple[str, int]]:
    """Starts a server. Yields its instance name and its process ID, and ends it."""
    instance = f"bench-{os.getpid()}-{time.monotonic_ns()}"
    program = subprocess.Popen(["emberwatch-server", f"--instance={instance}", *flags])
    emberwatch.connect(instance, wait=20).close()
    try:
        yield instance, program.pid
    finally:
        program.kill()
        program.wait()
