"""Models of Stable-Baselines3 score the same in `evaluate` as in their own evaluation."""

from pathlib import Path
from typing import Any

import pytest
from benchmarks import WORLDS, wall
from environments import MOVES
from failures import refuses

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

import sb3_contrib
import stable_baselines3
from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_masked
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecFrameStack, VecMonitor, VecNormalize

from emberwatch.benchmark import evaluate
from emberwatch.sb3 import make_vec_env

N_MOVES, N_STEPS, N_WORLDS, FIRST = 4, 10, 4, 1000

SMALL = {"n_steps": 16, "batch_size": 32, "n_epochs": 1, "learning_rate": 3e-3, "device": "cpu"}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return {**WORLDS, "model": wall(tmp_path_factory.mktemp("model"))}


def vector(world: dict[str, Any], seed: int, wrap: Any = None, **changes: Any) -> Any:
    """Makes worlds with seeds from `seed`, as for training or evaluation."""
    keywords = {"observation": "local", "max_episode_steps": N_MOVES * N_STEPS, **changes}
    made = make_vec_env(MOVES, N_WORLDS, **world, **keywords)
    made.seed(seed)
    return made if wrap is None else wrap(made)


def trained(algorithm: Any, policy: str, world: Any, wrap: Any, **changes: Any) -> Any:
    worlds = vector(world, 5000, wrap, reward="move", **changes)
    return algorithm(policy, VecMonitor(worlds), seed=3, **SMALL).learn(128)


def own(model: Any, worlds: Any, evaluation: Any = evaluate_policy) -> Any:
    """Evaluates with the trainer's own function. Returns each world's mean reward per step."""
    options = {"deterministic": True, "return_episode_rewards": True, "warn": False}
    rewards, lengths = evaluation(model, worlds, n_eval_episodes=N_WORLDS, **options)
    worlds.close()
    assert lengths == [N_MOVES * N_STEPS] * N_WORLDS
    return [reward / N_STEPS for reward in rewards]


def ours(model: Any, world: dict[str, Any], **changes: Any) -> list[float]:
    keywords = {"observation": "local", "steps": N_STEPS, "progress": None, **world, **changes}
    seeds = range(FIRST, FIRST + N_WORLDS)
    return [row.mean_reward for row in evaluate(model, name="mine", seeds=seeds, **keywords)]


def check(model: Any, expected: list[float], world: dict[str, Any], **changes: Any) -> None:
    assert ours(model, world, **changes) == pytest.approx(expected, abs=1e-6)
    assert len(set(expected)) > 1, "worlds that tell policies apart"


def stacked(worlds: Any) -> Any:
    return VecFrameStack(worlds, 2)


def test_maskable_ppo_behind_wrappers_scores_as_in_its_own(world: dict[str, Any]) -> None:
    model = trained(sb3_contrib.MaskablePPO, "MlpPolicy", world, stacked)
    worlds = vector(world, FIRST, stacked)
    expected = own(model, worlds, evaluate_masked)
    check(model, expected, world, wrap=stacked)
    unmasked = ours(lambda seen: model.predict(seen, deterministic=True)[0], world, wrap=stacked)
    assert unmasked != expected


def normalized(worlds: Any) -> Any:
    return VecNormalize(worlds, norm_reward=False)


def test_a_model_behind_vec_normalize_scores_as_in_its_own(
    world: dict[str, Any], tmp_path: Path
) -> None:
    parts: dict[str, Any] = {"observation": ("frame", "local")}
    model = trained(stable_baselines3.PPO, "MultiInputPolicy", world, normalized, **parts)
    file, trained_on = tmp_path / "statistics.pkl", model.get_vec_normalize_env()
    trained_on.save(str(file))
    worlds = VecNormalize.load(str(file), vector(world, FIRST, **parts))
    worlds.training = False
    expected = own(model, worlds)
    model.save(tmp_path / "model.zip")
    loaded = stable_baselines3.PPO.load(tmp_path / "model.zip", device="cpu")
    for policy in (model, loaded):
        with refuses(r"policy: expected the .*VecNormalize.load\('statistics.pkl', worlds\)"):
            ours(policy, world, **parts)
    kept: list[Any] = []

    def wrap(worlds: Any) -> Any:
        kept.append(VecNormalize.load(str(file), worlds))
        return kept[-1]

    check(loaded, expected, world, wrap=wrap, **parts)
    assert kept[-1].obs_rms["local"].count == trained_on.obs_rms["local"].count
    for wrong, words in (
        (normalized, "wrap: VecNormalize has no statistics: save the training's statistics"),
        (VecMonitor, "policy: expected the observations that it was trained on, .* wrap=, such as"),
        (lambda _: None, "wrap: expected a function that returns its argument in VecEnvWrappers"),
    ):
        with refuses(words):
            ours(model, world, wrap=wrong, **parts)
