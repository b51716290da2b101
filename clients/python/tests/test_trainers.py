"""Stable-Baselines3 works with the environments unchanged."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import LIVELY, MOVES, OBJECTIVE, WILDFIRE, assert_same, make, no_warnings
from failures import refuses

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from emberwatch.sb3 import WildfireVecEnv, make_vec_env

#: The smallest images that its convolutional policies accept.
IMAGE = {"height": 36, "width": 40, "n_moves": 4, "burn_in": 10, "model": LIVELY}


@pytest.mark.parametrize(
    ("name", "keywords"),
    [
        (WILDFIRE, {"observation": "frame"}),
        (WILDFIRE, {"observation": ("frame", "robot", "age"), "truth": True}),
        (MOVES, {"observation": "move"}),
        (MOVES, {"observation": ("frame", "age", "visited", "robot", "move", "action_mask")}),
        (MOVES, {"observation": "recent", "window": 37, "reward": "move"}),
        (MOVES, {"observation": ("image", "belief", "local"), "window": 37}),
        (OBJECTIVE, {"prior": "uniform", "truth": True, "render_mode": "rgb_array"}),
        (WILDFIRE, {"render_mode": "rgb_array"}),
    ],
    ids=str,
)
def test_the_stable_baselines_checker_passes(name: str, keywords: dict[str, Any]) -> None:
    with no_warnings():
        env = make(name, **{**IMAGE, **keywords})
        for one in (env.unwrapped, env):
            check_env(one, skip_render_check="render_mode" not in keywords)


@pytest.mark.parametrize(
    ("name", "keywords"),
    [(MOVES, {"observation": ("frame", "local")}), (OBJECTIVE, {"prior": "initial"})],
)
def test_the_vector_environment_equals_single_ones(name: str, keywords: dict[str, Any]) -> None:
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
    """Converts an ordered dictionary of Stable-Baselines3 to a plain one."""
    return dict(observations) if isinstance(observations, dict) else observations


def test_unsuitable_vector_environments_are_refused() -> None:
    with refuses("env: expected an environment of emberwatch from"):
        WildfireVecEnv(gymnasium.make_vec(MOVES, num_envs=2, **IMAGE))
    vector = make_vec_env(MOVES, 2, **IMAGE)
    assert (
        vector.get_attr("burn_in") == [10, 10] and vector.env_is_wrapped(VecMonitor) == [False] * 2
    )
    for call in (lambda: vector.set_attr("burn_in", 3), lambda: vector.env_method("step")):
        with refuses("all worlds share one environment"):
            call()
    with refuses("set_options: expected no options, as resets"):
        vector.set_options([{}, {"resume": True}])
    vector.set_options([{}, {}])


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
    assert not np.array_equal(pictures[0], pictures[1])


def test_a_wrapped_vector_has_the_wrappers_spaces() -> None:
    envs = gymnasium.make_vec(MOVES, num_envs=2, autoreset_mode="SameStep", **IMAGE)
    wrapped = gymnasium.vector.VectorWrapper(envs)
    wrapped.single_observation_space = gymnasium.spaces.Box(0, 1, (5,))
    wrapped.single_action_space = gymnasium.spaces.Discrete(2)
    vector = WildfireVecEnv(wrapped)
    assert vector.observation_space == wrapped.single_observation_space
    assert vector.action_space == wrapped.single_action_space
