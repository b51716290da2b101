"""Stable-Baselines3 takes the environments as they are."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import LIVELY, MOVES, OBJECTIVE, WILDFIRE, assert_same, make, no_warnings
from failures import refuses

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecTransposeImage

from emberwatch.benchmark import evaluate
from emberwatch.sb3 import WildfireVecEnv, make_vec_env

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
        (MOVES, {"observation": ("move", "action_mask")}),
        (MOVES, {"reward": "move"}),
        (MOVES, {"observation": "local", "window": 37}),
        (MOVES, {"observation": "recent", "window": 37}),
        (MOVES, {"observation": ("image", "belief", "local"), "window": 37}),
        (OBJECTIVE, {"prior": "initial"}),
        (OBJECTIVE, {"prior": "uniform", "truth": True}),
    ],
    ids=str,
)
def test_stable_baselines_finds_no_fault(name: str, keywords: dict[str, Any]) -> None:
    with no_warnings():
        env = make(name, **{**IMAGE, **keywords})
        check_env(env.unwrapped, skip_render_check=True)
        check_env(env, skip_render_check=True)


@pytest.mark.parametrize("name", [WILDFIRE, MOVES, OBJECTIVE])
def test_stable_baselines_finds_pictures(name: str) -> None:
    keywords = {"prior": "initial"} if name == OBJECTIVE else {}
    with no_warnings():
        env = make(name, **IMAGE, **keywords, render_mode="rgb_array")
        check_env(env)


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


@pytest.mark.parametrize(
    ("name", "keywords"),
    [(MOVES, {"observation": ("frame", "local")}), (OBJECTIVE, {"prior": "initial"})],
)
def test_the_vector_environment_is_that_of_single_ones(name: str, keywords: dict[str, Any]) -> None:
    keywords = {**IMAGE, "max_episode_steps": 6, **keywords}
    ours = make_vec_env(name, 3, **keywords)
    theirs = DummyVecEnv([lambda: make(name, **keywords) for _ in range(3)])
    for vector in (ours, theirs):
        vector.seed(5)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert_same(plain(ours.reset()), plain(theirs.reset()))
    n_ends = 0
    for _ in range(20):
        moves = np.array([ours.action_space.sample() for _ in range(3)])
        (seen, *left), (expected, *right) = ours.step(moves), theirs.step(moves)
        assert_same(plain(seen), plain(expected))
        assert_same(left[:2], [right[0], right[1]])
        for world in np.flatnonzero(right[1]):
            assert_same(left[2][world], right[2][world])
            n_ends += 1
    assert n_ends == 9


def plain(observations: Any) -> Any:
    """Without its ordered dictionaries."""
    return dict(observations) if isinstance(observations, dict) else observations


def test_a_model_learns_on_the_vector_and_is_evaluated() -> None:
    import stable_baselines3

    world = {**IMAGE, "observation": "local"}
    vector = VecMonitor(make_vec_env(MOVES, 4, max_episode_steps=8, reward="move", **world))
    agent = stable_baselines3.PPO("MlpPolicy", vector, n_steps=8, batch_size=16, device="cpu")
    agent.learn(64)
    assert len(agent.ep_info_buffer) == 8
    vector.close()
    rows = evaluate(agent, name="ppo", seeds=[1000], steps=3, progress=None, **world)
    assert rows[0].moves == 4 and rows[0].mean_distinct_cells > 0


def test_robots_of_a_world_share_a_policy() -> None:
    import stable_baselines3

    world = {**IMAGE, "observation": "local", "robots": 3, "reward": "marginal"}
    vector = VecMonitor(make_vec_env(MOVES, 6, max_episode_steps=8, **world))
    agent = stable_baselines3.PPO("MlpPolicy", vector, n_steps=8, batch_size=16, device="cpu")
    agent.learn(96)
    assert len(agent.ep_info_buffer) == 12
    vector.close()
    del world["reward"]
    (row,) = evaluate(agent, name="team", seeds=[1000], steps=3, progress=None, **world)
    assert (row.robots, row.team) == (3, "alone") and row.mean_distinct_cells > 0


def test_what_is_no_vector_for_it_is_named() -> None:
    with refuses("env: expected gymnasium.make_vec of an env"):
        WildfireVecEnv(gymnasium.make_vec(MOVES, num_envs=2, **IMAGE))
    vector = make_vec_env(MOVES, 2, **IMAGE)
    assert vector.get_attr("n_moves") == [4, 4] and vector.env_is_wrapped(VecMonitor) == [False] * 2
    for call in (lambda: vector.set_attr("n_moves", 3), lambda: vector.env_method("step")):
        with refuses("the worlds share one environment"):
            call()
    for options in ({"resume": True}, [{}, {"resume": True}]):
        with refuses("set_options: expected none, got"):
            vector.set_options(options)
    for options in (None, {}, [{}, {}]):
        vector.set_options(options)


def test_the_vector_environment_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with no_warnings():
        vector = make_vec_env(MOVES, 2, **IMAGE, render_mode="human")
        vector.reset()
        assert vector.render() is None
        vector.close()
    vector = make_vec_env(MOVES, 2, **IMAGE, render_mode="rgb_array")
    vector.reset()
    vector.step(np.array([0, 3]))
    pictures = vector.get_images()
    assert_same(vector.env_method("render"), pictures)
    assert_same(vector.env_method("render", indices=1), pictures[1:])
    assert not np.array_equal(pictures[0], pictures[1])


def test_a_wrapped_vector_has_the_wrappers_spaces() -> None:
    envs = gymnasium.make_vec(MOVES, num_envs=2, autoreset_mode="SameStep", **IMAGE)
    wrapped = gymnasium.vector.VectorWrapper(envs)
    wrapped.single_observation_space = gymnasium.spaces.Box(0, 1, (5,))
    wrapped.single_action_space = gymnasium.spaces.Discrete(2)
    vector = WildfireVecEnv(wrapped)
    assert vector.observation_space == wrapped.single_observation_space
    assert vector.action_space == wrapped.single_action_space


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
