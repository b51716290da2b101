"""Callers' arguments: arrays of any library, seeds, options, and keyword values as in JSON."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import (
    LIVELY,
    MOVES,
    OBJECTIVE,
    SMALL,
    WILDFIRE,
    assert_same,
    closed_later,
    make,
    make_vec,
)
from environments import rollout as rolled
from failures import refuses
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

import emberwatch
from emberwatch import belief
from emberwatch.benchmark import evaluate, suite
from emberwatch.model import Model
from emberwatch.wrappers import BeliefObservation

PATH = np.zeros(4, np.int64)


class Elsewhere:
    """An array that NumPy cannot read, such as a tensor on a GPU or one with gradients."""

    def __init__(self, error: Exception) -> None:
        self._error = error

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise self._error

    def __repr__(self) -> str:
        raise self._error


ELSEWHERE = [
    TypeError("use Tensor.cpu()"),
    RuntimeError("use tensor.detach()"),
    NotImplementedError("no data"),
    OSError("the cluster is gone"),
]

#: Environments, each with an action: a path or a move.
ENVIRONMENTS: dict[str, tuple[Callable[[], Any], Callable[[Any], Any], Any]] = {
    "path": (make, lambda path: path, PATH),
    "move": (lambda: make(MOVES), lambda move: move, PATH[0]),
    "paths": (lambda: make_vec(2), lambda path: [path, path], PATH),
    "moves": (lambda: make_vec(2, MOVES), lambda move: [move, move], PATH[0]),
    "team": (
        lambda: closed_later(emberwatch.parallel_env(robots=2, action="path", **SMALL)),
        lambda path: {"robot_0": path, "robot_1": path},
        PATH,
    ),
    "option": (lambda: make(OBJECTIVE), lambda option: option, PATH[0]),
    "options": (lambda: make_vec(2, OBJECTIVE), lambda option: [option, option], PATH[0]),
}

#: Wrong actions by kind of environment, each with a pattern of its error.
WRONG: dict[str, list[tuple[Any, str]]] = {
    "move": [
        (4, "expected one integer, 0 to 3, got 4"),
        *((it, f"got {it!r}") for it in (-1, 1.0, True, None, "0")),
        ([[0], [1, 2]], "got list: "),
    ],
    "moves": [
        ([0], r"integers of shape \(2,\), got int64 \(1,\)"),
        ([-1, 0], "expected 0 to 3, got -1 for world 0"),
    ],
}


@pytest.mark.parametrize("kind", ENVIRONMENTS)
def test_a_wrong_action_is_refused_and_not_flown(kind: str) -> None:
    maker, action, given = ENVIRONMENTS[kind]
    env = getattr(made := maker(), "unwrapped", made)
    env.reset(seed=1)
    wrong = [*WRONG.get(kind, [])]
    wrong += [(action(Elsewhere(it)), f"action.*: expected .*, got .*: {it}") for it in ELSEWHERE]
    masked = action(np.ma.array(given, mask=True))
    wrong += [(masked, r"action.*: expected .*, got (masked values|.*masked element.*)")]
    for value, words in wrong:
        with refuses(words):
            env.step(value)
    seen, _, _, _, info = env.step(action(np.ma.array(given)))
    steps = info["robot_0"]["step"] if kind == "team" else info.get("step")
    assert np.all((seen["move"] if "move" in kind else steps) == 1)


def test_seeds_of_any_library_are_equivalent() -> None:
    expected = make().reset(seed=5)
    for seed in (np.int64(5), np.uint8(5), np.array(5), np.array(5, ">i8")):
        assert_same(make().reset(seed=seed), expected)
        assert_same(make_vec(1).reset(seed=[seed])[0]["frame"], expected[0]["frame"][np.newaxis])


#: Wrong arguments of `reset`, with error patterns: of any environment, and of a vector.
WRONG_RESETS: list[tuple[dict[str, Any], str]] = [
    *(({"seed": it}, rf"seed: expected an integer.*, got {it}") for it in (-1, 2**64)),
    *(
        ({"seed": it}, "seed: expected (an integer|integers)")
        for it in (5.0, np.array([5.0, 6.0]), "ab", {5, 6}, Elsewhere(ELSEWHERE[0]))
    ),
    *(({"seed": np.ma.array(it, mask=True)}, "seed: expected") for it in (5, [5, 6])),
    *(
        ({"options": it}, r"options: expected a dictionary such as \{'resume': True\}, or None, ")
        for it in ("resume", 5, {"resume"}, Elsewhere(ELSEWHERE[0]))
    ),
]
WRONG_SINGLE: list[tuple[dict[str, Any], str]] = [
    ({"options": {"rewind": True}}, "options: expected 'resume', got 'rewind'"),
    ({"seed": 3, "options": {"resume": True}}, "resume=True continues an episode, so it cannot"),
]
WRONG_VECTOR: list[tuple[dict[str, Any], str]] = [
    *(({"seed": [1] * n}, "seed: expected an integer, None or 2 of them, got") for n in (0, 1, 3)),
    *(
        ({"options": {"reset_mask": it}}, words)
        for it, words in (
            ([True, False], r"an array \(2,\) of bool .* got <class 'list'>"),
            (np.array([1, 0]), r"expected an array \(2,\) of bool .* got int64 \(2,\)"),
            (np.array([True]), r"expected an array \(2,\) of bool .* got bool \(1,\)"),
            (np.array([False, False]), "with at least one True"),
        )
    ),
]


def test_wrong_reset_arguments_are_named() -> None:
    team = closed_later(emberwatch.parallel_env(robots=2, **SMALL))
    for env, more in ((make(), WRONG_SINGLE), (make_vec(2), WRONG_VECTOR), (team, [])):
        env.reset(seed=1)
        for arguments, words in (*WRONG_RESETS, *more):
            with refuses(words):
                env.reset(**arguments)


#: Keyword arguments of a specification, as callers write them.
KEYWORDS: list[dict[str, Any]] = [
    {"model": Path(LIVELY)},
    {"height": np.int64(7), "width": np.uint8(5), "burn_in": np.array(50)[()]},
    {"truth": np.bool_(True), "timeout": np.float32(5)},
    {"observation": np.array(["frame", "age"])},
    {"observation": ("frame", "robot")},
]


def test_a_spec_survives_json() -> None:
    for keywords in KEYWORDS:
        env = make(**keywords)
        again = closed_later(gymnasium.make(EnvSpec.from_json(env.spec.to_json())))
        assert_same(rolled(again, 2, seed=5), rolled(env, 2, seed=5), repr(keywords))
    mode = AutoresetMode.SAME_STEP
    keywords = {"model": Path(LIVELY), "autoreset_mode": mode, "max_episode_steps": np.int64(3)}
    text = make_vec(np.int64(2), MOVES, **keywords).spec.to_json()
    again = closed_later(gymnasium.make_vec(EnvSpec.from_json(text)))
    assert again.num_envs == 2 and again.autoreset_mode is mode
    assert str(SMALL["height"]) in text and os.fspath(LIVELY) in text
    prior = np.full((3, 7, 5), 1 / 3, np.float32)
    for model in (Model.named(LIVELY), Path(LIVELY), LIVELY, None):
        wrapped = BeliefObservation(make(), prior=prior, model=model)
        again = closed_later(gymnasium.make(EnvSpec.from_json(wrapped.spec.to_json())))
        assert_same(rolled(again, 2, seed=5), rolled(wrapped, 2, seed=5))


#: Calls that are given a value of thousands of characters: by Python, by Rust, and in files.
GIVEN_LONG: dict[str, Callable[[Any], object]] = {
    "model": lambda long: make(model=long),
    "toml": lambda long: make(model=f"\n{long} = 1"),
    "observation": lambda long: make(observation=long),
    "instance": lambda long: make(instance=long, timeout=0.01),
    "options": lambda long: make().reset(options={long: True}),
    "setting": lambda long: emberwatch.embed(**{long: 1}),
    "kind": lambda long: belief.load("no", height=4, width=4, kind=long),
    "policy": lambda long: evaluate(lambda seen: seen, name="mine", env=long),
    "length": lambda long: make_vec(2, max_episode_steps=long),
    "tasks": lambda long: suite(lambda seen: seen, name="a", folder="no", tasks=["small"] * 900),
}


@pytest.mark.parametrize("long", ["x" * 9000, "\N{FIRE}" * 3000])
@pytest.mark.parametrize("of", GIVEN_LONG)
def test_a_refusal_quotes_little_of_a_long_value(of: str, long: str) -> None:
    with pytest.raises((emberwatch.EmberwatchError, ValueError)) as refused:
        GIVEN_LONG[of](long)
    text = str(refused.value)
    assert len(text) < 700, text
    assert long[:90] not in text


def test_documented_modules_can_be_imported() -> None:
    assert emberwatch.wrappers.BeliefObservation is BeliefObservation
    with pytest.raises(AttributeError, match="'emberwatch' has no attribute 'wrapers'"):
        emberwatch.wrapers  # noqa: B018


def test_a_number_too_long_to_print_is_refused() -> None:
    with refuses("n_moves"):
        make(n_moves=10**5000)
    with refuses("seed: expected an integer within 0 to 2"):
        make().reset(seed=10**5000)


def test_a_belief_of_recorded_worlds_needs_a_model() -> None:
    with refuses("BeliefObservation: recorded worlds have no model. Pass model=: "):
        BeliefObservation(gymnasium.make(WILDFIRE, task="jacksboro", observation="frame"))
