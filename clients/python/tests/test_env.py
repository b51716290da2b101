"""`emberwatch/Wildfire-v0`: Gymnasium's own checks, seeds, options, faults, wrappers."""

import dataclasses
import gc
import json
import os
import pydoc
import re
import tomllib
from functools import partial
from pathlib import Path
from types import NoneType
from typing import Any, get_args

import gymnasium
import numpy as np
import pytest
from environments import (
    LIVELY,
    MOVES,
    OBJECTIVE,
    SMALL,
    WILDFIRE,
    actions,
    assert_same,
    impatient,
    make,
    make_vec,
    no_warnings,
    rollout,
    serving,
)
from failures import fails, refuses
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv

import emberwatch
from emberwatch.envs.parallel import WildfireParallelEnv
from emberwatch.envs.settings import KEYWORDS, Settings
from emberwatch.errors import LeaseLostError, NoServerError

PARTS = ["frame", "robot", "age"]


MODES, SHAPES = (None, "human", "rgb_array", "ansi"), ("Env", "VectorEnv")


@pytest.mark.parametrize(
    ("name", "keywords"),
    [
        *((name, {"render_mode": mode}) for name in (WILDFIRE, MOVES) for mode in MODES),
        (WILDFIRE, {"observation": "robot"}),
        (WILDFIRE, {"observation": ["frame"]}),
        (WILDFIRE, {"truth": True, "observation": PARTS, "start": "centre"}),
        (WILDFIRE, {"n_moves": 1, "height": 1, "width": 1}),
        (WILDFIRE, {"burn_in": 0, "model": None}),
        (MOVES, {"observation": "move"}),
        (MOVES, {"observation": ("age", "frame", "visited", "move"), "start": "random"}),
        (MOVES, {"reward": "move", "truth": True}),
        (MOVES, {"n_moves": 1, "height": 1, "width": 1}),
    ],
    ids=str,
)
def test_the_environment_checker_passes(name: str, keywords: dict[str, Any]) -> None:
    with no_warnings():
        env = make(name, **keywords)
        for transition in rollout(env, 30, seed=1):
            assert transition[0] in env.observation_space
        # Rewards and end flags are plain Python values.
        plain = [*transition[1:4], transition[4]["step"]]
        assert [*map(type, plain)] == [float, bool, bool, int]
        more = {"n_target_cells", "n_hits", "truth"} if keywords.get("truth") else set()
        more |= {"action_mask"} if name == MOVES else set()
        assert set(transition[4]) == {"step", "n_visited"} | more
        check_env(env.unwrapped, skip_render_check=keywords.get("render_mode") is None)


def test_help_shows_each_keyword_with_its_default() -> None:
    names = (f"Wildfire{what}{of}" for what in ("", "Moves", "Objective") for of in SHAPES)
    for kind in (*(getattr(emberwatch, name) for name in names), WildfireParallelEnv):
        words = pydoc.render_doc(kind, renderer=pydoc.plaintext)
        own = {field.name: repr(field.default) for field in dataclasses.fields(Settings)}
        for keyword in KEYWORDS:
            default = re.escape(own.get(keyword, "None"))
            assert re.search(rf"\b{keyword}: [^=]+ = {default}", words), keyword
        assert "**world" not in words


def test_each_setting_of_worlds_is_a_keyword_with_a_row_in_the_table() -> None:
    file = Path(__file__).parents[3] / "config/server.toml"
    defaults = {
        "n_moves" if name == "moves" else name: it
        for name, it in tomllib.loads(file.read_text()).items()
    }
    kinds = KEYWORDS
    table = f"{emberwatch.WildfireEnv.__doc__}{emberwatch.WildfireVectorEnv.__doc__}"
    own = {field.name for field in dataclasses.fields(Settings)}
    for keyword in kinds.keys() - own:
        default = defaults[keyword]
        assert {type(default), NoneType} <= {*get_args(kinds[keyword])}, keyword
        shown = f"{default:,}" if type(default) is int else json.dumps(default).capitalize()
        row = rf"`{keyword}` \(`?{re.escape(shown)}`?[:)]"
        assert re.search(row, table), f"the docstring lacks a row: `{keyword}` ({shown})"


def test_truth_survives_many_samples_of_other_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        serving(worlds=41, publish_truth=True) as instance,
        emberwatch.connect(instance) as client,
        client.acquire(1, 40) as neighbours,
    ):
        env = make(instance=instance, truth=True, timeout=20)
        env.reset(seed=1)
        session = env.unwrapped._session
        step = session.step

        def step_and_be_late(moves: Any) -> Any:
            answer = step(moves)
            for _ in range(5):  # 200 samples, more than the 128 that a reader keeps
                neighbours.step(np.zeros((40, 4), int))
            return answer

        monkeypatch.setattr(session, "step", step_and_be_late)
        alone = make(truth=True)
        alone.reset(seed=1)
        for action in actions(alone, 3):
            assert_same(env.step(action), alone.step(action))


def test_episodes_repeat_by_seed_and_differ_without_one() -> None:
    env, other = make(truth=True), make(truth=True)
    env.reset(seed=5)
    assert_same(env.reset(seed=0), other.reset(seed=0))
    assert env.unwrapped.np_random_seed == 0
    assert env.unwrapped.lease.client.status().worlds[0].seed == 0
    series = [[env.reset(seed=11), *(env.reset() for _ in range(4))] for _ in range(2)]
    assert_same(series[0], series[1])
    assert len({info["truth"].tobytes() for _, info in series[0]}) == 5
    for making in (make, partial(make_vec, 2)):
        envs = [making(truth=True) for _ in range(2)]
        assert len({env.reset()[1]["truth"].tobytes() for env in envs for _ in range(2)}) == 4


@pytest.mark.parametrize(("name", "n_actions"), [(WILDFIRE, 1), (MOVES, 4)])
def test_a_server_can_truncate_earlier(name: str, n_actions: int) -> None:
    with serving(max_steps=2) as instance:
        env = make(name, instance=instance)
        ends = [transition[2:4] for transition in rollout(env, 2 * n_actions, seed=1)[1:]]
        assert ends == [(False, False)] * (2 * n_actions - 1) + [(False, True)]
        *path, last = actions(env, n_actions)
        for action in path:
            env.step(action)
        with fails("episode_over"):
            env.step(last)
        assert env.reset()[1]["step"] == 0
        assert [env.step(action)[4]["step"] for action in (*path, last)][-1] == 1


#: Wrong keyword arguments of `make`, each with words of its error.
IMPOSSIBLE: list[tuple[dict[str, Any], str]] = [
    ({"observation": ()}, r"expected one or several of frame, image, .*, others, got \(\)"),
    *(({"observation": it}, "observation") for it in (["frame", "frame"], ["frame", "visited"])),
    ({"height": "7"}, r"^height: expected int \| None, got '7'$"),
    ({"n_moves": -1}, "^n_moves: expected 1 to 4096, got -1$"),
    ({"model": "nowhere.toml"}, r"model file nowhere\.toml: No such .*expected a file, or one of "),
    ({"timeout": float("nan")}, "timeout: expected seconds above 0, got nan"),
    ({"robot": 0}, "^robot: applies only with instance="),
    ({"instance": "no spaces"}, "got 'no spaces'"),
    ({"name": MOVES, "reward": "cell"}, "reward: expected one of 'share', 'team', .*got 'cell'"),
    ({"name": MOVES, "observation": ["a", 0]}, "several of frame, .*, move, action_mask, got"),
    *(({"name": MOVES, "window": it}, "window: expected an odd number, 3 to") for it in (4, "5")),
]

#: Wrong keyword arguments of `make_vec`, each with words of its error.
IMPOSSIBLE_VECTORS: list[tuple[dict[str, Any], str]] = [
    ({"n_worlds": 0}, "^num_envs: expected 1 to 1024, got 0$"),
    ({"n_worlds": 5120, "robots": 5}, "^num_envs: expected 1 to 4096, got 5120$"),
    ({"max_episode_steps": 0}, "max_episode_steps: expected at least 1 or None, got 0"),
    ({"autoreset_mode": "sometimes"}, "sometimes"),
]

#: Wrong keyword arguments together with `instance`, for a server of two worlds.
OTHER_THAN_SERVED: list[tuple[dict[str, Any], str]] = [
    ({"height": 8}, "height: expected the server's 7, or None, got 8"),
    ({"model": "wildfire"}, "model: expected None"),
    ({"start": "corner"}, "start: expected None"),
    ({"world": -1}, "world: expected worlds within 0 to 1, got -1 to -1"),
    ({"truth": True}, "truth: expected a server started with --publish-truth"),
]


def test_invalid_keywords_are_named_at_construction() -> None:
    for keywords, words in IMPOSSIBLE:
        with refuses(words):
            make(**keywords)
    for keywords, words in IMPOSSIBLE_VECTORS:
        with no_warnings(), pytest.raises(ValueError, match=words):
            make_vec(**{"n_worlds": 2, **keywords})
    gc.collect()
    with refuses(r"expected None or one of human, .*, got 'film'"):
        emberwatch.WildfireEnv(render_mode="film")
    with pytest.raises(NoServerError, match="emberwatch-server --instance nobody"):
        make(instance="nobody", timeout=3)


def test_an_unknown_keyword_is_named() -> None:
    for name, keyword, hint in (
        *(
            (name, "hight", r" \(did you mean 'height'\?\)")
            for name in (WILDFIRE, MOVES, OBJECTIVE)
        ),
        (MOVES, "num_envs", ""),
        (WILDFIRE, "renderMode", ".*_mode.*"),
    ):
        with pytest.raises(TypeError) as raised:
            make(name, **{keyword: 2})
        words = (
            r"Wildfire\w*Env\(\) got an unexpected keyword argument '{}'{}; "
            r"known keywords: .*burn_in.*"
        )
        assert re.fullmatch(words.format(keyword, hint), str(raised.value))
        assert ("checkpoint" in str(raised.value)) == (name == OBJECTIVE)


def test_keywords_must_match_the_server() -> None:
    with serving(worlds=2) as lab:
        for keywords, words in OTHER_THAN_SERVED:
            with refuses(words):
                make(instance=lab, **keywords)
        env = make(instance=lab, height=7, width=5, n_moves=4, burn_in=50)
        assert env.unwrapped.model is not None and env.unwrapped.model.name == "lively"
        assert env.unwrapped.burn_in == 50
        env.reset()
        assert env.unwrapped.instance == lab
    words = "truth: expected at most 128 worlds, got 129"
    with serving(worlds=129, publish_truth=True) as lab, refuses(words):
        make_vec(129, instance=lab, truth=True)
    with serving(reveal_model=False) as lab:
        env = make(instance=lab, render_mode="ansi")
        assert env.unwrapped.model is None
        env.reset(seed=1)
        assert env.render()


def test_worlds_without_rewards_cause_a_warning(tmp_path: Path) -> None:
    model = tmp_path / "model.toml"
    model.write_text(Path(LIVELY).read_text().replace("reward = 1.0", "reward = 0.0"))
    for making in (gymnasium.make, gymnasium.make_vec):
        with pytest.warns(UserWarning, match="model .lively.: no state pays") as caught:
            making(WILDFIRE, **SMALL | {"model": str(model)})
        assert caught[0].filename == __file__
    # A world in which nothing burns causes one warning.
    worlds = {"model": "wildfire-small", "burn_in": 0}
    env, envs = make(**worlds), gymnasium.make_vec(WILDFIRE, num_envs=2, **SMALL | worlds)
    for one in (env, envs):
        with pytest.warns(UserWarning, match="no cell .*: use a longer burn_in .0 for") as caught:
            one.reset(seed=1)
        assert caught[0].filename == __file__
        one.reset(seed=1)


def test_takeover_continues_at_the_worlds_step() -> None:
    with serving() as instance:
        loser = make(instance=instance)
        winner = make(instance=instance, takeover=True)
        loser.reset(seed=1)
        loser.step([1, 1, 1, 1])
        with fails("busy", match=f"held by pid {os.getpid()}; .* takeover=True"):
            make(instance=instance).reset()
        observation, info = winner.reset(options={"resume": True})
        assert info["step"] == 1 and observation["robot"].tolist() == [4, 0]
        with pytest.raises(LeaseLostError) as caught:
            loser.step([1, 1, 1, 1])
        assert caught.value.detail == os.getpid()
        with fails("busy"):
            loser.reset()
        winner.close()
        assert loser.reset(seed=3)[1]["step"] == 0


def test_a_new_server_with_other_worlds_is_refused() -> None:
    with serving() as instance:
        env = make(instance=instance)
        env.reset()
    with impatient(env), pytest.raises(NoServerError):
        env.reset()
    with serving(instance=instance, width=6), refuses("another width"):
        env.reset()
    with serving(instance=instance, model="wildfire"), refuses("another model"):
        env.reset()


@pytest.mark.parametrize(
    "context", ["fork", "spawn", pytest.param("forkserver", marks=pytest.mark.slow)]
)
def test_async_vector_env_simulates_in_each_worker(context: str) -> None:
    single = make()
    expected = rollout(single, 3, seed=21)
    paths = actions(single, 3)
    single.close()
    vector = AsyncVectorEnv([_make_small] * 2, context=context)
    try:
        observations = [vector.reset(seed=[21, 22])[0]]
        observations += [vector.step(np.stack([path, path]))[0] for path in paths]
    finally:
        vector.close()
    for theirs, ours in zip(observations, expected, strict=True):
        assert_same(theirs["frame"][0], ours[0]["frame"])


def _make_small() -> gymnasium.Env[Any, Any]:
    return gymnasium.make(f"emberwatch:{WILDFIRE}", **SMALL)


@pytest.mark.parametrize("making", [make, partial(make_vec, 2)])
def test_rendering_without_a_mode_warns(making: Any) -> None:
    env = making().unwrapped
    env.reset(seed=1)
    with pytest.warns(UserWarning, match="nothing to draw; give a render_mode"):
        assert env.render() is None
