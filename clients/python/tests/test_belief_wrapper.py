"""The wrapper that observes beliefs, on a stub of the environment."""

from pathlib import Path
from typing import Any

import golden_options
import gymnasium
import numpy as np
import pytest
from failures import refuses
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from emberwatch.belief import RECOMMENDED, initial_prior, known, uniform_prior
from emberwatch.belief.prior import simulated_prior
from emberwatch.model import Model
from emberwatch.wrappers import BeliefObservation

WILDFIRE = Model.wildfire()
SHAPE = (4, 6)
GRID = {"height": 4, "width": 6}


class Stub(gymnasium.Env[Any, Any]):
    """An environment with random frames. With ``parts``, a frame is part of a Dict."""

    def __init__(self, *, parts: bool = False, model: Model | None = WILDFIRE, burn_in: int = 0):
        self.model, self.burn_in, self.parts = model, burn_in, parts
        self.action_space = spaces.MultiDiscrete([4] * 5)
        frame = spaces.Box(0, 255, (*SHAPE, 1), np.uint8)
        self.observation_space: spaces.Space[Any] = frame
        if parts:
            self.observation_space = spaces.Dict({"frame": frame, "robot": spaces.Discrete(24)})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return self.observe(np.full(SHAPE, 255, np.uint8)), {}

    def step(self, action: Any) -> Any:
        self.frame = self.np_random.integers(0, 3, SHAPE).astype(np.uint8)
        self.frame[self.np_random.random(SHAPE) < 0.7] = 255
        return self.observe(self.frame), 0.0, False, False, {}

    def observe(self, frame: NDArray[np.uint8]) -> Any:
        image = frame[:, :, None]
        return {"frame": image, "robot": np.int64(3)} if self.parts else image


gymnasium.register("test/Stub-v0", entry_point=f"{__name__}:Stub")


@pytest.mark.parametrize("kind", [None, "known"])
def test_a_reset_observes_the_prior_and_a_step_the_posterior(kind: str | None) -> None:
    stub = Stub()
    env = BeliefObservation(stub, kind=kind)
    for seed in (1, 2):
        observation, _ = env.reset(seed=seed)
        expected = known(WILDFIRE, prior=initial_prior(WILDFIRE, **GRID), kind=kind or RECOMMENDED)
        assert (observation == expected.belief).all()
        for _ in range(4):
            observation, *_ = env.step(env.action_space.sample())
            expected.predict()
            expected.correct(stub.frame)
            assert observation.dtype == np.float32
            assert (observation == expected.belief).all()
            assert (env.filter.belief == expected.belief).all()


def test_the_belief_follows_the_steps_of_the_world(monkeypatch: pytest.MonkeyPatch) -> None:
    stub, frame = Stub(), np.full((*SHAPE, 1), 255, np.uint8)
    frame[1, 2] = 2
    steps = iter([5, 5, 6, 6, 9])
    monkeypatch.setattr(stub, "reset", lambda **_: (frame, {"step": next(steps)}))
    monkeypatch.setattr(stub, "step", lambda _: (frame, 0.0, False, False, {"step": next(steps)}))
    env = BeliefObservation(stub)
    monkeypatch.setattr(stub, "past_frames", lambda: [frame[:, :, 0]] * 5, raising=False)
    env.reset()
    expected = known(WILDFIRE, prior=initial_prior(WILDFIRE, **GRID))
    for _ in range(5):
        expected.correct(frame[:, :, 0])
        expected.predict()
    expected.correct(frame[:, :, 0])
    for n_predictions in (0, 1, 0, 3):
        env.step(None)
        for _ in range(n_predictions):
            expected.predict()
        if n_predictions:
            expected.correct(frame[:, :, 0])
        assert (env.filter.belief == expected.belief).all()


@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version")
def test_it_passes_the_checker_and_can_keep_observations() -> None:
    for parts, keep, dtype, names in (
        (False, False, "float32", None),
        (True, False, "uint8", None),
        (False, True, "uint8", {"frame", "belief"}),
        (True, True, "float32", {"frame", "robot", "belief"}),
    ):
        made = gymnasium.make("test/Stub-v0", parts=parts)
        env: Any = BeliefObservation(made, keep=keep, dtype=dtype)  # pyright: ignore
        check_env(env, skip_render_check=True)
        observation, *_ = env.step(env.action_space.sample())
        if dtype == "uint8":
            image = observation["belief"] if keep else observation
            assert (image == np.rint(255 * env.filter.belief.transpose(1, 2, 0))).all()
        if names is not None:
            assert set(observation) == set(env.observation_space.spaces) == names
            assert (observation["frame"][:, :, 0] == env.unwrapped.frame).all()


def test_a_spec_makes_the_same_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stub, prior = gymnasium.make("test/Stub-v0"), uniform_prior(WILDFIRE, **GRID)
    env = BeliefObservation(stub, keep=True, dtype="uint8", prior=prior, model=WILDFIRE)
    again = gymnasium.make(env.spec)
    assert again.observation_space == env.observation_space
    assert (again.reset(seed=3)[0]["belief"] == env.reset(seed=3)[0]["belief"]).all()
    (tmp_path / "mine.toml").write_text(WILDFIRE.toml)
    monkeypatch.chdir(tmp_path)
    made = gymnasium.make("test/Stub-v0", model=None)
    named = BeliefObservation(made, prior="uniform", model="mine.toml")
    monkeypatch.chdir("/")
    text = named.spec.to_json()
    remade = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(text))
    assert (remade.reset()[0] == named.reset()[0]).all()


def test_priors_are_given_by_name_or_array() -> None:
    given = np.moveaxis(np.random.default_rng(0).dirichlet(np.ones(3), SHAPE), -1, 0)
    simulated = simulated_prior(WILDFIRE, **GRID, burn_in=50)
    for prior, expected in (
        ("initial", initial_prior(WILDFIRE, **GRID)),
        ("uniform", uniform_prior(WILDFIRE, **GRID)),
        ("simulated", simulated),
        (None, simulated),
        (given, given),
    ):
        observation, _ = BeliefObservation(Stub(burn_in=50), prior=prior).reset()
        np.testing.assert_allclose(observation, expected, rtol=0, atol=1e-6)
    for prior, expected in (("flat", "got 'flat'"), (given[:, :, 1:], "got .3, 4, 5.")):
        with pytest.raises(ValueError, match=f"prior: expected .*{expected}"):
            BeliefObservation(Stub(), prior=prior)
    with pytest.raises(ValueError, match=r"prior: belief of cell \(0, 0\)"):
        BeliefObservation(Stub(), prior=given * 2)


def test_a_hidden_model_must_be_passed() -> None:
    with pytest.raises(ValueError, match="does not reveal its model .* Pass model="):
        BeliefObservation(Stub(model=None))
    assert BeliefObservation(Stub(model=None), model=WILDFIRE).reset()[0].shape == (3, *SHAPE)
    with refuses("nowhere.toml"):
        BeliefObservation(Stub(), model="nowhere.toml")


def test_unsuitable_environments_are_refused() -> None:
    with pytest.raises(ValueError, match="a frame of shape"):
        BeliefObservation(gymnasium.make("CartPole-v1"), model=WILDFIRE)
    with pytest.raises(ValueError, match="dtype: expected 'float32' or 'uint8'"):
        BeliefObservation(Stub(), dtype="float64")
    with pytest.raises(gymnasium.error.ResetNeeded):
        BeliefObservation(Stub()).step(None)


def test_it_observes_the_belief_of_a_checkpoint(tmp_path: Path) -> None:
    checkpoint = tmp_path / "checkpoint"
    golden = np.load(golden_options.FILE)
    checkpoint.write_bytes(golden["checkpoint neural_belief"].tobytes())
    env = BeliefObservation(Stub(model=None), checkpoint=checkpoint)
    env.reset(seed=1)
    assert env.filter.kind == "neural" and env.step(None)[0] in env.observation_space
    with refuses("prior: expected None with a checkpoint"):
        BeliefObservation(Stub(), checkpoint=checkpoint, prior="uniform")
