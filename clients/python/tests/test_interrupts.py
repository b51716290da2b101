"""Ctrl-C, and signal handlers that raise, at every moment of a call to an environment."""

import gc
import sys
from collections.abc import Callable, Generator
from types import FrameType
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
    impatient,
    make,
    make_vec,
    small_server,
)
from failures import fails
from processes import at_once, ctrl_c, eventually, server

import emberwatch
from emberwatch.wrappers import BeliefObservation

#: Python itself reports and drops an interrupt while a generator ends, or in a callback of the
#: garbage collector that a test library installs.
pytestmark = pytest.mark.filterwarnings(
    "ignore:Exception ignored in:pytest.PytestUnraisableExceptionWarning"
)

PATH = ("frame", "robot", "age", "belief")
MOVE = ("frame", "visited", "robot", "move", "age", "belief", "local", "recent")

#: Environments of each kind. Their observations show everything that the environments remember.
KINDS: dict[str, Callable[[], Any]] = {
    "attached": lambda: make(
        instance=small_server(publish_truth=True).instance, observation=PATH, truth=True
    ),
    "moves": lambda: make(MOVES, observation=MOVE, reward="move"),
    "wrapped": lambda: closed_later(BeliefObservation(make(), keep=True)),
    "paths": lambda: make_vec(3, observation=PATH, max_episode_steps=2, autoreset_mode="SameStep"),
    "many moves": lambda: make_vec(2, MOVES, observation=MOVE, max_episode_steps=3),
    "team": lambda: closed_later(
        emberwatch.parallel_env(height=7, width=5, n_moves=4, burn_in=50, observation=MOVE)
    ),
    "objectives": lambda: make_vec(2, OBJECTIVE, max_episode_steps=3),
}

#: The errors that may refuse a step after an interrupt.
REFUSALS = emberwatch.EmberwatchError, gymnasium.error.ResetNeeded


class Alarm(Exception):
    """An exception that a signal handler may raise instead of `KeyboardInterrupt`."""


class Signal:
    """Raises where Python handles signals: at the n-th start of a function or end of a C call."""

    def __init__(self, n: int, kind: type[BaseException]) -> None:
        self.n_seen, self._n, self._kind = 0, n, kind

    def __call__(self, _frame: FrameType, event: str, _argument: object) -> None:
        if event in ("call", "c_return"):
            self.n_seen += 1
            if self.n_seen == self._n:
                sys.setprofile(None)
                raise self._kind


def places(call: Callable[[], object]) -> int:
    watched = Signal(0, Alarm)
    sys.setprofile(watched)
    try:
        call()
    finally:
        sys.setprofile(None)
    return watched.n_seen


def interrupted(call: Callable[[], object], n: int) -> BaseException | None:
    """Interrupts a call at the n-th signal check. Keeps the traceback, as notebooks do."""
    kind = (KeyboardInterrupt, Alarm)[n & 1]
    sys.setprofile(Signal(n, kind))
    try:
        call()
    except (kind, emberwatch.EmberwatchError) as error:
        return error
    finally:
        sys.setprofile(None)
    return None


def action(env: Any, seed: int) -> Any:
    agents: dict[str, Any] = getattr(env, "action_spaces", {})
    for space in agents.values() or [env.action_space]:
        space.seed(seed)
    if agents:
        return {agent: space.sample() for agent, space in agents.items()}
    return env.action_space.sample()


@pytest.fixture(autouse=True)
def no_garbage() -> Generator[None]:
    """Collects garbage of interrupted calls now, so that its errors do not fail another test."""
    yield
    gc.collect()


@pytest.fixture(params=KINDS)
def pair(request: pytest.FixtureRequest) -> tuple[Any, Any]:
    return KINDS[request.param](), KINDS[request.param]()


def begun(env: Any, n_steps: int = 3, seed: int = 1000) -> Any:
    """Returns an environment within an episode; for a vector, after an automatic reset."""
    env.reset(seed=seed)
    for k in range(n_steps):
        env.step(action(env, k))
    return env


def test_an_interrupted_step_is_never_mistaken_for_the_next(pair: tuple[Any, Any]) -> None:
    env, other = pair
    first, second = action(env, 10), action(env, 11)
    begun(other)
    n_places = places(lambda: other.step(first))
    lone, both = begun(other).step(second), (begun(other).step(first), other.step(second))[1]
    fresh = [other.reset(seed=5), other.step(first), other.step(second)]
    kept, n_refused = [], 0
    for n in range(1, n_places, max(1, n_places // 25)):
        begun(env)
        kept.append(interrupted(lambda: env.step(first), n))
        try:
            outcome = env.step(second)
        except REFUSALS as refusal:
            assert getattr(refusal, "code", "interrupted") == "interrupted"
            n_refused += 1
        else:
            assert_same(outcome, both if same(outcome, both) else lone)
        assert_same([env.reset(seed=5), env.step(first), env.step(second)], fresh)
    assert n_refused > 4  # of up to 25: waits poll at different rates


def test_any_reset_may_follow_an_interrupted_one(pair: tuple[Any, Any]) -> None:
    env, other = pair
    first = action(env, 10)
    begun(other)
    n_places = places(lambda: other.reset(seed=7))
    fresh = [other.reset(seed=5), other.step(first)]
    outcomes = [begun(other).step(first), (other.reset(seed=7), other.step(first))[1]]
    stood = resumed(begun(other))
    kept, n_refused = [], 0
    for n in range(1, n_places, max(1, n_places // 12)):
        begun(env)
        kept.append(interrupted(lambda: env.reset(seed=7), n))
        try:
            outcome = env.step(first)
        except REFUSALS:
            step = resumed(env)  # of the old episode, or of the new one
            n_refused += 1
            assert np.all((step == stood) | (step == 0))
        else:
            assert_same(outcome, outcomes[same(outcome, outcomes[1])])
        assert_same([env.reset(seed=5), env.step(first)], fresh)
    assert n_refused > 2


def resumed(env: Any) -> Any:
    """Returns the step at which an environment resumes, or one step per world."""
    _, info = env.reset(options={"resume": True})
    return np.asarray(info.get("robot_0", info)["step"])


def same(left: object, right: object) -> bool:
    try:
        assert_same(left, right)
    except AssertionError:
        return False
    return True


def test_an_interrupted_close_can_be_repeated() -> None:
    kept, started = [], small_server(publish_truth=True)
    for n in (1, 5, 20, 40, 80, 160):
        env = begun(make(instance=started.instance, truth=True))
        kept.append(interrupted(env.close, n))
        env.close()
        assert eventually(lambda: started.status().worlds[0].holder_pids == (None,))


def test_an_unfinished_step_requires_a_full_reset() -> None:
    envs = begun(make_vec(3, autoreset_mode="Disabled"))
    actions = action(envs, 1)
    assert interrupted(lambda: envs.step(actions), 20)
    with pytest.raises(
        gymnasium.error.ResetNeeded, match="expected all worlds in the first reset, or after"
    ):
        envs.reset(options={"reset_mask": np.array([True, False, False])})
    with fails("interrupted", match=r"did not finish .* reset\(options={'resume': True}\)"):
        envs.step(actions)
    envs.reset(options={"resume": True})
    envs.reset(options={"reset_mask": np.array([True, False, False])})


@pytest.mark.parametrize(("name", "seed"), [(WILDFIRE, 5), (OBJECTIVE, None)])
def test_a_reset_waits_for_an_interrupted_one(name: str, seed: int | None) -> None:
    started = server(burn_in=1_500_000)  # takes longer than the timeout below
    env = make(name, instance=started.instance)
    env.reset(seed=1)
    env.step(first := np.zeros(env.action_space.shape, int))
    with ctrl_c(lambda: eventually(lambda: started.status().worlds[0].resetting)):
        env.reset(seed=7)
    with impatient(env, 0.3):
        env.reset(seed=seed, options={"resume": True} if seed is None else None)
    assert started.status().worlds[0].seed == (seed or 7)
    assert env.step(first)[4]["step"] == 1


def test_ctrl_c_withdraws_a_path_that_waits_for_teammates() -> None:
    started = server(robots=2)
    env = closed_later(emberwatch.WildfireEnv(instance=started.instance, robot=0))
    env.reset()
    mate = started.connect().acquire(1)
    with ctrl_c(lambda: eventually(lambda: started.status().worlds[0].n_paths == 1)) as kept:
        env.step([1] * 6)
    with fails("interrupted"):
        env.step([3] * 6)
    env.reset()
    (_, _, _, _, info), _ = at_once(lambda: env.step([3] * 6), lambda: mate.step([3] * 6))
    assert kept is not None
    assert (info["step"], info["n_missed"]) == (1, 0)
    assert env._answer.result().robot.cell == (0, 6)
