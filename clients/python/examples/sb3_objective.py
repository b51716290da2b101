"""Stable-Baselines3's DQN in place of the paper's high-level decision.

Belief and plans stay in Rust; the DQN sees what each of eight plans promises and chooses the one that is
flown. One small network scores every plan by its own features, so that plans share what is learned.
Its choice pays where fires are rare and hidden, on the belief of a learned filter:

    emberwatch-agent train --learner filter --steps 12000 --model wildfire-latent --moves 12 --burn-in 6000 --out filter
    python sb3_objective.py --checkpoint filter/checkpoint.safetensors --minutes 15

On other worlds than those it learned on, the table has every plan alone beside it.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.dqn.policies import DQNPolicy, QNetwork
from torch import nn

from emberwatch.sb3 import make_vec_env

#: Rewards are learned in units of about one.
REWARD_SCALE = 0.1


class Scores(nn.Module):
    """A value for each plan, by one network of its features."""

    def __init__(self, n_plans: int, n_features: int, width: int = 64) -> None:
        super().__init__()
        self._shape = n_plans, n_features
        layers = [nn.Linear(n_features, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()]
        self._score = nn.Sequential(*layers, nn.Linear(width, 1))

    def forward(self, flat: torch.Tensor) -> torch.Tensor:
        return self._score(flat.unflatten(1, self._shape)).squeeze(-1)


class ScoringPolicy(DQNPolicy):
    """DQN's policy with `Scores` as its network."""

    def make_q_net(self) -> QNetwork:
        network = super().make_q_net()
        network.q_net = Scores(*self.observation_space.shape)
        return network.to(self.device)


class ScaledRewards(VecEnvWrapper):
    """Small rewards for the learner."""

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, done, infos = self.venv.step_wait()
        return observations, REWARD_SCALE * rewards, done, infos


class Progress(BaseCallback):
    """Prints the mean reward of each minute, and ends the training in time."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self._seconds = seconds
        self._rewards: list[float] = []

    def _on_training_start(self) -> None:
        self._start = self._told = time.monotonic()

    def _on_step(self) -> bool:
        self._rewards.append(float(self.locals["rewards"].mean()) / REWARD_SCALE)
        now = time.monotonic()
        if now - self._told > 60:
            self._told, reward = now, np.mean(self._rewards)
            self._rewards.clear()
            minutes = (now - self._start) / 60
            print(f"{minutes:5.1f} min, {self.num_timesteps:8} decisions: {reward:5.2f}", flush=True)
        return now - self._start < self._seconds


def mean_rewards(envs: VecEnv, choose: Any, seed: int, n_steps: int) -> NDArray[np.float64]:
    """The mean reward per step of each world, from a seed on."""
    envs.seed(seed)
    observations, total = envs.reset(), np.zeros(envs.num_envs)
    for _ in range(n_steps):
        observations, rewards, _, _ = envs.step(choose(observations))
        total += rewards
    return total / n_steps


def compare(envs: VecEnv, model: DQN, n_steps: int) -> None:
    """Scores the learned choice and each plan alone, on the same worlds."""
    names = envs.get_attr("objectives")[0]
    rng = np.random.default_rng(0)
    policies: dict[str, Any] = {
        "DQN": lambda seen: model.predict(seen, deterministic=True)[0],
        "random": lambda seen: rng.integers(len(names), size=len(seen)),
    }
    for index, name in enumerate(names):
        policies[name] = lambda seen, index=index: np.full(len(seen), index)
    found = {name: mean_rewards(envs, act, 0, n_steps) for name, act in policies.items()}
    for name, rewards in found.items():
        less = found["DQN"] - rewards
        error = np.sqrt(np.array([rewards.var(ddof=1), less.var(ddof=1)]) / len(rewards))
        print(
            f"{name:20} {rewards.mean():6.2f} ± {error[0]:.2f}, "
            f"less than the DQN by {less.mean():6.2f} ± {error[1]:.2f}"
        )


def learner(envs: VecEnv, seed: int) -> DQN:
    """A DQN on these worlds whose step size and exploration fall."""
    return DQN(
        ScoringPolicy,
        ScaledRewards(envs),
        seed=seed,
        learning_rate=lambda left: 1e-3 * max(0.1, left),
        buffer_size=120_000,
        batch_size=256,
        learning_starts=3_000,
        train_freq=1,
        gradient_steps=4,
        n_steps=4,
        gamma=0.97,
        tau=0.005,
        target_update_interval=1,
        exploration_initial_eps=0.5,
        exploration_fraction=0.5,
    )


def main() -> None:
    """Trains, then compares with constant choices on worlds that were not trained on."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--checkpoint", help="of a learned filter; the known model's without")
    parser.add_argument("--model", default="wildfire-latent")
    parser.add_argument("--moves", type=int, default=12)
    parser.add_argument("--burn-in", type=int, default=6_000)
    parser.add_argument("--worlds", type=int, default=32)
    parser.add_argument("--minutes", type=float, default=15.0, help="of training")
    parser.add_argument("--total-steps", type=int, default=400_000, help="decisions at most")
    parser.add_argument("--test-worlds", type=int, default=64)
    parser.add_argument("--test-steps", type=int, default=300, help="of each world")
    parser.add_argument("--seed", type=int, default=1_000_000)
    args = parser.parse_args()

    torch.set_num_threads(1)
    world: dict[str, Any] = {
        "model": args.model,
        "n_moves": args.moves,
        "burn_in": args.burn_in,
        "checkpoint": args.checkpoint,
    }
    name = "emberwatch/WildfireObjective-v1"
    envs = make_vec_env(name, args.worlds, max_episode_steps=300, **world)
    model = learner(envs, args.seed)
    model.learn(args.total_steps, callback=Progress(60 * args.minutes), log_interval=None)
    envs.close()
    # Seeds below 1000 are for tests.
    test = make_vec_env(name, args.test_worlds, max_episode_steps=args.test_steps + 1, **world)
    compare(test, model, args.test_steps)
    test.close()


if __name__ == "__main__":
    main()
