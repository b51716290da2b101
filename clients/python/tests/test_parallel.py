"""All robots of a world through PettingZoo, and each robot in its own environment."""

import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from environments import (
    OBJECTIVE,
    SMALL,
    assert_same,
    impatient,
    make,
    make_vec,
    no_warnings,
    serving,
)
from failures import refuses
from pettingzoo.utils.conversions import parallel_to_aec
from processes import at_once, eventually

import emberwatch
from emberwatch.envs.parallel import WildfireParallelEnv

with warnings.catch_warnings(action="ignore"):  # PettingZoo's games warn on import
    from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test

AGENTS = [f"robot_{robot}" for robot in range(4)]


def team(**keywords: Any) -> WildfireParallelEnv:
    if keywords.get("instance") is not None:
        return emberwatch.parallel_env(**keywords)
    return emberwatch.parallel_env(**{**SMALL, "robots": 4, **keywords})


@pytest.mark.parametrize(("robots", "observation"), [(2, "local"), (3, "others")])
def test_pettingzoos_test_passes(robots: int, observation: str) -> None:
    with no_warnings():
        parallel_api_test(team(robots=robots, observation=observation), num_cycles=100)
        env = parallel_to_aec(team(robots=robots, observation=observation, max_episode_steps=9))
        api_test(env, num_cycles=50)


def test_pettingzoos_test_passes_with_paths() -> None:
    with no_warnings():
        parallel_api_test(team(action="path", max_episode_steps=20), num_cycles=50)
        for action in ("move", "path"):
            parallel_seed_test(lambda action=action: team(action=action), num_cycles=20)
    env = parallel_to_aec(team(action="path", max_episode_steps=20))
    with pytest.warns(UserWarning) as warned:
        api_test(env, num_cycles=20)
    # The test supports neither Dict observations nor MultiDiscrete actions.
    about = {str(warning.message).partition(" of ")[0] for warning in warned}
    assert all("bservation" in text or "ction" in text for text in about), about


def test_a_missing_pettingzoo_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    monkeypatch.delitem(sys.modules, "emberwatch.envs.parallel")
    told = r"pip install emberwatch\[teams\]; got: .*pettingzoo"
    with pytest.raises(ModuleNotFoundError, match=told):
        emberwatch.parallel_env(robots=4)


def rollout(env: WildfireParallelEnv, actions: list[dict[str, Any]], seed: int) -> list[Any]:
    return [env.reset(seed=seed), *map(env.step, actions)]


def random_actions(n_steps: int, n_robots: int, shape: tuple[int, ...] = ()) -> list[Any]:
    generator = np.random.default_rng(7)
    return [
        {f"robot_{robot}": generator.integers(0, 4, shape) for robot in range(n_robots)}
        for _ in range(n_steps)
    ]


PARTS = ("frame", "robot", "age", "belief", "team", "others")


def flight(env: WildfireParallelEnv, **of_reset: Any) -> tuple[int, int]:
    """Returns the number of steps and the world's step at the end of an episode."""
    n_steps, info = 0, env.reset(**of_reset)[1]
    while env.agents:
        action = np.full(env.action_space("robot_0").shape, n_steps % 4)
        *_, info = env.step(dict.fromkeys(env.agents, action))
        n_steps += 1
    return n_steps, info["robot_0"]["step"]


def test_episodes_end_with_the_paths_of_the_task_or_where_the_user_says(tmp_path: Path) -> None:
    task = (Path(__file__).parents[3] / "config/tasks/team.toml").read_text("utf-8")
    task = task.replace('"team"', '"own"').replace("burn_in = 3000", "burn_in = 3")
    assert "max_steps = 300\n" in task
    for n_paths, lengths in ((3, (48, 3)), (70, (1120, 70))):
        file = tmp_path / f"{n_paths}.toml"
        file.write_text(task.replace("max_steps = 300\n", f"max_steps = {n_paths}\n"), "utf-8")
        assert flight(emberwatch.parallel_env(task=file), seed=1000) == lengths
        assert flight(emberwatch.parallel_env(task=file, action="path"), seed=1000)[0] == n_paths
        given = emberwatch.parallel_env(task=file, max_episode_steps=17)
        assert flight(given, seed=1000) == (17, 1)
    assert flight(team(robots=1, n_moves=3), seed=1) == (3000, 1000)


def test_an_agent_may_write_to_its_observation() -> None:
    env = team(action="path", observation=("frame", "robot"))
    env.reset(seed=3)
    for action in random_actions(3, 4, (4,)):
        seen, *_ = env.step(action)
        state = env.state()
        assert env.state_space.contains(state)
        seen["robot_0"]["frame"][:] = 7
        assert (env.state() == state).all()


def test_the_state_shows_the_teams_frame_and_cells() -> None:
    env = team(action="path", observation=("frame", "robot"))
    env.reset(seed=3)
    for action in random_actions(5, 4, (4,)):
        seen, *_ = env.step(action)
        state = env.state()
        assert env.state_space.contains(state)
        frame = np.min([one["frame"] for one in seen.values()], axis=0)[..., 0]
        seen["robot_0"]["frame"][:] = 7  # the agent may write to it
        assert (env.state() == state).all()
        values = np.where(frame == 255, state.shape[2] - 2, frame)
        assert (state[..., :-1].argmax(axis=2) == values).all()
        assert (state[..., :-1].sum(axis=2, dtype=int) == 255).all()
        places = np.zeros_like(frame)
        places[tuple(np.array([one["robot"] for one in seen.values()]).T)] = 255
        assert (state[..., -1] == places).all()


def test_a_team_is_drawn_as_a_whole() -> None:
    env = team(render_mode="rgb_array", start="centre")
    with pytest.warns(UserWarning, match="nothing to draw"):
        assert env.render() is None
    env.reset(seed=3)
    before = env.render()
    env.step(dict(zip(AGENTS, range(4), strict=True)))
    assert (env.render() != before).any()


def test_invalid_team_keywords_are_named() -> None:
    rows: list[tuple[dict[str, Any], str]] = [
        ({"action": "fly"}, "action: expected 'move' or 'path', got 'fly'"),
        ({"reward": "all"}, "reward: expected one of 'share', 'team', 'marginal', 'move'"),
        ({"action": "path", "reward": "move"}, "reward: expected one of 'share', 'team', 'marg"),
    ]
    for keywords, words in rows:
        with refuses(words):
            team(**keywords)


def test_actions_of_other_agents_are_refused() -> None:
    env = team(robots=2)
    assert env.step({}) == ({}, {}, {}, {}, {})
    env.reset(seed=1)
    wrong: Any = ({}, {"robot_0": 1}, {"robot_0": 1, "robot_1": 1, 2: 1}, [1, 1], None)
    for actions in wrong:
        with refuses("actions: expected one for each of"):
            env.step(actions)
    with refuses("actions: expected all of one shape"):
        env.step({"robot_0": 1, "robot_1": [1, 2]})
    with refuses("action: expected 0 to 3, got 4"):
        env.step({"robot_0": 1, "robot_1": 4})


def test_each_agent_draws_its_own_samples() -> None:
    env = team(robots=2)
    for space in (env.action_space, env.observation_space):
        one, other = ([repr(space(it).sample()) for _ in range(30)] for it in env.possible_agents)
        assert one != other


def alone(instance: str, robot: int, **keywords: Any) -> Any:
    return make(instance=instance, robot=robot, **keywords)


@pytest.mark.parametrize(("order", "reward"), [((0, 1, 2, 3), "share"), ((3, 1, 0, 2), "marginal")])
def test_four_single_robot_environments_equal_the_team(order: tuple[int, ...], reward: str) -> None:
    paths = random_actions(6, 4, (4,))
    with serving(robots=4) as instance:
        env = team(instance=instance, action="path", observation=PARTS, reward=reward)
        expected = rollout(env, paths, 77)
        env.reset(seed=77)
        env.close()
        keywords = {"observation": PARTS, "reward": reward}
        robots = {robot: alone(instance, robot, **keywords) for robot in order}
        for robot in order:
            seen, info = robots[robot].reset()
            assert_same(seen, expected[0][0][AGENTS[robot]])
            assert info.pop("n_missed") == 0
        for path, outcome in zip(paths, expected[1:], strict=True):
            calls = [partial(robots[robot].step, path[AGENTS[robot]]) for robot in order]
            for robot, flown in zip(order, at_once(*calls), strict=True):
                assert flown[4].pop("n_missed") == 0
                assert_same(list(flown), [part[AGENTS[robot]] for part in outcome])


def test_a_late_path_is_dropped_and_reported() -> None:
    with serving(robots=2, deadline_millis=50) as instance:
        quick, slow = alone(instance, 0), alone(instance, 1, observation=PARTS)
        quick.reset()
        first, _ = slow.reset()
        for _ in range(3):
            quick.step([1, 1, 1, 1])
        seen, reward, _, _, info = slow.step([3, 3, 3, 3])
        assert set(np.unique(seen["age"])) == {255}
        assert (reward, info["step"], info["n_missed"], info["n_visited"]) == (0.0, 3, 3, 0)
        assert (seen["robot"] == first["robot"]).all() and (seen["frame"] == 255).all()
        # From this frame on, the robot flies again.
        flown, _ = at_once(lambda: slow.step([0, 0, 0, 0]), lambda: quick.step([1, 1, 1, 1]))
        assert flown[4]["n_missed"] == 0 and flown[4]["step"] == 4 and flown[4]["n_visited"] > 0
        # Missed steps count in the ages.
        for _ in range(2):
            quick.step([1, 1, 1, 1])
        seen, *_, info = slow.step([3, 3, 3, 3])
        assert info["n_missed"] == 2 and set(np.unique(seen["age"])) == {2, 255}


def test_a_step_waits_for_slow_teammates_past_the_timeout(caplog: pytest.LogCaptureFixture) -> None:
    with serving(robots=2) as instance:
        patient, slow = alone(instance, 0), alone(instance, 1)
        patient.reset()
        slow.reset()
        words = "world 0 waits for the paths of its other leased robots"

        def late() -> Any:
            assert eventually(lambda: words in caplog.text)
            return slow.step([1, 1, 1, 1])

        with impatient(patient, 0.1):
            first, second = at_once(lambda: patient.step([3, 3, 3, 3]), late)
        assert first[4]["step"] == second[4]["step"] == 1
        assert first[4]["n_missed"] == second[4]["n_missed"] == 0
        assert first[4]["n_visited"] > 0 and second[4]["n_visited"] > 0


def test_keywords_that_do_not_fit_a_servers_team_are_named() -> None:
    of_one = "expected worlds of one robot, as options are planned for one"
    with serving(robots=3) as instance:
        rows: list[tuple[Callable[..., Any], dict[str, Any], str]] = [
            (make, {}, "robots: expected one robot in a world, got 3: fly one of them with robot="),
            (make, {"robot": 3}, "robot: expected 0 to 2, got 3"),
            (make, {"robot": 0, "world": 1}, "world: expected worlds within 0 to 0, got 1 to 1"),
            (partial(make_vec, 3), {"robot": 0}, "robot: expected None, as all robots"),
            (partial(make, OBJECTIVE), {"robot": 0}, of_one),
            (partial(make_vec, 3, OBJECTIVE), {}, of_one),
        ]
        for maker, keywords, words in rows:
            with refuses(words):
                maker(instance=instance, **keywords)
    with refuses("a multiple of 2, got 3"):
        make_vec(3, robots=2)


def test_all_rows_of_a_world_are_reset_together() -> None:
    envs = make_vec(6, robots=3, autoreset_mode="Disabled")
    first, _ = envs.reset(seed=[5, 0, 0, 9, 0, 0])
    assert_same(envs.reset(seed=[5, 1, 1, 9, 2, 2])[0], first)
    some = np.array([True, False, False, False, False, False])
    with refuses("reset_mask: expected the same value for all robots of a world"):
        envs.reset(options={"reset_mask": some})
    envs.step(envs.action_space.sample())
    _, infos = envs.reset(options={"reset_mask": np.arange(6) < 3})
    assert infos["step"].tolist() == [0] * 6
    assert infos["_step"].tolist() == [True] * 3 + [False] * 3
