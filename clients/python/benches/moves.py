"""Measures moves per second of `WildfireMoves-v0`, and decisions of `WildfireObjective-v1`.

For comparison: Gymnasium's `SyncVectorEnv` around the single environments, and around an
environment with the same spaces that simulates nothing. Rounds alternate, so that noise on the
machine affects all environments alike. Prints median rates over the rounds, per second of wall time
and per second of this process's processor time.
"""

from __future__ import annotations

import argparse
import statistics
import time
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import SyncVectorEnv

MOVES = "emberwatch:emberwatch/WildfireMoves-v0"
OBJECTIVE = "emberwatch:emberwatch/WildfireObjective-v1"
NO_END = 2**31 - 1


class Trivial(gymnasium.Env[Any, Any]):
    """An environment with the same spaces that simulates nothing."""

    def __init__(self, like: gymnasium.Env[Any, Any]) -> None:
        self.observation_space, self.action_space = like.observation_space, like.action_space
        self._seen = np.zeros(like.observation_space.shape, np.uint8)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self._seen, {}

    def step(self, action: Any) -> Any:
        return self._seen, 0.0, False, False, {}


def main() -> None:
    """Measures moves, then decisions."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--moves", type=int, default=160, help="moves of each world per round")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--model", default="wildfire-small")
    args = parser.parse_args()
    world: dict[str, Any] = {"height": 16, "width": 16, "n_moves": 16, "burn_in": 3000}
    world |= {"model": args.model, "max_episode_steps": NO_END}
    actions = np.random.default_rng(0).integers(0, 4, (args.moves, args.worlds))
    race(moves(world, args.worlds), actions, args.rounds, "moves/s")
    n_agents = min(args.worlds, 16)
    race(decisions(world, n_agents), actions[:, :n_agents], args.rounds, "decisions/s")


def moves(world: dict[str, Any], n_worlds: int) -> dict[str, Any]:
    """Returns environments whose steps are moves."""
    world = {"observation": "local", **world}
    one = gymnasium.make(MOVES, **world).unwrapped
    single = [partial(gymnasium.make, MOVES, **world)] * n_worlds
    return {
        "native vector": gymnasium.make_vec(MOVES, n_worlds, **world),
        "native vector, reward='move'": gymnasium.make_vec(MOVES, n_worlds, reward="move", **world),
        "SyncVectorEnv": SyncVectorEnv(single),
        "SyncVectorEnv, simulates nothing": SyncVectorEnv([lambda: Trivial(one)] * n_worlds),
    }


def decisions(world: dict[str, Any], n_worlds: int) -> dict[str, Any]:
    """Returns environments whose steps are decisions."""
    world = {"prior": "initial", **world}
    single = [partial(gymnasium.make, OBJECTIVE, **world)] * n_worlds
    native = gymnasium.make_vec(OBJECTIVE, n_worlds, **world)
    return {f"native vector, {n_worlds} worlds": native, "SyncVectorEnv": SyncVectorEnv(single)}


def race(peers: dict[str, Any], actions: Any, rounds: int, unit: str) -> None:
    """Steps the environments in alternating rounds, prints their rates, and closes them."""
    rates: dict[str, list[tuple[float, float]]] = {name: [] for name in peers}
    for envs in peers.values():
        envs.reset(seed=1000)
    for _ in range(rounds):
        for name, envs in peers.items():
            wall, cpu = time.perf_counter(), time.process_time()
            for chosen in actions:
                envs.step(chosen)
            used = (time.perf_counter() - wall, time.process_time() - cpu)
            rates[name].append((actions.size / used[0], actions.size / used[1]))
    for name, envs in peers.items():
        wall, cpu = (statistics.median(rate) for rate in zip(*rates[name], strict=True))
        print(f"{name:34} {wall:9.0f} {unit}, {cpu:9.0f} per processor second")
        envs.close()


if __name__ == "__main__":
    main()
