"""Recorded worlds through Gymnasium: the hidden states are the recorded states."""

import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import MOVES, RECORDED, WILDFIRE, serving
from failures import refuses
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

import emberwatch

States = NDArray[np.uint8]

#: Settings that a states file sets.
OF_STATES = dict.fromkeys(("height", "width", "burn_in", "model"))


@pytest.fixture
def sequences() -> list[States]:
    random = np.random.default_rng(5)
    first, second = (random.integers(0, 3, (length, 4, 4), np.uint8) for length in (5, 7))
    first[0] = 0  # Nothing burns yet.
    return [first, second]


@pytest.fixture
def states(tmp_path: Path, sequences: list[States]) -> Path:
    path = tmp_path / "lab.npz"
    np.savez_compressed(path, states_000=sequences[0], states_001=sequences[1])
    path.with_suffix(".toml").write_bytes(RECORDED.read_bytes())
    return path


def test_a_running_server_describes_its_recorded_world(states: Path) -> None:
    with serving(states=states, **OF_STATES) as instance:
        with emberwatch.connect(instance) as client:
            recorded = client.info.recorded_world
            assert recorded is not None
            assert (recorded.n_sequences, recorded.n_steps) == (2, 4)
            assert recorded.description is not None
            assert "10 min" in recorded.description
        for setting in ({"states": states}, {"states_offset": 1}, {"states_symmetries": True}):
            with refuses("the running server determines it"):
                gymnasium.make(WILDFIRE, instance=instance, **setting)
        env: Any = gymnasium.make(WILDFIRE, instance=instance)
        with warnings.catch_warnings(action="error"):
            observation, _ = env.reset(seed=0)  # No cell burns yet in the recording.
        assert env.unwrapped.model is None
        assert observation["frame"].shape[:2] == (4, 4)
    with serving() as simulated, emberwatch.connect(simulated) as client:
        assert client.info.recorded_world is None


def test_pictures_have_the_colours_of_the_description(states: Path) -> None:
    with serving(states=states, publish_truth=True, **OF_STATES) as instance:
        keywords: list[dict[str, Any]] = [{"states": states}, {"instance": instance}]
        for world in keywords:
            env: Any = gymnasium.make(WILDFIRE, truth=True, render_mode="rgb_array", **world)
            _, info = env.reset(seed=1)
            colors = np.array([[0, 0, 0], [255, 0, 0], [0x77, 0x77, 0x77]], np.uint8)
            truth = colors[info["truth"]].repeat(128, axis=0).repeat(128, axis=1)
            shown = env.render()[:512, -512:]
            corners = (slice(4, None, 128), slice(4, None, 128))  # away from the robot
            np.testing.assert_array_equal(shown[corners], truth[corners], str(world))
            env.close()


def test_move_rewards_come_from_the_description(states: Path) -> None:
    env: Any = gymnasium.make(MOVES, states=states, n_moves=3, reward="move")
    paths: Any = gymnasium.make(WILDFIRE, states=states, n_moves=3)
    path = [3, 1, 2]
    for one in (env, paths):
        check_env(one.unwrapped, skip_render_check=True)
    for seed in range(4):
        env.reset(seed=seed)
        paths.reset(seed=seed)
        expected = float(paths.step(np.array(path))[1])
        assert sum(float(env.step(move)[1]) for move in path) == expected


def test_recorded_worlds_have_no_model_for_a_belief(states: Path) -> None:
    with refuses("expected simulated worlds, as recorded ones have no model"):
        gymnasium.make(WILDFIRE, states=states, observation="belief")
