"""Action masks where trainers look for them: infos, observations, wrappers, vectors, teams."""

from pathlib import Path
from typing import Any

import land
import numpy as np
import pytest
from environments import MOVES, SMALL, closed_later, make, make_vec
from failures import fails, refuses

import emberwatch

#: The mask of a robot in row 0, below the grid's edge, with a no-fly cell to its right.
EXPECTED = [0, 1, 1, 0]


@pytest.fixture
def world(tmp_path: Path) -> dict[str, Any]:
    """Returns keywords of worlds with no-fly cells, where robots start at row 0, column 2."""
    path = tmp_path / "model.toml"
    path.write_text(land.model(no_fly=land.NO_FLY))
    return {**SMALL, "model": path, "start": "0,2", "n_moves": 6}


def is_mask(mask: Any, expected: Any = EXPECTED) -> bool:
    return mask.dtype == np.int8 and mask.tolist() == expected


def of(*cells: tuple[int, int]) -> list[list[int]]:
    """Returns the masks of robots in these cells, from a loop over no-fly cells."""
    return [[int(legal) for legal in land.legal_moves(cell, land.NO_FLY)] for cell in cells]


def test_infos_have_a_lone_robots_mask_for_sampling(world: dict[str, Any]) -> None:
    env = make(MOVES, **world)
    with fails("closed"):
        env.unwrapped.action_masks()
    _, info = env.reset(seed=1000)
    info["action_mask"][:] = 5  # the caller may write to it
    assert is_mask(env.step(0)[-1]["action_mask"]) and is_mask(env.unwrapped.action_masks())
    observation, info = env.reset(seed=1000)
    assert is_mask(info["action_mask"])
    for _ in range(20):
        mask = env.get_wrapper_attr("action_masks")()
        assert is_mask(mask, info["action_mask"].tolist())
        before = observation["robot"].tolist()
        observation, *_, info = env.step(env.action_space.sample(info["action_mask"]))
        assert observation["robot"].tolist() != before
        (expected,) = of(tuple(observation["robot"].tolist()))
        assert is_mask(info["action_mask"], expected)


def test_an_enclosed_robot_may_choose_any_move() -> None:
    alone = make(MOVES, height=1, width=1, burn_in=0)
    assert is_mask(alone.reset(seed=1000)[1]["action_mask"], [1, 1, 1, 1])


def test_vectors_have_a_mask_for_each_robot(world: dict[str, Any]) -> None:
    envs = make_vec(3, MOVES, observation=("robot", "action_mask"), **world)
    _, infos = envs.reset(seed=1000)
    assert is_mask(envs.unwrapped.action_masks(), [EXPECTED] * 3)
    assert is_mask(infos["action_mask"], [EXPECTED] * 3) and infos["_action_mask"].all()
    seen, *_, infos = envs.step(np.array([0, 1, 2]))
    expected = of((0, 2), (1, 2), (0, 1))
    assert is_mask(infos["action_mask"], expected) and is_mask(seen["action_mask"], expected)
    for _ in range(20):
        before = seen["robot"].tolist()
        actions = envs.action_space.sample(tuple(infos["action_mask"]))
        seen, *_, infos = envs.step(actions)
        assert all(map(list.__ne__, seen["robot"].tolist(), before))
    # Rows that a partial reset skips have no mask.
    envs = make_vec(2, MOVES, autoreset_mode="Disabled", **world)
    envs.reset(seed=1000)
    _, infos = envs.reset(options={"reset_mask": np.array([False, True])})
    assert is_mask(infos["action_mask"], [[0] * 4, EXPECTED])
    assert infos["_action_mask"].tolist() == [False, True]


@pytest.mark.parametrize("observation", ["local", ("local", "action_mask")])
def test_teams_have_masks_where_pettingzoo_looks(world: dict[str, Any], observation: Any) -> None:
    env = closed_later(emberwatch.parallel_env(observation=observation, **world))
    seen, infos = env.reset(seed=1000)
    for number, agent in enumerate(env.agents):
        env.action_space(agent).seed(number)
    for step in range(10):
        places = seen if observation != "local" else infos
        masks = {agent: places[agent]["action_mask"] for agent in env.agents}
        cells = env._worlds.seen(slice(0, 2))[1].tolist()
        for agent, expected in zip(env.agents, of(*map(tuple, cells)), strict=True):
            assert is_mask(masks[agent], EXPECTED if step == 0 else expected)
            assert env.observation_space(agent).contains(seen[agent])
        actions = {agent: env.action_space(agent).sample(masks[agent]) for agent in env.agents}
        seen, *_, infos = env.step(actions)
        assert all(map(list.__ne__, env._worlds.seen(slice(0, 2))[1].tolist(), cells))


def test_paths_have_no_mask(world: dict[str, Any]) -> None:
    env = make(**world)
    assert not hasattr(env.unwrapped, "action_masks")
    assert "action_mask" not in env.reset(seed=1000)[1]
    with refuses("observation: expected one or several of"):
        make(observation=("frame", "action_mask"), **world)


@pytest.mark.parametrize("kind", ["single", "dummy", "native"])
def test_maskable_ppo_chooses_only_valid_moves(world: dict[str, Any], kind: str) -> None:
    contrib = pytest.importorskip("sb3_contrib")
    from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
    from stable_baselines3.common.env_util import make_vec_env as dummies

    from emberwatch.sb3 import make_vec_env

    keywords = {**world, "observation": "robot"}
    makers: dict[str, Any] = {
        "single": lambda: make(MOVES, **keywords),
        "dummy": lambda: dummies(MOVES, 2, env_kwargs=keywords, seed=1000),
        "native": lambda: make_vec_env(MOVES, 2, **keywords),
    }
    env = closed_later(makers[kind]())
    assert is_masking_supported(env)
    agent = contrib.MaskablePPO("MlpPolicy", env, n_steps=8, batch_size=4, device="cpu")
    agent.learn(32)
    seen = env.reset() if kind != "single" else env.reset(seed=1000)[0]
    for _ in range(20):
        masks = get_action_masks(env)
        assert masks.dtype == np.int8
        actions, _ = agent.predict(seen, action_masks=masks, deterministic=False)
        assert all(masks.reshape(-1, 4)[range(actions.size), actions.reshape(-1)])
        seen = env.step(actions if kind != "single" else int(actions))[0]


@pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested using")
def test_torchrl_masks_the_actions_of_a_team(world: dict[str, Any]) -> None:
    pytest.importorskip("torchrl")
    from torchrl.envs import PettingZooWrapper

    team = closed_later(emberwatch.parallel_env(observation="local", **world))
    env = PettingZooWrapper(team, categorical_actions=True)
    seen = env.reset()
    assert seen["robot", "action_mask"].int().tolist() == [EXPECTED] * 2
    for _ in range(10):
        mask = seen["robot", "action_mask"]
        chosen = env.rand_action(seen)["robot", "action"]
        assert mask.gather(-1, chosen.unsqueeze(-1)).all()
        seen = env.step(seen)["next"]
