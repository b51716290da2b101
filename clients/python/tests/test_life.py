"""Lives of environments of one world and of many: closed, forgotten, killed, stopped, copied."""

import copy
import gc
import os
import pickle
import signal
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import (
    MOVES,
    OBJECTIVE,
    SMALL,
    WILDFIRE,
    assert_same,
    impatient,
    make,
    make_vec,
    private_pid,
    rollout,
)
from failures import fails
from gymnasium.vector import VectorEnv
from processes import eventually, is_running, stopped

from emberwatch.errors import RequestTimeoutError, ServerGoneError

NAMES = (WILDFIRE, MOVES, OBJECTIVE)

Make = Callable[..., Any]


@pytest.fixture(
    params=[partial(making, name) for making in (make, partial(make_vec, 2)) for name in NAMES],
    ids=[f"{name} {many}" for many in ("alone", "vector") for name in NAMES],
)
def env(request: pytest.FixtureRequest) -> Any:
    """An environment of each kind, before its first reset."""
    return request.param()


@pytest.fixture
def flying(env: Any) -> Any:
    """The same, after a step of its worlds."""
    env.reset(seed=1)
    fly(env)
    return env


def fly(env: Any) -> Any:
    """Steps of zeros until the worlds have moved; returns k, of one world or of many."""
    step = 0
    for _ in range(SMALL["n_moves"] if env.spec.id == MOVES else 1):
        step = env.step(np.zeros(env.action_space.shape, int))[4]["step"]
    return step


def kill(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)
    assert has_ended(pid)


def has_ended(pid: int) -> bool:
    """Whether a process is gone, or soon is."""
    return eventually(lambda: not is_running(pid))


def test_nothing_starts_before_the_first_reset(env: Any) -> None:
    with fails("closed", match="reset it first"):
        _ = env.unwrapped.instance
    with fails("closed", match="reset it first"):
        fly(env.unwrapped)


def test_close_twice_is_fine_and_reset_opens_again(flying: Any) -> None:
    first = flying.reset(seed=3)
    for _ in range(2):
        pid = private_pid(flying)
        flying.close()
        flying.close()
        assert not is_running(pid)
        with fails("closed", match="reset it first"):
            fly(flying)
        assert_same(flying.reset(seed=3), first)
        assert private_pid(flying) != pid


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("making", [gymnasium.make, gymnasium.make_vec])
def test_private_programs_end_with_their_forgotten_environment(making: Make, name: str) -> None:
    env = making(name, **SMALL, **({"prior": "initial"} if name == OBJECTIVE else {}))
    env.reset(seed=1)
    pid = private_pid(env)
    assert is_running(pid)
    del env
    gc.collect()
    assert has_ended(pid)


def test_a_killed_private_server_is_replaced_by_the_next_reset(flying: Any) -> None:
    expected = rollout(flying, 6, seed=5)
    kill(private_pid(flying))
    with pytest.raises(ServerGoneError):
        fly(flying)
    assert_same(rollout(flying, 6, seed=5), expected)


@pytest.mark.parametrize("times_out", [False, True])
def test_a_reset_that_finds_the_server_dead_starts_another(flying: Any, times_out: bool) -> None:
    expected = rollout(flying, 6, seed=5)
    pid = private_pid(flying)
    os.kill(pid, signal.SIGSTOP)
    if times_out:
        with impatient(flying), pytest.raises(RequestTimeoutError):
            fly(flying)
            fly(flying)
    os.kill(pid, signal.SIGKILL)
    assert_same(rollout(flying, 6, seed=5), expected)


def test_worlds_that_are_gone_are_not_gone_on_with(flying: Any) -> None:
    options: list[dict[str, Any]] = [{"resume": True}]
    if isinstance(flying, VectorEnv):
        options.append({"reset_mask": np.array([True, False])})
    for given in options:
        kill(private_pid(flying))
        with pytest.raises(ServerGoneError):
            flying.reset(options=given)
        flying.reset(seed=1)


def test_a_stopped_server_times_out_and_resume_goes_on(flying: Any) -> None:
    with stopped(private_pid(flying)), impatient(flying), pytest.raises(RequestTimeoutError):
        fly(flying)
    with fails("closed", match="an earlier step or reset timed out"):
        # The first move, as that which timed out was the last of its path.
        flying.step(np.zeros(flying.action_space.shape, int))
    _, info = flying.reset(options={"resume": True})
    assert np.all(fly(flying) == info["step"] + 1)


def test_a_live_environment_is_not_copied_but_says_what_to_do(flying: Any) -> None:
    kind = type(flying.unwrapped).__name__
    words = (
        rf"expected a closed environment, got a {kind} .* close it first, or .*\.make\(env\.spec"
    )
    for copying in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match=words):
            copying(flying.unwrapped)
    fly(flying)
    flying.close()
    again = pickle.loads(pickle.dumps(copy.deepcopy(flying)))
    again.reset(seed=1)
    again.close()
