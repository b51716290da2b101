"""Tasks: their names, ids and worlds, which are those of the same settings by hand."""

import subprocess
import sys
import tomllib
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import assert_same, closed_later, no_warnings, rollout, serving
from failures import refuses
from gymnasium.utils.env_checker import check_env
from processes import find

import emberwatch
from emberwatch._native import built_in
from emberwatch.benchmark import evaluate, suite
from emberwatch.model.tasks import Task, built_in_tasks

with warnings.catch_warnings(action="ignore"):  # of its own games, which it imports
    from pettingzoo.test import parallel_api_test

CONFIG = Path(__file__).parents[3] / "config"

TASKS = built_in_tasks()

#: Flags of servers that a task decides.
OF_TASKS = dict.fromkeys(("height", "width", "moves", "burn_in", "model"))


def each(names: Iterable[str]) -> pytest.MarkDecorator:
    """A test for each of these tasks; burn-ins of some take seconds."""
    marks = {"sparse": pytest.mark.slow, "latent": pytest.mark.slow}
    kept = [pytest.param(name, marks=marks.get(name, ())) for name in names]
    return pytest.mark.parametrize("name", kept)


each_alone = each(name for name, task in TASKS.items() if task.robots == 1)


def warns_of_tests(name: str) -> Any:
    """A context in which an episode begins on a test world."""
    return pytest.warns(
        emberwatch.TrainingOnTestWorldsWarning, match=f"task '{name}': .* test world"
    )


def by_hand(name: str) -> dict[str, Any]:
    """The keywords that a task stands for."""
    file = tomllib.loads((CONFIG / f"tasks/{name}.toml").read_text("utf-8"))
    renamed = {"n_moves" if key == "moves" else key: value for key, value in file.items()}
    not_keywords = ("name", "test_seeds", "max_steps", "listing")
    return {key: value for key, value in renamed.items() if key not in not_keywords}


def test_the_package_has_the_files_of_the_programs() -> None:
    def texts(pattern: str) -> dict[str, str]:
        return {file.stem: file.read_text("utf-8") for file in CONFIG.glob(pattern)}

    assert built_in("models") == texts("models/*.toml")
    assert built_in("tasks") == texts("tasks/*.toml")
    assert built_in("states") == texts("landscapes/*/*.toml")
    for name, task in TASKS.items():
        assert Task.named(name) == Task.named(CONFIG / f"tasks/{name}.toml") == task
    with refuses("task ash: No such file .*expected one, or wildfire, small, "):
        Task.named("ash")


def test_ids_end_episodes_with_the_task() -> None:
    for name, task in TASKS.items():
        for kind, n_moves in (("-v0", 1), ("Moves-v0", task.n_moves), ("Objective-v1", 1)):
            spec = gymnasium.spec(f"emberwatch/{task.ids}{kind}")
            assert spec.max_episode_steps == n_moves * task.max_steps
            assert spec.kwargs == ({} if name == "wildfire" else {"task": name})


@each_alone
def test_a_task_is_its_settings_by_hand(name: str) -> None:
    file = CONFIG / f"tasks/{name}.toml"
    for kind, steps, other in (
        ("-v0", 3, by_hand(name)),
        ("Moves-v0", 2 * by_hand(name)["n_moves"], {"task": file}),
    ):
        worlds: list[Any] = [
            gymnasium.make(f"emberwatch/{TASKS[name].ids}{kind}"),
            gymnasium.make(f"emberwatch/Wildfire{kind}", **other),
        ]
        first, second = [rollout(env, steps, seed=1005) for env in worlds]
        assert_same(first, second)
        for env in worlds:
            env.close()


@each(TASKS)
def test_a_vector_of_a_task_is_one_of_its_settings(name: str) -> None:
    task = TASKS[name]
    n_rows = 2 * task.robots
    for kind, steps in (("-v0", 3), ("Moves-v0", 2 * task.n_moves)):
        worlds: list[Any] = [
            gymnasium.make_vec(f"emberwatch/{TASKS[name].ids}{kind}", num_envs=n_rows),
            gymnasium.make_vec(f"emberwatch/Wildfire{kind}", num_envs=n_rows, **by_hand(name)),
        ]
        first, second = [rollout(envs, steps, seed=1005) for envs in worlds]
        assert_same(first, second)
        for envs in worlds:
            envs.close()


@each_alone
def test_gymnasium_finds_no_fault(name: str) -> None:
    # The filter's first belief takes seconds on larger grids.
    kinds = ["-v0", "Moves-v0"] + (["Objective-v1"] if name == "small" else [])
    for kind in kinds:
        with no_warnings():
            env = gymnasium.make(f"emberwatch/{TASKS[name].ids}{kind}", disable_env_checker=True)
            check_env(env.unwrapped, skip_render_check=True)
            env.close()


def test_pettingzoo_finds_no_fault_in_the_team() -> None:
    with no_warnings():
        env = emberwatch.parallel_env(task="team")
        assert len(env.possible_agents) == 4
        # It resets with seed 0, and learns nothing.
        warnings.simplefilter("ignore", emberwatch.TrainingOnTestWorldsWarning)
        parallel_api_test(env, num_cycles=50)
        env.close()


def test_one_robot_flies_the_team_s_world_only_beside_others() -> None:
    with refuses("robots: expected one robot in a world, got 4: fly one of them with robot="):
        gymnasium.make("emberwatch/WildfireTeam-v0")
    with serving(task="team", **OF_TASKS) as lab:
        env = gymnasium.make("emberwatch/WildfireTeam-v0", instance=lab, robot=2)
        env.reset()
        env.close()


def test_a_task_ends_episodes_in_any_environment() -> None:
    env = gymnasium.make("emberwatch/Wildfire-v0", task="small")
    *_, last = rollout(env, TASKS["small"].max_steps, seed=1001)
    assert last[3]
    env.close()


def test_what_a_task_decides_is_refused_by_name() -> None:
    decided: dict[str, Any] = {"model": "wildfire", "states": "jacksboro", "sensor_radius": 1}
    decided |= {"states_symmetries": True, "states_offset": 3, "height": 16, "width": 16}
    decided |= {"n_moves": 16, "robots": 1, "burn_in": 3000, "start": "corner"}
    for keyword, value in decided.items():
        with refuses(f"{keyword}: expected to be left out, as the task decides it, got"):
            gymnasium.make("emberwatch/WildfireSmall-v0", **{keyword: value})
    with refuses('task : expected a name or a file, got ""'):
        gymnasium.make("emberwatch/Wildfire-v0", task="")


def test_a_running_server_must_have_the_task() -> None:
    with serving(task="small", **OF_TASKS) as lab, emberwatch.connect(lab) as client:
        assert client.info.task == "small"
        env = gymnasium.make("emberwatch/WildfireSmall-v0", instance=lab)
        env.reset()
        env.close()
        for name in ("emberwatch/WildfireSmall-v0", "emberwatch/Wildfire-v0"):
            env = gymnasium.make(name, instance=lab)
            with warns_of_tests("small"):
                env.reset(seed=0)
            env.close()
        with refuses("task: expected 'small', as the server has, or None, got 'sparse'"):
            gymnasium.make("emberwatch/WildfireSparse-v0", instance=lab)
        with refuses("task ash: No such file"):
            gymnasium.make("emberwatch/Wildfire-v0", instance=lab, task="ash")


#: Changes of a task, and words about a server of the task before.
CHANGED = {
    "small": [
        ("moves = 16", "moves = 15", "moves of task 'own': expected 16, as the server"),
        ("burn_in = 3000", "burn_in = 3", "burn_in of task 'own': expected 3000, as"),
        ("max_steps = 300", "max_steps = 3", "max_steps of task 'own': expected 300"),
        ("wildfire-small", "wildfire", "states of task 'own': expected those that the"),
    ],
    "team": [("robots = 4", "robots = 3", "robots of task 'own': expected 4, as the server")],
}


@pytest.mark.parametrize("name", CHANGED)
def test_a_running_server_must_run_what_the_task_says(tmp_path: Path, name: str) -> None:
    file = tmp_path / "own.toml"
    text = (CONFIG / f"tasks/{name}.toml").read_text("utf-8").replace(f'"{name}"', '"own"')
    file.write_text(text, "utf-8")
    with serving(task=file, **OF_TASKS) as lab:
        keywords = {"instance": lab, "task": file, "robot": 0}
        env = gymnasium.make("emberwatch/Wildfire-v0", **keywords)
        env.reset()
        env.close()
        for old, new, words in CHANGED[name]:
            assert old in text
            file.write_text(text.replace(old, new), "utf-8")
            with refuses(words):
                gymnasium.make("emberwatch/Wildfire-v0", **keywords)


def test_an_evaluation_takes_seeds_and_steps_of_its_task(tmp_path: Path) -> None:
    text = (CONFIG / "tasks/team.toml").read_text("utf-8")
    own = tmp_path / "own.toml"
    text = text.replace("max_steps = 300", "max_steps = 2").replace("end = 32", "end = 3")
    own.write_text(text.replace('"team"', '"own"'), "utf-8")
    rows = evaluate(
        lambda seen: [0] * len(seen), name="up", task=own, observation="frame", progress=None
    )
    assert [(row.world_seed, row.steps, row.robots) for row in rows] == [
        (0, 2, 4),
        (1, 2, 4),
        (2, 2, 4),
    ]


def test_a_suite_is_scored_beside_the_programs_policies(tmp_path: Path) -> None:
    own = (CONFIG / "tasks/small.toml").read_text("utf-8")
    for old, new in {'"small"': '"tiny"', "300": "9", "end = 32": "end = 3"}.items():
        own = own.replace(old, new)
    file = tmp_path / "tiny.toml"
    file.write_text(own)
    chosen: dict[str, Any] = {"name": "mine", "folder": tmp_path / "out", "progress": None}
    chosen["observation"] = "frame"

    def down(frames: Any) -> Any:
        return np.full(len(frames), 2)

    rows = suite(down, tasks=[file], worlds=2, **chosen)
    assert [(row.world_seed, row.steps) for row in rows["tiny"]] == [(0, 9), (1, 9)]
    again = suite({"tiny": down}, tasks=[file], worlds=2, **chosen)
    assert again == rows
    command = [find("emberwatch-agent"), "suite", f"--tasks={file}", f"--out={tmp_path / 'out'}"]
    command += ["--worlds=2", "--policies=coverage"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert "| mine " in done.stdout, done
    for keywords, words in (
        ({"worlds": 0}, "worlds: expected at least 1, got 0"),
        ({"steps": 3}, "steps: expected to be left out, as suite sets it"),
        ({"tasks": ["ash"]}, "task ash: No such file"),
    ):
        with refuses(words):
            suite(down, **(chosen | keywords))
    with refuses("policy: expected one for the task tiny, got small"):
        suite({"small": down}, tasks=[file], **chosen)


#: What makes environments of a task, and resets them on its test world of that seed.
ON_TEST_WORLDS: dict[str, Any] = {
    "path": lambda task: gymnasium.make("emberwatch/Wildfire-v0", task=task),
    "move": lambda task: gymnasium.make("emberwatch/WildfireMoves-v0", task=task),
    "moves": lambda task: gymnasium.make_vec("emberwatch/WildfireMoves-v0", 2, task=task),
    "team": lambda task: emberwatch.parallel_env(task=task),
    "objective": lambda task: gymnasium.make(
        "emberwatch/WildfireObjective-v1", task=task, prior="initial"
    ),
}


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A task with the test seeds 5 and 6."""
    file = tmp_path / "own.toml"
    text = (CONFIG / "tasks/small.toml").read_text("utf-8").replace('"small"', '"own"')
    for old, new in {"3000": "3", "start = 0": "start = 5", "end = 32": "end = 7"}.items():
        assert old in text
        text = text.replace(old, new)
    file.write_text(text, "utf-8")
    return file


@pytest.mark.parametrize("kind", ON_TEST_WORLDS)
def test_an_episode_on_a_test_world_warns(own: Path, kind: str) -> None:
    env = closed_later(ON_TEST_WORLDS[kind](own))
    with warns_of_tests("own"):
        env.reset(seed=6)
    with warns_of_tests("own"):
        env.reset(seed=5)
    with no_warnings():
        for seed in (7, 1000, None):
            env.reset(seed=seed)


def test_seeds_of_a_vector_are_those_of_its_worlds(own: Path) -> None:
    envs = closed_later(gymnasium.make_vec("emberwatch/Wildfire-v0", 4, task=own))
    with no_warnings():
        envs.reset(seed=1)
        envs.reset(seed=[None, 7, 8, None])
    for seed in (2, [None, None, None, 5]):
        with warns_of_tests("own"):
            envs.reset(seed=seed)


def test_evaluations_are_on_test_worlds_without_a_warning(own: Path, tmp_path: Path) -> None:
    def up(seen: Any) -> Any:
        return np.zeros(len(seen), np.int64)

    common: dict[str, Any] = {"name": "up", "observation": "frame", "progress": None}
    with no_warnings():
        evaluate(up, task=own, steps=1, **common)
        evaluate(up, task="team", steps=1, seeds=[0], **common)
        suite(up, tasks=[own], worlds=1, folder=tmp_path / "suite", **common)


#: Resets at two places, of several environments, and one with the warning switched off before.
RESETS = """
import warnings, gymnasium, emberwatch
from gymnasium.vector import SyncVectorEnv

def make():
    return gymnasium.make("emberwatch/WildfireSmallMoves-v0", observation="frame")

with warnings.catch_warnings():
    warnings.simplefilter("ignore", emberwatch.TrainingOnTestWorldsWarning)
    env = make()
    env.reset(seed=3)
    print("by hand", flush=True)
envs = SyncVectorEnv([make] * 3)
envs.reset(seed=0)
env.reset(seed=1)
for _ in range(3):
    envs.reset(seed=0)
envs.close()
env.close()
"""


def test_a_process_is_warned_once_and_not_where_it_is_switched_off() -> None:
    command = [sys.executable, "-c", RESETS]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "by hand\n"), done.stderr
    assert done.stderr.count("TrainingOnTestWorldsWarning: task 'small'") == 1
    command[1:1] = ["-W", "ignore::UserWarning"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")


def test_trainers_own_seeds_warn(own: Path) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_util import make_vec_env as dummies

    from emberwatch.sb3 import make_vec_env

    keywords = {"task": own, "observation": "local"}
    for envs in (
        make_vec_env("emberwatch/WildfireMoves-v0", 8, **keywords),
        dummies("emberwatch/WildfireMoves-v0", 8, env_kwargs=keywords),
    ):
        closed_later(envs)
        agent = sb3.PPO("MlpPolicy", envs, n_steps=8, batch_size=64, seed=0, device="cpu")
        with warns_of_tests("own"):
            agent.learn(64)
