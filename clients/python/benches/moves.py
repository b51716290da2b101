"""Measures the steps of vector environments: moves of `WildfireMoves-v0`, and decisions.

For comparison: Gymnasium's `SyncVectorEnv` around the single environments, and around an
environment with the same spaces that simulates nothing.
"""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

import gymnasium
from gymnasium.vector import SyncVectorEnv
from race import NO_END, Trivial, race

MOVES = "emberwatch:emberwatch/WildfireMoves-v0"
OBJECTIVE = "emberwatch:emberwatch/WildfireObjective-v1"


def main() -> None:
    """Measures moves, then decisions."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--steps", type=int, default=160, help="steps of each world per round")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--model", default="wildfire-small")
    args = parser.parse_args()
    world: dict[str, Any] = {"height": 16, "width": 16, "n_moves": 16, "burn_in": 3000}
    world |= {"model": args.model, "max_episode_steps": NO_END}
    local, n = world | {"observation": "local"}, args.worlds
    one = gymnasium.make(MOVES, **local)
    trivial = partial(Trivial, one.observation_space, one.action_space)
    makers = {
        "moves": partial(gymnasium.make_vec, MOVES, n, **local),
        "moves, reward='move'": partial(gymnasium.make_vec, MOVES, n, reward="move", **local),
        "SyncVectorEnv": lambda: SyncVectorEnv([partial(gymnasium.make, MOVES, **local)] * n),
        "SyncVectorEnv, simulates nothing": lambda: SyncVectorEnv([trivial] * n),
    }
    race(makers, n, args.steps, args.rounds)
    world, n = world | {"prior": "initial"}, min(n, 16)
    makers = {
        "decisions": partial(gymnasium.make_vec, OBJECTIVE, n, **world),
        "SyncVectorEnv": lambda: SyncVectorEnv([partial(gymnasium.make, OBJECTIVE, **world)] * n),
    }
    race(makers, n, args.steps, args.rounds)


if __name__ == "__main__":
    main()
