"""Recorded episodes of `WildfireObjective-v1`, which were planned by a separate process.

`data/options.npz` contains the episodes, and the checkpoints of the learned beliefs: a filter
and a network, trained for 80 steps in these worlds. The network's weights are rounded to 16 bits.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FILE = Path(__file__).with_name("data") / "options.npz"

#: Settings of all worlds.
WORLD: dict[str, Any] = {
    "model": "wildfire-small",
    "height": 16,
    "width": 16,
    "n_moves": 16,
    "burn_in": 100,
}

#: The estimator of each belief, and its prior.
BELIEFS: dict[str, dict[str, Any]] = {
    "known": {"estimator": "known"},
    "known, initial": {"estimator": "known", "prior": "initial"},
    "known+spatial": {"estimator": "known+spatial"},
    "known+spatial, initial": {"estimator": "known+spatial", "prior": "initial"},
    "learned": {"checkpoint": "learned_filter"},
    "learned+spatial": {
        "checkpoint": "learned_filter",
        "estimator": "learned+spatial",
    },
    "neural": {"checkpoint": "neural_belief"},
}

N_STEPS = 12
N_WORLDS = 3


def episode(env: Any) -> dict[str, NDArray[Any]]:
    """Returns what one environment shows over a reset and some steps."""
    choices = np.random.default_rng(46).integers(0, 8, N_STEPS)
    observation, info = env.reset(seed=1000)
    seen, told = [observation], [[info["step"], info["n_visited"], 0]]
    for choice in choices:
        observation, reward, _, _, info = env.step(choice)
        seen.append(observation)
        told.append([info["step"], info["n_visited"], reward])
    return {"features": np.stack(seen), "told": np.array(told, np.float64)}


def episodes(envs: Any) -> dict[str, NDArray[Any]]:
    """Returns what a vector environment shows in mode `DISABLED`, with resets of some worlds.

    Episodes last four steps.
    """
    choices = np.random.default_rng(47).integers(0, 8, (N_STEPS, N_WORLDS))
    observations, infos = envs.reset(seed=[7, 1000, 12])
    seen, told = [observations], [[infos["step"], infos["n_visited"], np.zeros(N_WORLDS)]]

    def restart(mask: NDArray[np.bool_], seed: int) -> None:
        observations, infos = envs.reset(seed=seed, options={"reset_mask": mask})
        seen.append(observations)
        told.append([infos["step"], infos["n_visited"], np.zeros(N_WORLDS)])

    for step, chosen in enumerate(choices):
        observations, rewards, _, over, infos = envs.step(chosen)
        seen.append(observations)
        told.append([infos["step"], infos["n_visited"], rewards])
        if step == 1:
            restart(np.array([False, True, False]), 50)
        if over.any():
            restart(over, 60 + step)
    return {"features": np.stack(seen), "told": np.array(told, np.float64)}
