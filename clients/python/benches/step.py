"""Measures how fast the environments step, compared with other libraries in the same run.

Rounds of all rows alternate, so that noise on the machine affects all rows alike. For comparison:
Gymnasium's `AsyncVectorEnv(shared_memory=True)` around an environment with the same spaces that
simulates nothing, and EnvPool's CartPole where it is installed (in process, 4 numbers per step).
Prints the medians of p50 and p99 over rounds, with their minima and maxima.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
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
    """An environment with the spaces of `Wildfire-v0` that simulates nothing."""

    def __init__(self) -> None:
        frame = gymnasium.spaces.Box(0, 255, (64, 64, 1), np.uint8)
        robot = gymnasium.spaces.MultiDiscrete([64, 64])
        self.observation_space = gymnasium.spaces.Dict({"frame": frame, "robot": robot})
        self.action_space = gymnasium.spaces.MultiDiscrete([4] * 64)
        self._seen = {"frame": np.full((64, 64, 1), 255, np.uint8), "robot": np.zeros(2, np.int64)}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self._seen, {}

    def step(self, action: Any) -> Any:
        return self._seen, 0.0, False, False, {}


class Row:
    """One environment, stepped in rounds."""

    def __init__(self, name: str, envs: Any, actions: Any, n_envs: int) -> None:
        self.name, self.envs, self.actions, self.n_envs = name, envs, actions, n_envs
        self.rounds: list[tuple[float, float, float]] = []

    def go(self, n_steps: int) -> None:
        """Runs one round: records p50, p99 and mean of a step, in microseconds."""
        micros: list[float] = []
        for _ in range(n_steps):
            start = time.perf_counter()
            self.envs.step(self.actions)
            micros.append((time.perf_counter() - start) * 1e6)
        p50, p99 = np.percentile(micros, (50, 99))
        self.rounds.append((float(p50), float(p99), statistics.fmean(micros)))

    def report(self) -> None:
        """Prints the medians over rounds."""
        p50s, p99s, means = zip(*self.rounds, strict=True)
        rates = [self.n_envs * 1e6 / mean for mean in means]
        print(
            f"{self.name:42} p50 {_spread(p50s)}  p99 {_spread(p99s)} us  "
            f"{statistics.median(rates):9,.0f} ({min(rates):,.0f} to {max(rates):,.0f}) steps/s",
            flush=True,
        )


def _spread(values: Any) -> str:
    return f"{statistics.median(values):8.1f} ({min(values):.1f} to {max(values):.1f})"


def emberwatch_row(n_envs: int, instance: str | None = None) -> Row:
    """Returns the row of Wildfire-v0: a single environment, or the vector environment."""
    world: dict[str, Any] = {"max_episode_steps": NO_END, "burn_in": 1000, "instance": instance}
    envs: Any = (
        gymnasium.make("emberwatch/Wildfire-v0", **world)
        if n_envs == 1
        else gymnasium.make_vec("emberwatch/Wildfire-v0", num_envs=n_envs, **world)
    )
    envs.reset(seed=0)
    place = "in process" if instance is None else "at a server"
    name = f"emberwatch, {place}, worlds: {n_envs}"
    return Row(name, envs, envs.action_space.sample(), n_envs)


@contextlib.contextmanager
def server_row() -> Iterator[Callable[[int], Row]]:
    """Starts a server. Yields a function that makes the row of Wildfire-v0 on this server."""
    instance = f"step-{os.getpid()}"
    flags = [f"--instance={instance}", "--worlds=64", "--burn-in=1000"]
    server = subprocess.Popen(["emberwatch-server", *flags])
    emberwatch.connect(instance, wait=20).close()
    yield lambda n_envs: emberwatch_row(n_envs, instance)
    server.terminate()
    server.wait()


def async_row(n_envs: int) -> Row:
    """Returns the row of Gymnasium's worker processes around trivial environments."""
    envs = gymnasium.vector.AsyncVectorEnv([Trivial] * n_envs, shared_memory=True)
    envs.reset(seed=0)
    return Row(f"AsyncVectorEnv, {n_envs} trivial", envs, envs.action_space.sample(), n_envs)


def envpool_row(n_envs: int) -> Row | None:
    """Returns the row of EnvPool's CartPole; `None` if it is not installed or does not run."""
    try:
        import envpool

        envs = envpool.make_gymnasium("CartPole-v1", num_envs=n_envs, num_threads=2)
        envs.reset()
    except Exception as problem:
        print(f"EnvPool skipped: {type(problem).__name__}: {problem}")
        return None
    return Row(f"EnvPool CartPole, {n_envs}", envs, np.zeros(n_envs, np.int32), n_envs)


def race(makers: list[Callable[[int], Row | None]], n_envs: int, n_steps: int, rounds: int) -> None:
    """Runs rows with the same number of environments in alternating rounds."""
    rows = [row for row in (maker(n_envs) for maker in makers) if row is not None]
    for row in rows:
        row.go(n_steps // 10)
        row.rounds.clear()
    for _ in range(rounds):
        for row in rows:
            row.go(n_steps)
    for row in rows:
        row.report()
        row.envs.close()


def spin() -> None:
    """Runs forever without sleeping."""
    while True:
        pass


def start_up(n: int) -> None:
    """Prints the time from `gymnasium.make` to the end of the first step."""
    seconds: list[float] = []
    for seed in range(n):
        start = time.perf_counter()
        env = gymnasium.make("emberwatch/Wildfire-v0")
        env.reset(seed=seed)
        env.step(env.action_space.sample())
        seconds.append(time.perf_counter() - start)
        env.close()
    print(
        f"from make to the first step, burn-in included: {statistics.median(seconds):.3f} s "
        f"({min(seconds):.3f} to {max(seconds):.3f})"
    )


@contextlib.contextmanager
def busy_processes(n: int) -> Iterator[None]:
    """Runs `n` processes that never sleep."""
    context = multiprocessing.get_context("spawn")
    busy = [context.Process(target=spin, daemon=True) for _ in range(n)]
    for process in busy:
        process.start()
    time.sleep(1)
    try:
        yield
    finally:
        for process in busy:
            process.kill()


def main() -> None:
    """Prints all rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--busy",
        type=int,
        nargs="+",
        metavar="N",
        help="only single steps, next to N busy processes",
    )
    args = parser.parse_args()
    if args.busy is None:
        start_up(5)
        with server_row() as at_server:
            for n_envs, n_steps in ((1, 4000), (16, 800), (64, 200)):
                race(
                    [emberwatch_row, at_server, async_row, envpool_row],
                    n_envs,
                    n_steps,
                    args.rounds,
                )
    for n in args.busy or [3]:
        print(f"next to {n} busy processes:")
        with busy_processes(n):
            race([emberwatch_row, async_row], 1, 1000, args.rounds)


if __name__ == "__main__":
    main()
