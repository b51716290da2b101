"""`WildfireObjective-v1` and the agent behind it."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import environments
import gymnasium
import numpy as np
import pytest
from environments import (
    OBJECTIVE,
    agent_pid,
    assert_same,
    closed_later,
    impatient,
    private_pid,
    rollout,
)
from failures import fails, refuses
from gymnasium.utils.env_checker import check_env
from processes import eventually, server, stopped

import emberwatch
from emberwatch import errors
from emberwatch.programs import Program, find
from emberwatch.wrappers import BeliefObservation


def make(**keywords: Any) -> Any:
    return environments.make(OBJECTIVE, **keywords).unwrapped


def make_vec(n_worlds: int = 3, **keywords: Any) -> Any:
    return environments.make_vec(n_worlds, OBJECTIVE, **keywords)


@pytest.fixture
def env() -> Any:
    return make()


@pytest.fixture(params=[make, make_vec])
def any_env(request: pytest.FixtureRequest) -> Any:
    """One of one world, and one of many."""
    made = request.param()
    made.reset(seed=1000)
    return made


def decide(env: Any) -> Any:
    """Steps for the first state; returns k, of one world or many."""
    return env.step(np.zeros(env.action_space.shape, int))[4]["step"]


@pytest.mark.parametrize("keywords", [{}, {"truth": True}, {"estimator": "spatial_filter"}])
def test_gymnasium_accepts_it(keywords: dict[str, Any]) -> None:
    env = make(render_mode="rgb_array", **keywords)
    with environments.no_warnings():
        check_env(env, skip_render_check=True)
    picture = env.render()
    assert picture.dtype == np.uint8 and picture.ndim == 3


def test_actions_and_numbers_have_names(env: Any) -> None:
    observation, _ = env.reset(seed=1000)
    assert env.action_space.n == len(env.objectives)
    assert observation.shape == (len(env.objectives), len(env.feature_names)) == (8, 26)
    for objective, row in zip(env.objectives, observation, strict=True):
        named = dict(zip(env.feature_names, row.tolist(), strict=True))
        assert [named[f"is_{name}"] for name in env.objectives].count(1.0) == 1
        assert named[f"is_{objective}"] == 1.0
        assert named["n_paths"] == named["last_reward"] == 0.0
    observation, reward, *_ = env.step(0)
    named = dict(zip(env.feature_names, observation.T, strict=True))
    assert np.allclose(named["last_reward"], reward / 4)
    assert np.allclose(named["n_paths"], 1 / 200)


@pytest.mark.filterwarnings("ignore:.*is out of date")
def test_the_former_version_is_named() -> None:
    with pytest.raises(gymnasium.error.DeprecatedEnv, match="WildfireObjective-v1"):
        gymnasium.make("emberwatch/WildfireObjective-v0")


def trained(folder: Path, **world: object) -> Path:
    """The checkpoint of a filter that learned a little."""
    settings = folder / "agent.toml"
    settings.write_text("[learning]\nwindow = 4\nblock_windows = 2\nstreams = 4\n")
    flags = {"worlds": 2, "steps": 40, "config": settings, "out": folder / "out", "moves": 4}
    flags |= world
    command = [find("emberwatch-agent"), "train"]
    command += [f"--{name.replace('_', '-')}={flag}" for name, flag in flags.items()]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    return folder / "out" / "checkpoint.safetensors"


def test_a_checkpoint_brings_its_filter(tmp_path: Path) -> None:
    checkpoint = trained(tmp_path, height=7, width=5, burn_in=50, model=environments.LIVELY)
    learned = make(checkpoint=checkpoint)
    seen, _ = learned.reset(seed=1000)
    assert learned._agent.info.estimator == "learned_filter"
    assert not np.array_equal(seen, make().reset(seed=1000)[0])
    spatial = make_vec(checkpoint=str(checkpoint), estimator="learned_spatial_filter")
    spatial.reset(seed=1000)
    decide(spatial)
    known = make(checkpoint=checkpoint, estimator="known_model")
    assert np.array_equal(known.reset(seed=1000)[0], make().reset(seed=1000)[0])
    with fails("program", match="estimator learned_own_filter: expected a checkpoint of such a"):
        make(checkpoint=checkpoint, estimator="learned_own_filter").reset()
    with fails("program", match="no file"):
        make(checkpoint=tmp_path / "no file").reset()


def test_recorded_worlds_are_decided_for_on_a_learned_belief(tmp_path: Path) -> None:
    states = tmp_path / "lab.npy"
    np.save(states, np.random.default_rng(5).integers(0, 3, (30, 7, 9), np.uint8))
    states.with_suffix(".toml").write_bytes(environments.RECORDED.read_bytes())
    checkpoint = trained(tmp_path, states=states)
    world = {"states": states, "n_moves": 4}
    env: Any = closed_later(gymnasium.make(OBJECTIVE, checkpoint=checkpoint, **world))
    env.reset(seed=1000)
    assert env.step(0)[4]["step"] == 1
    with fails("program", match="recorded worlds, without a model"):
        closed_later(gymnasium.make(OBJECTIVE, **world)).reset()


def test_the_same_seed_and_decisions_give_the_same_episode(env: Any) -> None:
    first, again, other = (rollout(one, 6, seed=1003) for one in (env, env, make()))
    assert_same(first, again)
    assert_same(first, other)


def test_the_world_is_that_of_wildfire_with_the_same_seed() -> None:
    worlds = [make(truth=True), environments.make(truth=True)]
    counts = [[seen[-1]["n_target_cells"] for seen in rollout(one, 4, seed=3)] for one in worlds]
    assert counts[0] == counts[1]


def test_a_resume_does_not_wait_for_the_end_of_a_server_that_runs(
    any_env: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(Program, "exit_code")  # which waits for it
    _, info = any_env.reset(options={"resume": True})
    assert np.all(info["step"] == 0)


def test_two_agents_of_their_own_do_not_share_a_world(env: Any) -> None:
    env.reset(seed=1000)
    env.step(2)
    for takeover in (False, True):
        other = make(instance=env.instance, takeover=takeover)
        with fails("program", match="served already, by pid"):
            other.reset(seed=1001)
    assert env.step(2)[4]["step"] == 2


def test_a_stopped_agent_is_a_timeout_and_the_next_step_asks_for_a_reset(any_env: Any) -> None:
    with (
        stopped(agent_pid(any_env)),
        impatient(any_env, 0.5),
        pytest.raises(errors.RequestTimeoutError, match=r"within 0\.5 s"),
    ):
        decide(any_env)
    with fails("closed", match="an earlier step or reset timed out"):
        decide(any_env)
    _, info = any_env.reset(options={"resume": True})
    assert np.all(decide(any_env) == info["step"] + 1)


def test_a_lease_lost_between_steps_is_told_as_that() -> None:
    started = server(lease_millis=3000)
    env = make(instance=started.instance)
    env.reset(seed=1000)
    started.connect().acquire(takeover=True, ttl=3600)
    # The agent finds out when it renews its lease, and ends.
    assert eventually(lambda: env._agent._own_agent.exit_code() is not None)
    with pytest.raises(errors.LeaseLostError, match="lease lost"):
        env.step(0)


def test_truth_is_not_waited_for_longer_than_the_timeout() -> None:
    started = server(publish_truth=True)
    env = make(instance=started.instance, truth=True)
    _, info = env.reset(seed=1000)
    assert info["truth"].shape == (5, 7)
    with pytest.raises(errors.RequestTimeoutError):
        env._session._truth.at([(9, 9, 9)], 0.2)


def test_a_hidden_model_must_be_given() -> None:
    instance = server(reveal_model=False).instance
    with refuses("model: expected one"):
        make(instance=instance)
    env = make(instance=instance, model="wildfire")
    env.reset(seed=1000)
    assert env.step(2)[4]["step"] == 1


@pytest.mark.parametrize("action", [8, [0, 1, 8], "fire"])
def test_a_wrong_action_is_refused_and_nothing_is_sent(any_env: Any, action: object) -> None:
    with refuses("action: expected"):
        any_env.step(action)
    assert np.all(decide(any_env) == 1)


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        (
            {"estimator": "neural_belief"},
            "checkpoint: expected the file that a training has saved, for estimator='neural",
        ),
        ({"estimator": "truth"}, "expected one of None, known_model, .*, got 'truth'"),
        ({"prior": "none"}, "expected one of simulated, initial, uniform"),
        ({"agent": "other"}, "expected one of own, running"),
        ({"agent": "running"}, "expected instance="),
        (
            {"agent": "running", "instance": "lab", "checkpoint": "a.safetensors"},
            "checkpoint: expected none, as the agent runs already, got 'a.safetensors'",
        ),
    ],
)
@pytest.mark.parametrize("maker", [make, make_vec])
def test_a_wrong_keyword_is_refused(maker: Any, keywords: dict[str, Any], words: str) -> None:
    with refuses(words):
        maker(**keywords)


def test_more_worlds_than_frames_are_kept_of_are_not_drawn() -> None:
    with refuses("expected at most 64 worlds, got 65"):
        make_vec(65, render_mode="rgb_array")


def test_a_reset_that_finds_agent_or_server_dead_starts_others(any_env: Any) -> None:
    expected = any_env.reset(seed=1000)
    for _ in range(2):
        os.kill(agent_pid(any_env), signal.SIGKILL)
        assert np.array_equal(any_env.reset(seed=1000)[0], expected[0])
        os.kill(private_pid(any_env), signal.SIGKILL)
        assert np.array_equal(any_env.reset(seed=1000)[0], expected[0])
    os.kill(agent_pid(any_env), signal.SIGKILL)
    with pytest.raises(errors.ServerGoneError):
        any_env.reset(options={"resume": True})


def test_an_agent_that_is_killed_is_noticed_and_a_reset_starts_another(any_env: Any) -> None:
    os.kill(agent_pid(any_env), signal.SIGKILL)
    with pytest.raises(errors.ServerGoneError, match="the agent on instance"):
        decide(any_env)
    any_env.reset(seed=1000)
    assert np.all(decide(any_env) == 1)


def test_a_server_that_is_killed_ends_the_agent_with_a_word(any_env: Any) -> None:
    os.kill(private_pid(any_env), signal.SIGKILL)
    with pytest.raises(errors.ServerGoneError, match="the server on instance"):
        decide(any_env)
    any_env.reset(seed=1000)


def test_it_attaches_to_a_running_server_and_to_a_running_agent(env: Any) -> None:
    env.reset(seed=1000)
    env.step(2)
    with fails("invalid_argument", match="estimator: expected that of the running agent"):
        make(instance=env.instance, agent="running", estimator="spatial_filter").reset(seed=1)
    guest = make(instance=env.instance, agent="running", estimator="known_model")
    _, info = guest.reset(options={"resume": True})
    assert info["step"] == 1
    guest.step(2)
    guest.close()
    assert env.step(3)[4]["step"] == 3


def test_many_worlds_attach_to_a_running_agent_of_theirs() -> None:
    started = server(worlds=4)
    flags = ["--instance", started.instance, "--world", "1", "--worlds", "3", "--prior", "initial"]
    agent = Program("emberwatch-agent", ["serve-decisions", *flags])
    arguments = {"instance": started.instance, "world": 1, "agent": "running"}
    envs = make_vec(**arguments)
    envs.reset(seed=1000)
    decide(envs)
    with emberwatch.Decisions(started.instance, 1) as decisions:
        assert (decisions.worlds, decisions.info.estimator) == (range(1, 4), "known_model")
        assert decisions.features(decisions.last()).shape == (3, 8, 26)
        assert [made.step for made in decisions.decide([2, None, np.int64(1)])] == [2, 1, 2]
        assert [made.objective for made in decisions.reset([7], worlds=[3])] == [2, 0, None]
        assert [made.seed for made in decisions.last()] == [1000, 1001, 7]
        with fails("bad_objective", match="expected 0 to 7, got 9 for world 2") as refused:
            decisions.decide([2, 9, 2])
        assert refused.value.detail == 8
        with fails("malformed", match="objectives: expected 3, one a world, got 1"):
            decisions.decide([2])
        for wrong in (1.5, -1, "fire", True, 2**64, [0, 1]):
            with fails("invalid_argument", match="expected one integer, 0 to"):
                decisions.decide([2, wrong, 2])
        with fails("invalid_argument", match="seeds: expected 3, got 2"):
            decisions.reset([7, 8])
        with fails("no_such_world", match="the agent has worlds 1 to 3, got 0"):
            decisions.reset([7], worlds=[0])
        assert [made.step for made in decisions.last()] == [2, 1, 0]
    _, info = envs.reset(options={"resume": True})
    assert info["step"].tolist() == [2, 1, 0]
    envs.close()
    for n_worlds in (2, 1):
        other = make_vec(n_worlds, **arguments)
        words = f"expected one of worlds 1 to {n_worlds}, got one of 1 to 3"
        with refuses(words):
            other.reset(seed=1000)
    agent.stop()


def test_another_world_has_no_agent(env: Any) -> None:
    env.reset(seed=1000)
    with pytest.raises(errors.NoServerError, match="no agent serves decisions of world 7"):
        emberwatch.Decisions(env.instance, 7)


def test_a_world_that_is_taken_over_ends_the_agent(env: Any) -> None:
    env.reset(seed=1000)
    with emberwatch.connect(env.instance) as client:
        client.acquire(takeover=True)
        with pytest.raises(errors.LeaseLostError, match="lease lost to pid"):
            env.step(0)


def test_a_busy_world_is_refused_with_the_agents_own_words() -> None:
    env = environments.make().unwrapped
    env.reset(seed=1000)
    other = make(instance=env.instance)
    with fails("program", match="busy: held by pid"):
        other.reset()


def test_beliefs_start_from_the_programs_prior() -> None:
    env = BeliefObservation(environments.make(), prior="simulated")
    belief, _ = env.reset(seed=1000)
    assert belief.shape == (3, 7, 5)
    assert np.allclose(belief.sum(0), 1.0) and (belief > 0).all()
