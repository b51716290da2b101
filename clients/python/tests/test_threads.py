"""Threads of one process: concurrent forks, work during waits, taking turns, refused copies."""

import copy
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

import numpy as np
import pytest
from environments import MOVES, SMALL, assert_same, closed_later, make, make_vec, rollout
from failures import fails
from processes import at_once, script, server

import emberwatch

#: Forks while a thread opens connections and steps; each child flies another robot.
FORKS = """
import os, sys, threading, time
from emberwatch import EmberwatchError, connect, observe

instance = sys.argv[1]
held, observer = connect(instance), observe(instance, timeout=0)
lease, is_over, errors = held.acquire(0), threading.Event(), []

def loop():
    try:
        while not is_over.is_set():
            lease.step([3] * 6)
            with connect(instance) as client:
                client.acquire(1).release()
    except Exception as error:
        errors.append(error)

def child():
    step = lambda: lease.step([3] * 6)
    for call in (step, held.status, held.observe, lease.release, lambda: observer.receive(0)):
        try:
            call()
        except EmberwatchError as error:
            assert error.code == "forked" and "open a new one" in str(error)
        else:
            os._exit(9)
    held.close()
    observer.close()
    with connect(instance) as client:
        client.acquire(2).step([3] * 6)

lease.step([3] * 6)  # Imports what it needs before any fork.
thread = threading.Thread(target=loop)
thread.start()
codes = set()
for _ in range(40):
    pid = os.fork()
    if pid == 0:
        try:
            child()
            os._exit(0)
        finally:
            os._exit(7)
    codes.add(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
is_over.set()
thread.join()
lease.step([3] * 6)
assert observer.receive(5) is not None
print(codes, errors)
"""


def test_forked_children_open_their_own_connections() -> None:
    ended, out, err = script(FORKS, server(worlds=3).instance).end()
    assert (ended, out) == (0, "{0} []\n"), err


def test_open_objects_cannot_be_copied() -> None:
    client = server().connect()
    for copied in (pickle.dumps, copy.deepcopy):
        with pytest.raises(TypeError, match="cannot pickle"):
            copied(client)


#: Environments, each with the action that is repeated in all steps.
SHARED: dict[str, tuple[Callable[[], Any], Any]] = {
    "path": (make, np.array([1, 3, 1, 3])),
    "moves": (lambda: make_vec(3, MOVES, observation=("belief", "local")), np.array([3, 1, 0])),
    "team": (
        lambda: closed_later(emberwatch.parallel_env(robots=2, max_episode_steps=None, **SMALL)),
        {"robot_0": 1, "robot_1": 3},
    ),
}


@contextmanager
def repeated(call: Callable[[], object]) -> Iterator[None]:
    """Repeats a call on another thread meanwhile, and fails the test if the call raises."""
    errors, is_over = list[BaseException](), threading.Event()

    def repeat() -> None:
        try:
            while not is_over.is_set():
                call()
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()
    assert not errors


@pytest.mark.parametrize("kind", SHARED)
def test_threads_that_step_one_environment_take_turns(kind: str) -> None:
    maker, action = SHARED[kind]
    env, alone = maker(), maker()
    expected = [alone.reset(seed=1000), *(alone.step(action) for _ in range(80))]
    env.reset(seed=1000)
    steps = list[Any]()

    def step() -> None:
        for _ in range(20):
            steps.append(env.step(action))

    at_once(step, step, step, step)

    # The threads may append in any order.
    def moment(outcome: Any) -> str:
        return repr(outcome[-1]) + repr(outcome[0]) + repr(outcome[1])

    assert sorted(map(moment, steps)) == sorted(map(moment, expected[1:]))
    # A thread that resets waits for another thread's step.
    with repeated(lambda: env.step(action)):
        for _ in range(20):
            env.reset(seed=1000)
    first = [env.reset(seed=1001), *(env.step(action) for _ in range(8))]
    assert_same(first, [alone.reset(seed=1001), *(alone.step(action) for _ in range(8))])


def test_another_thread_can_read_masks_and_partial_paths() -> None:
    envs = make_vec(2, MOVES)
    envs.reset(seed=1000)
    flights = envs.unwrapped._flights

    def watch() -> None:
        assert envs.unwrapped.action_masks().shape == (2, 4)
        assert flights.visited.shape == (2, 7, 5) and flights.robots.shape == (2, 2)

    with repeated(watch):
        for _ in range(400):
            envs.step(envs.action_space.sample())


def test_a_forked_child_does_not_wait_for_a_thread_that_steps() -> None:
    env = make()
    env.reset(seed=1000)
    is_in, may_leave = threading.Event(), threading.Event()

    def hold() -> None:
        with env.unwrapped._session.turn:
            is_in.set()
            may_leave.wait()

    def step() -> None:
        with fails("forked"):
            env.step([1, 3, 1, 3])

    thread, child = threading.Thread(target=hold), get_context("fork").Process(target=step)
    thread.start()
    is_in.wait()
    child.start()
    child.join(60)
    assert child.exitcode == 0
    may_leave.set()
    thread.join()


def test_ctrl_c_ends_the_wait_for_another_thread() -> None:
    env, alone = make(), make()
    expected = rollout(alone, 3, seed=1000)
    env.reset(seed=1000)
    may_leave = threading.Event()

    def hold() -> None:
        with env.unwrapped._session.turn:
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
            may_leave.wait()

    thread = threading.Thread(target=hold)
    with pytest.raises(KeyboardInterrupt):
        thread.start()
        while True:
            env.reset(seed=1000)
    may_leave.set()
    thread.join()
    assert_same(rollout(env, 3, seed=1000), expected)
