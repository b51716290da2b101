"""TorchRL works with the environments unchanged."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import MOVES, OBJECTIVE, SMALL, WILDFIRE

pytest.importorskip("torchrl")

import torch
from torchrl.envs import GymEnv, GymWrapper
from torchrl.envs.utils import check_env_specs


@pytest.mark.parametrize(
    ("name", "keywords"),
    [
        (WILDFIRE, {}),
        (WILDFIRE, {"observation": "frame"}),
        (MOVES, {"observation": ("local", "robot", "move"), "reward": "move"}),
        (OBJECTIVE, {"prior": "initial"}),
    ],
    ids=str,
)
def test_torchrls_environment_checker_passes(name: str, keywords: dict[str, Any]) -> None:
    env = GymEnv(name, **SMALL, **keywords)
    check_env_specs(env, seed=1)
    assert env.rollout(5)["next", "reward"].shape == (5, 1)


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_torchrls_wrapper_returns_the_vectors_steps(mode: str) -> None:
    def vector() -> gymnasium.vector.VectorEnv:
        keywords = {"observation": "local", "reward": "move", "max_episode_steps": 6}
        return gymnasium.make_vec(MOVES, 3, autoreset_mode=mode, **SMALL, **keywords)

    wrapped, plain = GymWrapper(vector()), vector()
    check_env_specs(wrapped)
    seen, first = wrapped.reset(seed=5), plain.reset(seed=5)[0]
    np.testing.assert_array_equal(seen["observation"].numpy(), first)
    for step in range(6):
        moves = plain.action_space.sample()
        # TorchRL's categorical actions are one-hot by default.
        seen["action"] = torch.nn.functional.one_hot(torch.from_numpy(moves), 4)
        seen = wrapped.step(seen)["next"]
        observations, rewards, _, truncated, infos = plain.step(moves)
        last = infos["final_obs"] if mode == "SameStep" and truncated.all() else observations
        np.testing.assert_array_equal(seen["observation"].numpy(), np.stack(list(last)))
        np.testing.assert_allclose(seen["reward"][:, 0].numpy(), rewards)
        assert truncated.all() == (step == 5)
        np.testing.assert_array_equal(seen["truncated"][:, 0].numpy(), truncated)
