"""Measures how fast `Wildfire-v0` steps, compared with other libraries in the same run.

For comparison: Gymnasium's `AsyncVectorEnv(shared_memory=True)` around an environment with the same
spaces that simulates nothing, and EnvPool's CartPole where it is installed (in process, 4 numbers
per step).
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import gymnasium
from race import NO_END, Trivial, race, server, spread


def cart_pole(n_envs: int) -> Any:
    """Makes EnvPool's CartPole."""
    import envpool

    return envpool.make_gymnasium("CartPole-v1", num_envs=n_envs, num_threads=2)


def wildfire(n_envs: int, **keywords: Any) -> Any:
    """Makes a single environment or a vector environment."""
    name, world = "emberwatch/Wildfire-v0", {"max_episode_steps": NO_END, "burn_in": 1000}
    if n_envs == 1:
        return gymnasium.make(name, **world, **keywords)
    return gymnasium.make_vec(name, num_envs=n_envs, **world, **keywords)


def workers(n_envs: int) -> Any:
    """Makes Gymnasium's worker processes around trivial environments."""
    one = wildfire(1)
    spaces = one.observation_space, one.action_space
    one.close()
    return gymnasium.vector.AsyncVectorEnv([partial(Trivial, *spaces)] * n_envs, shared_memory=True)


def start_up(n: int) -> None:
    """Prints the time from `gymnasium.make` to the end of the first step."""
    seconds: list[float] = []
    for seed in range(n):
        start = time.perf_counter()
        with contextlib.closing(gymnasium.make("emberwatch/Wildfire-v0")) as env:
            env.reset(seed=seed)
            env.step(env.action_space.sample())
            seconds.append(1e3 * (time.perf_counter() - start))
    print(f"from make to the first step, burn-in included: {spread(seconds)} ms")


def spin() -> None:
    """Runs forever without sleeping."""
    while True:
        pass


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
    parser.add_argument("--busy", type=int, nargs="+", help="single steps, next to N processes")
    args = parser.parse_args()
    if args.busy is None:
        start_up(5)
        with server("--worlds=64", "--burn-in=1000") as (instance, _):
            for n_envs, n_steps in ((1, 4000), (16, 800), (64, 200)):
                makers: dict[str, Any] = {
                    "emberwatch, in process": partial(wildfire, n_envs),
                    "emberwatch, at a server": partial(wildfire, n_envs, instance=instance),
                    "AsyncVectorEnv, simulates nothing": partial(workers, n_envs),
                }
                try:
                    cart_pole(n_envs).close()
                    makers["EnvPool's CartPole"] = partial(cart_pole, n_envs)
                except Exception as problem:
                    print(f"EnvPool skipped: {type(problem).__name__}: {problem}")
                race(makers, n_envs, n_steps, args.rounds)
    for n in args.busy or [3]:
        print(f"next to {n} busy processes:")
        with busy_processes(n):
            makers = {"emberwatch": partial(wildfire, 1), "AsyncVectorEnv": partial(workers, 1)}
            race(makers, 1, 1000, args.rounds)


if __name__ == "__main__":
    main()
