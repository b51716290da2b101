"""The life cycle of environments: closing, copying, and servers that fail."""

import copy
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

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
    rollout,
    small_server,
)
from failures import fails
from gymnasium.vector import VectorEnv
from processes import Server

from emberwatch.errors import RequestTimeoutError, ServerGoneError

Make = Callable[..., Any]


@pytest.fixture(
    params=[
        partial(making, name, **keywords)
        for making in (make, partial(make_vec, 2))
        for name, keywords in (
            (WILDFIRE, {}),
            (MOVES, {"observation": ("belief", "local")}),
            (OBJECTIVE, {}),
        )
    ],
    ids=[f"{kind} {many}" for many in ("alone", "vector") for kind in ("path", "move", "option")],
)
def making(request: pytest.FixtureRequest) -> Make:
    return request.param


@pytest.fixture
def started() -> Server:
    return small_server(worlds=2)


@pytest.fixture
def attached(making: Make, started: Server) -> Any:
    env = making(instance=started.instance)
    env.reset(seed=1)
    fly(env)
    return env


def fly(env: Any) -> Any:
    """Steps with zeros until the worlds have moved. Returns k of one world or many."""
    step = 0
    for _ in range(SMALL["n_moves"] if env.spec.id == MOVES else 1):
        step = env.step(np.zeros(env.action_space.shape, int))[4]["step"]
    return step


def test_close_may_be_repeated_and_reset_reopens(making: Make) -> None:
    env = making()
    with fails("closed", match="reset it first"):
        fly(env.unwrapped)
    first = env.reset(seed=3)
    for _ in range(2):
        env.close()
        env.close()
        with fails("closed", match="reset it first"):
            fly(env)
        assert_same(env.reset(seed=3), first)


def test_a_reset_attaches_to_the_next_server(attached: Any, started: Server) -> None:
    expected = rollout(attached, 6, seed=5)
    started.kill()
    with pytest.raises(ServerGoneError):
        fly(attached)
    small_server(instance=started.instance, worlds=2)
    assert_same(rollout(attached, 6, seed=5), expected)


def test_worlds_of_an_ended_server_cannot_continue(attached: Any, started: Server) -> None:
    options: list[dict[str, Any]] = [{"resume": True}]
    if isinstance(attached, VectorEnv):
        options.append({"reset_mask": np.array([True, False])})
    for given in options:
        started.kill()
        with pytest.raises(ServerGoneError):
            attached.reset(options=given)
        started = small_server(instance=started.instance, worlds=2)
        attached.reset(seed=1)


def test_a_stopped_server_times_out_and_resume_continues(attached: Any, started: Server) -> None:
    started.stop()
    with impatient(attached), pytest.raises(RequestTimeoutError):
        fly(attached)
    started.wake_up()
    with fails("closed", match="an earlier step or reset timed out"):
        # The first move of a new path: the move that timed out was the last of its path.
        attached.step(np.zeros(attached.action_space.shape, int))
    _, info = attached.reset(options={"resume": True})
    assert np.all(fly(attached) == info["step"] + 1)


def test_copying_an_open_environment_is_refused(making: Make) -> None:
    env = making()
    expected = rollout(env, 3, seed=1)
    kind = type(env.unwrapped).__name__
    words = (
        rf"expected a closed environment, got a {kind} .* close it first, or .*\.make\(env\.spec"
    )
    for copying in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match=words):
            copying(env.unwrapped)
    env.close()
    again = pickle.loads(pickle.dumps(copy.deepcopy(env)))
    assert_same(rollout(again, 3, seed=1), expected)
    again.close()


@pytest.mark.parametrize("module", ["emberwatch.landscape", "emberwatch.render.film"])
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_reader_that_leaves_ends_a_command_silently(module: str, unbuffered: str) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", module, "--help"]
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    ended = subprocess.run(
        command, stdout=writer, stderr=subprocess.PIPE, env=environment, timeout=60
    )
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (-signal.SIGPIPE, b"")
