"""Stable-Baselines3 takes the environments as they are."""

from typing import Any

import numpy as np
import pytest
from environments import LIVELY, MOVES, OBJECTIVE, WILDFIRE, make, no_warnings

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecTransposeImage

#: The smallest images that its convolutional policies take.
IMAGE = {"height": 36, "width": 40, "n_moves": 4, "burn_in": 10, "model": LIVELY}


@pytest.mark.parametrize(
    ("name", "keywords"),
    [
        (WILDFIRE, {}),
        (WILDFIRE, {"observation": "frame"}),
        (WILDFIRE, {"observation": "robot"}),
        (WILDFIRE, {"observation": ("frame", "robot", "age")}),
        (WILDFIRE, {"truth": True}),
        (MOVES, {}),
        (MOVES, {"observation": "visited"}),
        (MOVES, {"observation": "move"}),
        (MOVES, {"observation": ("frame", "age", "visited", "robot", "move")}),
        (MOVES, {"reward": "move"}),
        (OBJECTIVE, {"prior": "initial"}),
        (OBJECTIVE, {"prior": "uniform", "planner": "shooting", "truth": True}),
    ],
    ids=str,
)
def test_stable_baselines_finds_no_fault(name: str, keywords: dict[str, Any]) -> None:
    with no_warnings():
        env = make(name, **{**IMAGE, **keywords})
        check_env(env.unwrapped, skip_render_check=True)
        check_env(env, skip_render_check=True)
        env.close()


@pytest.mark.parametrize("name", [WILDFIRE, MOVES, OBJECTIVE])
def test_stable_baselines_finds_pictures(name: str) -> None:
    keywords = {"prior": "initial"} if name == OBJECTIVE else {}
    with no_warnings():
        env = make(name, **IMAGE, **keywords, render_mode="rgb_array")
        check_env(env)
        env.close()


@pytest.mark.parametrize("name", [WILDFIRE, MOVES])
def test_its_vector_environments_carry_frames_and_ends(name: str) -> None:
    vector = VecTransposeImage(DummyVecEnv([lambda: make(name, **IMAGE, max_episode_steps=3)] * 2))
    observations = vector.reset()
    assert observations["frame"].shape == (2, 1, 36, 40)
    for step in range(1, 7):
        moves = np.array([vector.action_space.sample() for _ in range(2)])
        observations, _, ended, infos = vector.step(moves)
        assert ended.tolist() == [step % 3 == 0] * 2
        if ended[0]:
            assert infos[0]["TimeLimit.truncated"] and "terminal_observation" in infos[0]
    vector.close()


@pytest.mark.parametrize(
    ("name", "algorithm"), [(WILDFIRE, "PPO"), (MOVES, "DQN"), (OBJECTIVE, "DQN")]
)
def test_it_learns_a_few_steps(name: str, algorithm: str) -> None:
    import stable_baselines3

    env = make(name, **{**IMAGE, "height": 36, "width": 36}, max_episode_steps=5)
    keywords: dict[str, Any] = {"PPO": {"n_steps": 8, "batch_size": 4, "n_epochs": 1}}.get(
        algorithm, {"learning_starts": 4, "buffer_size": 32, "batch_size": 4}
    )
    kind = getattr(stable_baselines3, algorithm)
    policy = "MlpPolicy" if name == OBJECTIVE else "MultiInputPolicy"
    agent = kind(policy, env, device="cpu", seed=1, **keywords)
    agent.learn(16)
    assert agent.num_timesteps >= 16
    agent.get_env().close()
