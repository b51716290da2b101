"""Tasks: their names, ids and worlds, which equal worlds with the same settings by hand."""

import tomllib
import warnings
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import (
    MOVES,
    OBJECTIVE,
    WILDFIRE,
    assert_same,
    closed_later,
    no_warnings,
    rollout,
    serving,
)
from failures import refuses
from gymnasium.utils.env_checker import check_env

import emberwatch
from emberwatch._native import built_in
from emberwatch.benchmark import evaluate
from emberwatch.model.tasks import Task, built_in_tasks

CONFIG = Path(__file__).parents[3] / "config"

TASKS = built_in_tasks()

#: Flags of a server that a task sets.
OF_TASKS = dict.fromkeys(("height", "width", "moves", "burn_in", "model"))


def each(names: Iterable[str]) -> pytest.MarkDecorator:
    """Parametrizes a test by task. Tasks whose burn-ins take seconds are marked slow."""
    marks = {"sparse": pytest.mark.slow, "latent": pytest.mark.slow}
    kept = [pytest.param(name, marks=marks.get(name, ())) for name in names]
    return pytest.mark.parametrize("name", kept)


def warns_of_tests(name: str) -> Any:
    return pytest.warns(
        emberwatch.TrainingOnTestWorldsWarning, match=f"task '{name}': .* test world"
    )


def by_hand(name: str) -> dict[str, Any]:
    file = tomllib.loads((CONFIG / f"tasks/{name}.toml").read_text("utf-8"))
    renamed = {"n_moves" if key == "moves" else key: value for key, value in file.items()}
    not_keywords = ("name", "test_seeds", "max_steps", "listing")
    return {key: value for key, value in renamed.items() if key not in not_keywords}


def test_the_package_contains_the_programs_files() -> None:
    def texts(pattern: str) -> dict[str, str]:
        return {file.stem: file.read_text("utf-8") for file in CONFIG.glob(pattern)}

    models = built_in("models")
    assert models.pop("wildfire-terrain") != texts("models/*.toml")["wildfire-terrain"]  # its maps
    assert models.items() <= texts("models/*.toml").items()
    assert built_in("tasks") == texts("tasks/*.toml")
    assert built_in("states") == texts("landscapes/*/*.toml")
    for name, task in TASKS.items():
        assert Task.named(name) == Task.named(CONFIG / f"tasks/{name}.toml") == task
    with refuses("task ash: No such file .*expected a file, or one of wildfire, small, "):
        Task.named("ash")
    for name, task in TASKS.items():  # ids end episodes with the task
        for kind, first, n_moves in (("", 0, 1), ("Moves", 0, task.n_moves), ("Objective", 1, 1)):
            spec = gymnasium.spec(f"emberwatch/{task.ids}{kind}-v{first + task.version}")
            assert spec.max_episode_steps == n_moves * task.max_steps
            assert spec.kwargs == ({} if name == "wildfire" else {"task": name})


def are_same(makers: list[Any], steps: int) -> None:
    worlds = [maker() for maker in makers]
    assert_same(*(rollout(one, steps, seed=1005) for one in worlds))
    for one in worlds:
        one.close()


@each(TASKS)
def test_a_task_equals_its_settings_by_hand(name: str) -> None:
    task, hand = TASKS[name], by_hand(name)
    ids, n_rows, n_moves = f"emberwatch/{task.ids}", 2 * task.robots, 2 * task.n_moves
    version = f"-v{task.version}"
    make, many = gymnasium.make, partial(gymnasium.make_vec, num_envs=n_rows)
    are_same([lambda: many(f"{ids}{version}"), lambda: many(WILDFIRE, **hand)], 3)
    if task.robots == 1:
        file = CONFIG / f"tasks/{name}.toml"
        are_same([lambda: make(f"{ids}Moves{version}"), lambda: make(MOVES, task=file)], n_moves)
    if name == "small":
        are_same([lambda: many(f"{ids}Moves{version}"), lambda: many(MOVES, **hand)], n_moves)
        for kind in ("-v0", "Moves-v0", "Objective-v1"):
            with no_warnings():
                env = make(f"{ids}{kind}", disable_env_checker=True)
                check_env(env.unwrapped, skip_render_check=True)
                env.close()


def test_the_team_task_has_four_robots() -> None:
    env = closed_later(emberwatch.parallel_env(task="team"))
    assert len(env.possible_agents) == 4
    with serving(task="team", **OF_TASKS) as lab:
        one = closed_later(gymnasium.make("emberwatch/WildfireTeam-v0", instance=lab, robot=2))
        one.reset()


def test_keywords_set_by_a_task_are_refused() -> None:
    for keyword, value in (("model", "wildfire"), ("n_moves", 16), ("states_symmetries", False)):
        with refuses(f"{keyword}: expected to be left out, as the task decides it, got"):
            gymnasium.make("emberwatch/WildfireSmall-v0", **{keyword: value})
    env = closed_later(gymnasium.make(WILDFIRE, task="small"))
    assert rollout(env, TASKS["small"].max_steps, seed=1001)[-1][3], "it ends episodes"
    with refuses('task : expected a name or a file, got ""'):
        gymnasium.make(WILDFIRE, task="")


def test_a_running_server_must_match_the_task(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    text = (CONFIG / "tasks/team.toml").read_text("utf-8").replace('"team"', '"own"')
    file.write_text(text, "utf-8")
    with serving(task=file, **OF_TASKS) as lab:
        keywords = {"instance": lab, "task": file, "robot": 0}
        closed_later(gymnasium.make(WILDFIRE, **keywords)).reset()
        with refuses("task: expected the server's 'own', or None, got 'sparse'"):
            gymnasium.make("emberwatch/WildfireSparse-v1", instance=lab)
        for old, new in (("robots = 4", "robots = 3"), ("max_steps = 300", "max_steps = 3")):
            assert old in text
            file.write_text(text.replace(old, new), "utf-8")
            with refuses("task 'own': expected the server's worlds, .*, and 300 steps, got "):
                gymnasium.make(WILDFIRE, **keywords)
    with serving(task="small", **OF_TASKS) as lab:
        env = closed_later(gymnasium.make(WILDFIRE, instance=lab))
        with warns_of_tests("small"):
            env.reset(seed=0)


#: Functions that make environments of a task and reset them on the test world of a seed.
ON_TEST_WORLDS: list[Any] = [
    lambda task: gymnasium.make(WILDFIRE, task=task),
    lambda task: gymnasium.make_vec(MOVES, 2, task=task),
    lambda task: emberwatch.parallel_env(task=task),
    lambda task: gymnasium.make(OBJECTIVE, task=task, prior="initial"),
]


@pytest.fixture
def own(tmp_path: Path) -> Path:
    file = tmp_path / "own.toml"
    text = (CONFIG / "tasks/small.toml").read_text("utf-8").replace('"small"', '"own"')
    for old, new in {"3000": "3", "start = 0": "start = 5", "end = 32": "end = 7"}.items():
        assert old in text
        text = text.replace(old, new)
    file.write_text(text, "utf-8")
    return file


def test_a_task_ends_episodes_unless_the_id_or_the_user_does(own: Path) -> None:
    own.write_text(own.read_text("utf-8").replace("max_steps = 300", "max_steps = 1003"), "utf-8")
    many: Any = partial(gymnasium.make_vec, num_envs=1)
    for maker in (gymnasium.make, many):
        for keywords, length in (({}, 1000), ({"max_episode_steps": -1}, 1003)):
            env, n_steps, ends = closed_later(maker(WILDFIRE, task=own, **keywords)), 0, False
            env.reset(seed=1000)
            while not ends:
                ends, n_steps = bool(env.step(env.action_space.sample())[3]), n_steps + 1
            assert n_steps == length


def test_an_episode_on_a_test_world_warns(own: Path) -> None:
    for maker in ON_TEST_WORLDS:
        env = closed_later(maker(own))
        for seed in (6, 5):
            with warns_of_tests("own"):
                env.reset(seed=seed)
        with no_warnings():
            for seed in (7, 1000, None):
                env.reset(seed=seed)
    envs = closed_later(gymnasium.make_vec(WILDFIRE, 4, task=own))
    with no_warnings():
        envs.reset(seed=1)
        envs.reset(seed=[None, 7, 8, None])
    for seed in (2, [None, None, None, 5]):
        with warns_of_tests("own"):
            envs.reset(seed=seed)


def test_evaluations_on_test_worlds_do_not_warn(own: Path) -> None:
    def up(seen: Any) -> Any:
        return np.zeros(len(seen), np.int64)

    common: dict[str, Any] = {"name": "up", "observation": "frame", "progress": None}
    with no_warnings():
        rows = evaluate(up, task=own, steps=1, **common)
        assert [row.world_seed for row in rows] == [5, 6]
        (row,) = evaluate(up, task="team", steps=1, seeds=[0], **common)
        assert row.robots == 4


def test_the_warning_appears_once() -> None:
    envs = [closed_later(gymnasium.make("emberwatch/WildfireSmall-v0")) for _ in range(3)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for env in envs:
            env.reset(seed=3)
            env.reset(seed=1)
    assert [each.category for each in caught] == [emberwatch.TrainingOnTestWorldsWarning]
