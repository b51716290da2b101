"""The states of an environment's session, and the effects of step, resume and reset in each."""

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import pytest
from environments import closed_later, make, rollout, small_server
from processes import Server

from emberwatch.envs.session import State
from emberwatch.errors import EmberwatchError, TrainingOnTestWorldsWarning

PATH = [1, 3, 1, 3]


def interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def interrupted(owner: object, name: str, call: Callable[[], object]) -> None:
    with pytest.MonkeyPatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(owner, name, interrupt)
        call()


def begun(env: Any) -> None:
    """Interrupts a step before its request."""
    interrupted(env._session, "step", lambda: env.step(PATH))


def moved(env: Any) -> None:
    """Interrupts a step after its answer."""
    interrupted(env, "_take", lambda: env.step(PATH))


def torn(env: Any) -> None:
    """Interrupts a step, and then the reset."""
    begun(env)
    interrupted(env._session, "_settle", lambda: env.reset(seed=2))


#: How each state is reached from READY.
REACHED: dict[State, Callable[[Any], object]] = {
    State.CLOSED: lambda env: env.close(),
    State.READY: lambda env: None,
    State.BEGUN: begun,
    State.MOVED: moved,
    State.TORN: torn,
}

#: The results of a step and of a resume in each state: an error's code, or the world's step.
OUTCOMES: dict[State, tuple[str | int, str | int]] = {
    State.CLOSED: ("closed", "invalid_argument"),
    State.READY: (3, 2),
    State.BEGUN: ("interrupted", 2),
    State.MOVED: ("interrupted", 3),
    State.TORN: ("interrupted", 2),
}


@pytest.fixture
def env() -> Any:
    made = make().unwrapped
    rollout(made, 2, seed=1)
    return made


@pytest.fixture
def started() -> Iterator[Server]:
    yield small_server(robots=2, max_steps=3)


def outcome(call: Callable[[], Any]) -> str | int:
    """Returns the code of an error, or the step in the info."""
    try:
        return call()[-1]["step"]
    except EmberwatchError as error:
        return error.code


def resume(env: Any) -> str | int:
    return outcome(lambda: env.reset(options={"resume": True}))


def step(env: Any) -> str | int:
    return outcome(lambda: env.step(PATH))


@pytest.mark.parametrize("state", OUTCOMES, ids=lambda state: state.value)
def test_each_state_allows_its_calls(env: Any, state: State) -> None:
    for n, call in enumerate((step, resume)):
        rollout(env, 2, seed=1)
        REACHED[state](env)
        assert env._session._state is state
        assert call(env) == OUTCOMES[state][n]
        # A refused step has changed nothing, and a resume allows steps again.
        expected = State.READY if isinstance(OUTCOMES[state][n], int) else state
        assert env._session._state is expected
    for fails_first in (False, True):
        REACHED[state](env)
        if fails_first:
            step(env)
        assert env.reset(seed=1)[1]["step"] == 0
        assert step(env) == 1


def test_only_a_holder_of_all_robots_resets_a_finished_world(started: Server) -> None:
    env = make(instance=started.instance, robot=0).unwrapped
    env.reset()
    assert [step(env) for _ in range(3)] == [1, 2, 3]
    assert [step(env), env._session._state] == ["episode_over", State.READY]
    assert [resume(env), env._session._state] == ["episode_over", State.OVER]
    assert [step(env), resume(env), step(env)] == ["episode_over"] * 3
    env.close()
    with started.connect().acquire(0, 2) as lease:
        lease.reset()
    assert [resume(env), step(env)] == [0, 1]


def test_a_lone_robot_is_never_late(env: Any) -> None:
    lease = env._session.lease
    before = lease.client.clone_state()
    lease.step(PATH)
    after = lease.client.clone_state()
    lease.client.restore_state(before)
    lease.observe()
    lease.client.restore_state(after)  # the world moved without this lease's path
    assert step(env) == "late"
    assert step(env) == "interrupted"
    assert [resume(env), step(env)] == [3, 4]


def test_a_resume_shows_nothing_that_a_learner_wrote() -> None:
    env = make(observation=("frame", "robot")).unwrapped
    env.reset(seed=1)
    seen = env.step(PATH)[0]
    kept = {name: part.copy() for name, part in seen.items()}
    for part in seen.values():
        part[...] = 77
    again, _ = env.reset(options={"resume": True})
    assert (again["robot"] == kept["robot"]).all() and (again["frame"] == kept["frame"]).all()


def test_a_warning_raised_as_an_error_changes_no_state() -> None:
    env = closed_later(gymnasium.make("emberwatch/WildfireSmall-v0").unwrapped)
    env.reset(seed=1000)
    with warnings.catch_warnings(), pytest.raises(TrainingOnTestWorldsWarning):
        warnings.simplefilter("error")
        env.reset(seed=1)
    assert env.step(env.action_space.sample())[4]["step"] == 1
