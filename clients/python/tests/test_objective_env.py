"""`WildfireObjective-v1`: beliefs and plans in this process."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import environments
import golden_options
import gymnasium
import numpy as np
import oracle
import pytest
from environments import OBJECTIVE, assert_same, closed_later, rollout
from failures import fails, refuses
from processes import server

import emberwatch
from emberwatch import belief

GOLDEN = np.load(golden_options.FILE)


def make(**keywords: Any) -> Any:
    return environments.make(OBJECTIVE, **keywords).unwrapped


def make_vec(n_worlds: int = 3, **keywords: Any) -> Any:
    return environments.make_vec(n_worlds, OBJECTIVE, **keywords)


@pytest.fixture
def env() -> Any:
    return make()


def interrupted(*_: object) -> None:
    raise KeyboardInterrupt


def decide(env: Any) -> Any:
    """Steps with the first option. Returns k of one world or many."""
    return env.step(np.zeros(env.action_space.shape, int))[4]["step"]


def test_actions_and_features_have_names(env: Any) -> None:
    observation, _ = env.reset(seed=1000)
    assert env.action_space.n == len(env.objectives)
    assert observation.shape == (len(env.objectives), len(env.feature_names)) == (8, 26)
    for objective, row in zip(env.objectives, observation, strict=True):
        named = dict(zip(env.feature_names, row.tolist(), strict=True))
        assert [named[f"is_{name}"] for name in env.objectives].count(1.0) == 1
        assert named[f"is_{objective}"] == 1.0
        assert named["n_paths"] == named["last_reward"] == 0.0


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checkpoints")
    for name in ("learned_filter", "neural_belief"):
        (folder / name).write_bytes(GOLDEN[f"checkpoint {name}"].tobytes())
    return folder


def believing(name: str, checkpoints: Path) -> dict[str, Any]:
    keywords = dict(golden_options.BELIEFS[name])
    if "checkpoint" in keywords:
        keywords["checkpoint"] = checkpoints / keywords["checkpoint"]
    return {"prior": "simulated", **golden_options.WORLD, **keywords}


@pytest.mark.parametrize("name", golden_options.BELIEFS)
def test_episodes_equal_the_recorded_ones(name: str, checkpoints: Path) -> None:
    keywords = believing(name, checkpoints)
    env = make(**keywords)
    assert env.estimator == name.partition(",")[0]
    found = golden_options.episode(env)
    envs = make_vec(3, autoreset_mode="Disabled", max_episode_steps=4, **keywords)
    found |= {f"vector {key}": value for key, value in golden_options.episodes(envs).items()}
    for key, value in found.items():
        expected = GOLDEN[f"{name} {key}"]
        if name == "neural":  # the order of sums depends on the processor
            assert np.allclose(value, expected, rtol=1e-3, atol=1e-4), key
        else:
            assert_same(value, expected, key)


@pytest.mark.parametrize("name", ["known+spatial", "neural"])
@pytest.mark.parametrize("is_left", [True, False])
def test_the_next_agent_continues_from_the_same_belief(
    name: str, is_left: bool, checkpoints: Path
) -> None:
    """Resumes from the belief that was left, or from the frames that the server keeps."""
    flags = {"model": "wildfire-small", "height": 16, "width": 16, "moves": 16, "burn_in": 100}
    started = server(worlds=3, **flags)
    keywords = {"prior": "initial", **believing(name, checkpoints)}
    keywords = {
        key: keywords[key] for key in ("estimator", "checkpoint", "prior") if key in keywords
    }
    keywords |= {"instance": started.instance, "world": 1}
    first = make_vec(2, **keywords)
    first.reset(seed=1000)
    for choice in (0, 3, 6):
        seen, _, _, _, _ = first.step(np.array([choice, 7 - choice]))
    if is_left:
        first.close()
    with emberwatch.connect(started.instance) as client:
        assert (client.belief(1) is not None) == is_left
    second = make_vec(2, takeover=not is_left, **keywords)
    found, info = second.reset(options={"resume": True})
    assert info["step"].tolist() == [3, 3]
    assert_same(found, seen)


def test_a_checkpoint_that_does_not_fit_is_refused(checkpoints: Path, tmp_path: Path) -> None:
    model = tmp_path / "model.toml"
    model.write_text(oracle.with_fourth_observation(Path(environments.LIVELY).read_text()))
    for name in ("learned_filter", "neural_belief"):
        for maker in (make, make_vec):
            with refuses("checkpoint: expected the world's 4 observations, got 3"):
                maker(checkpoint=checkpoints / name, model=model)
    # An estimator that knows the model ignores learned filters.
    known = make(checkpoint=checkpoints / "learned_filter", estimator=belief.RECOMMENDED)
    assert np.array_equal(known.reset(seed=1000)[0], make().reset(seed=1000)[0])


def test_recorded_worlds_need_a_learned_belief(checkpoints: Path, tmp_path: Path) -> None:
    states = tmp_path / "lab.npy"
    np.save(states, np.random.default_rng(5).integers(0, 3, (30, 7, 9), np.uint8))
    text = re.sub(r"(observed_as = \[[^]]*)\]", r"\1, 0.0]", environments.RECORDED.read_text())
    third = '}, { name = "none", color = "#000000" }]'
    states.with_suffix(".toml").write_text(text.replace("}]", third))
    world = {"states": states, "n_moves": 4}
    learned = {"checkpoint": checkpoints / "learned_filter", **world}
    env: Any = closed_later(gymnasium.make(OBJECTIVE, **learned))
    env.reset(seed=1000)
    assert env.step(0)[4]["step"] == 1
    with refuses("model: expected a model for the estimator 'known.*'.*got recorded worlds"):
        gymnasium.make(OBJECTIVE, **world)


@pytest.mark.parametrize("maker", [make, make_vec])
def test_resume_after_an_unfinished_step_has_all_frames(
    maker: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = (maker() for _ in range(2))
    for env in (one, other):
        env.reset(seed=1000)
        decide(env)
    seen = other.step(np.zeros(other.action_space.shape, int))[0]
    with monkeypatch.context() as patched:
        # Interrupts after the world's step, before the belief's update.
        patched.setattr(one._plans, "update", interrupted)
        with pytest.raises(KeyboardInterrupt):
            decide(one)
    with fails("interrupted"):
        decide(one)
    found, info = one.reset(options={"resume": True})
    assert np.all(info["step"] == 2)
    assert_same(found, seen)


def test_a_hidden_model_must_be_passed() -> None:
    instance = server(reveal_model=False).instance
    with refuses("model: expected a model for the estimator 'known.*', or a checkpoint"):
        make(instance=instance)
    env = make(instance=instance, model="wildfire")
    env.reset(seed=1000)
    assert env.step(2)[4]["step"] == 1


def test_a_learned_belief_needs_no_revealed_model(checkpoints: Path) -> None:
    """Checks that features are the same as when the server reveals its model."""
    flags = {"model": "wildfire-small", "height": 16, "width": 16, "moves": 16, "sensor_radius": 1}
    shown = [server(**flags, **one).instance for one in ({}, {"reveal_model": False})]
    for name in ("learned_filter", "neural_belief"):
        envs = [make(instance=one, checkpoint=checkpoints / name) for one in shown]
        assert_same(*(rollout(env, 3, seed=5) for env in envs))
        for env in envs:
            env.close()


def test_a_checkpoint_is_read_once(checkpoints: Path, tmp_path: Path) -> None:
    kept, moved = checkpoints / "learned_filter", tmp_path / "checkpoint"
    moved.write_bytes(kept.read_bytes())
    flags = {"model": "wildfire-small", "height": 16, "width": 16, "n_moves": 16}
    envs = [make(checkpoint=one, **flags) for one in (kept, moved)]
    moved.write_bytes(b"changed")
    for _ in range(2):
        assert_same(*(rollout(env, 3, seed=5) for env in envs))
        for env in envs:
            env.close()


def test_wrong_keyword_values_are_refused() -> None:
    for keywords, words in (
        ({"estimator": "truth"}, 'estimator: expected one of known, .*, got "truth"'),
        ({"prior": "none"}, "prior: expected 'simulated', 'initial' or 'uniform', got 'none'"),
        ({"estimator": 3}, "estimator: expected a name, got 3"),
        ({"prior": None}, "prior: expected a name, got None"),
        ({"checkpoint": 3}, "checkpoint: expected text or a path, got 3"),
        ({"checkpoint": "no file"}, "checkpoint no file: No such file"),
        ({"estimator": "neural"}, "checkpoint.*of `train --learner neural`"),
    ):
        for maker in (make, make_vec):
            with refuses(words):
                maker(**keywords)
