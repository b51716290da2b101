"""Vector environments, compared with Gymnasium's `SyncVectorEnv` of single environments."""

import copy
import os
from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import (
    MOVES,
    OBJECTIVE,
    WILDFIRE,
    actions,
    assert_same,
    make,
    make_vec,
    serving,
)
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

import emberwatch

PARTS = ("frame", "robot", "age")

#: Keyword arguments of an environment with all parts of observations.
ALL: dict[str, dict[str, Any]] = {
    WILDFIRE: {"observation": (*PARTS, "image", "belief")},
    MOVES: {"observation": (*PARTS, "image", "belief", "local", "recent", "visited", "move")},
    OBJECTIVE: {},
}

by_name = pytest.mark.parametrize("name", ALL)

Vector = VectorEnv[Any, Any, Any]


def sync_of(n_worlds: int, mode: AutoresetMode, **keywords: Any) -> Vector:
    """Returns the same worlds as single environments."""
    return SyncVectorEnv([lambda: make(**keywords)] * n_worlds, autoreset_mode=mode)


def pair(n_worlds: int, mode: AutoresetMode, **keywords: Any) -> tuple[Vector, Vector]:
    ours = make_vec(n_worlds, autoreset_mode=mode, **keywords)
    return ours, sync_of(n_worlds, mode, **keywords)


def assert_same_resets(ours: Vector, theirs: Vector, mask: Any, seed: Any = None) -> None:
    left, right = (
        envs.reset(seed=seed, options={"reset_mask": np.array(mask)}) for envs in (ours, theirs)
    )
    assert_same(left, right, "masked reset")


def assert_same_flight(ours: Vector, theirs: Vector, n_steps: int, seed: Any) -> None:
    assert_same(ours.reset(seed=seed), theirs.reset(seed=seed), "reset")
    assert_same_steps(ours, theirs, n_steps)


def assert_same_steps(ours: Vector, theirs: Vector, n_steps: int) -> int:
    """Asserts the same for steps. Returns the number of episodes that ended."""
    n_ends = 0
    for step, action in enumerate(actions(theirs, n_steps)):
        left, right = ours.step(action), theirs.step(action)
        assert_same(left, right, f"step {step}")
        n_ends += int((left[2] | left[3]).sum())
    return n_ends


@pytest.mark.parametrize(
    ("name", "keywords"),
    [
        (WILDFIRE, {"observation": "robot"}),
        (MOVES, {"observation": "move", "reward": "move"}),
        (OBJECTIVE, {"prior": "uniform", "estimator": "known+spatial"}),
        *ALL.items(),
    ],
    ids=str,
)
@pytest.mark.parametrize("mode", AutoresetMode, ids=str)
def test_every_field_equals_that_of_single_environments(
    mode: AutoresetMode, name: str, keywords: dict[str, Any]
) -> None:
    n_steps, truth = 10 if name == MOVES else 3, mode is not AutoresetMode.SAME_STEP
    keywords = {**keywords, "name": name, "truth": truth, "max_episode_steps": n_steps}
    ours, theirs = pair(4, mode, **keywords)
    for of in ("observation_space", "action_space", "metadata"):
        assert getattr(ours, of) == getattr(theirs, of)
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.single_action_space == theirs.single_action_space
    assert_same_flight(ours, theirs, 2, seed=17)
    # Some worlds are reset in between, so that episodes end at different times.
    assert_same_resets(ours, theirs, [True, False, True, False], [7, None, 8, None])
    n_ends = assert_same_steps(ours, theirs, n_steps - 2)
    assert n_ends == 2
    if mode is AutoresetMode.DISABLED:
        with pytest.raises(gymnasium.error.ResetNeeded, match=r"rows \[1, 3\]: the episode is ov"):
            ours.step(actions(theirs, 1)[0])
        assert_same_resets(ours, theirs, [False, True, False, True])
        assert_same_steps(ours, theirs, 1)
    else:
        assert assert_same_steps(ours, theirs, 5 * n_steps) > 8
    # Without a seed, each world's own generator continues.
    assert_same_flight(ours, theirs, 2, seed=None)


def test_a_vector_flies_the_servers_worlds_from_its_first_one_on() -> None:
    with serving(worlds=5, publish_truth=True) as lab:
        ours, theirs = make_vec(3, instance=lab, world=2, truth=True), make_vec(3, truth=True)
        assert_same_flight(ours, theirs, 2, seed=6)
        with emberwatch.connect(lab) as client:
            holders = [world.holder_pids for world in client.status().worlds]
        pid = os.getpid()
        assert holders == [(None,), (None,), (pid,), (pid,), (pid,)]


def test_seeds_work_as_in_single_environments() -> None:
    ours, theirs = pair(3, AutoresetMode.NEXT_STEP, truth=True)
    for seed in (0, 2**40, [5, None, 0], (1, 2, 3), None, np.int64(4)):
        plain = int(seed) if isinstance(seed, np.integer) else seed
        assert_same(ours.reset(seed=seed), theirs.reset(seed=plain), repr(seed))
        # The generators continue alike.
        for _ in range(2):
            assert_same(ours.reset(), theirs.reset(), repr(seed))


def test_a_reset_mask_is_not_changed() -> None:
    env = make_vec(2)
    with pytest.raises(gymnasium.error.ResetNeeded, match="all worlds in the first reset"):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset(seed=1)
    options = {"reset_mask": np.array([True, False])}
    infos = env.reset(options=options)[1]
    assert options["reset_mask"].tolist() == [True, False]
    infos["_step"][:] = False
    assert options["reset_mask"].tolist() == [True, False]


def test_an_episode_that_ended_before_does_not_end_at_a_move() -> None:
    with serving(worlds=2, max_steps=1) as instance:
        first = make_vec(2, MOVES, instance=instance, autoreset_mode="Disabled")
        first.reset(seed=1)
        ends = [first.step(np.zeros(2, int))[3].tolist() for _ in range(4)]
        assert ends == [[False] * 2] * 3 + [[True] * 2]
        first.close()
        second = make_vec(2, MOVES, instance=instance, autoreset_mode="Disabled")
        second.reset(options={"resume": True})
        for _ in range(3):
            assert not second.step(np.zeros(2, int))[3].any()


def spoil(value: Any) -> None:
    if isinstance(value, np.ndarray):
        value[:] = 1
    elif isinstance(value, dict | tuple | list):
        for part in value.values() if isinstance(value, dict) else value:
            spoil(part)


@by_name
@pytest.mark.parametrize("mode", [*AutoresetMode, None], ids=str)
def test_returned_arrays_are_writable_and_never_change(
    mode: AutoresetMode | None, name: str
) -> None:
    """Covers vectors in each mode, and single environments."""
    keywords: dict[str, Any] = {**ALL[name], "max_episode_steps": 3, "truth": True}
    keywords["render_mode"] = "rgb_array"
    many: dict[str, Any] = {"n_worlds": 3, "autoreset_mode": mode} if mode else {}
    spoilt, env = ((make_vec if mode else make)(name=name, **many, **keywords) for _ in range(2))
    kept: list[Any] = []
    returned = [env.reset(seed=1)]
    spoil(spoilt.reset(seed=1))
    for step, action in enumerate(actions(env, 12)):
        if mode in (AutoresetMode.DISABLED, None) and step % 3 == 0:
            returned.append(env.reset())
            spoil(spoilt.reset())
        elif step == 2 and mode:
            for one in (env, spoilt):
                one.reset(options={"reset_mask": np.array([False, True, False])})
        returned.append(env.step(action))
        kept.append(copy.deepcopy(returned[-1]))
        outcome = spoilt.step(action)
        assert_same(outcome, kept[-1])
        spoil(outcome)
        assert_same(spoilt.render(), env.render())
    assert_same([value for value in returned if len(value) == 5], kept)


@pytest.mark.parametrize("name", [WILDFIRE, OBJECTIVE])
def test_pictures_equal_those_of_single_environments(name: str) -> None:
    keywords = {**ALL[name], "render_mode": "rgb_array", "truth": True, "max_episode_steps": 3}
    ours, theirs = pair(3, AutoresetMode.NEXT_STEP, name=name, **keywords)
    ours.reset(seed=1)
    theirs.reset(seed=1)
    assert_same(ours.render(), theirs.render())
    for step, action in enumerate(actions(theirs, 8)):
        if step == 1:
            assert_same_resets(ours, theirs, [False, True, False])
        ours.step(action)
        theirs.step(action)
        assert_same(ours.render(), theirs.render(), f"step {step}")
