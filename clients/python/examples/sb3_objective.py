r"""Replaces the paper's high-level decision with Stable-Baselines3's DQN.

Belief and plans stay in Rust. The DQN sees the features of eight plans and chooses the plan to fly.
One small network scores every plan from its features, so that all plans share the weights. The
choice matters on `burnout` and `latent`. On the belief of a learned filter:

    emberwatch-agent train --learner filter --steps 12000 --model wildfire-latent --moves 12 \
        --burn-in 6000 --out filter
    python sb3_objective.py --checkpoint filter/checkpoint.safetensors

`emberwatch-agent compare --policies learned/options/exploit,learned/options/entropy` scores plans
alone on the same test worlds.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor
from stable_baselines3.dqn.policies import DQNPolicy, QNetwork
from torch import nn

from emberwatch.sb3 import make_vec_env

#: Scales rewards to about one for the learner.
REWARD_SCALE = 0.1


class Scores(nn.Module):
    """Scores each plan from its features, with the same network for all plans."""

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
    """Multiplies rewards by `REWARD_SCALE` for the learner."""

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, done, infos = self.venv.step_wait()
        return observations, REWARD_SCALE * rewards, done, infos


def mean_rewards(envs: VecEnv, choose: Any, seed: int, n_steps: int) -> NDArray[np.float64]:
    """Returns the mean reward per step of each world, whose first episode has `seed`."""
    envs.seed(seed)
    observations, total = envs.reset(), np.zeros(envs.num_envs)
    for _ in range(n_steps):
        observations, rewards, _, _ = envs.step(choose(observations))
        total += rewards
    return total / n_steps


def compare(envs: VecEnv, model: DQN, n_steps: int) -> None:
    """Scores the learned choice, a random choice, and always exploiting, on the same worlds."""
    n_plans, rng = envs.action_space.n, np.random.default_rng(0)
    policies: dict[str, Any] = {
        "DQN": lambda seen: model.predict(seen, deterministic=True)[0],
        "random": lambda seen: rng.integers(n_plans, size=len(seen)),
        "exploit": lambda seen: np.zeros(len(seen), int),
    }
    found = {name: mean_rewards(envs, act, 0, n_steps) for name, act in policies.items()}
    for name, rewards in found.items():
        more = found["DQN"] - rewards
        errors = np.array([rewards.std(ddof=1), more.std(ddof=1)]) / np.sqrt(len(rewards))
        print(
            f"{name:8} {rewards.mean():6.2f} ± {errors[0]:.2f} a step; "
            f"the DQN finds {more.mean():+.2f} ± {errors[1]:.2f} more"
        )


def learner(envs: VecEnv, seed: int) -> DQN:
    """Returns a DQN with decaying learning rate and exploration, and one update per 8 decisions."""
    updates = max(1, envs.num_envs // 8)
    return DQN(
        ScoringPolicy,
        ScaledRewards(VecMonitor(envs)),
        seed=seed,
        learning_rate=lambda left: 1e-3 * max(0.1, left),
        buffer_size=120_000,
        batch_size=256,
        learning_starts=3_000,
        train_freq=1,
        gradient_steps=updates,
        n_steps=4,
        gamma=0.97,
        tau=0.005 * updates,
        target_update_interval=envs.num_envs,
        exploration_initial_eps=0.5,
        exploration_fraction=0.5,
        verbose=1,  # prints the mean reward of an episode
    )


def main() -> None:
    """Trains a DQN, then compares it with simple choices on test worlds."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--checkpoint", help="of a learned filter; None: the known model")
    parser.add_argument("--model", default="wildfire-latent")
    parser.add_argument("--moves", type=int, default=12)
    parser.add_argument("--burn-in", type=int, default=6_000)
    parser.add_argument("--worlds", type=int, default=32)
    parser.add_argument("--total-steps", type=int, default=64_000, help="training decisions")
    parser.add_argument("--out", help="file for the trained model")
    parser.add_argument("--test-worlds", type=int, default=64)
    parser.add_argument("--test-steps", type=int, default=300, help="steps per test world")
    parser.add_argument("--seed", type=int, default=1_000_000)
    args = parser.parse_args()

    torch.set_num_threads(1)
    world: dict[str, Any] = {
        "model": args.model,
        "n_moves": args.moves,
        "burn_in": args.burn_in,
        "timeout": 60.0,  # long, for busy machines
        "checkpoint": args.checkpoint,
    }
    name = "emberwatch/WildfireObjective-v1"
    # Episodes are long because a burn-in costs as much as hundreds of steps.
    envs = make_vec_env(name, args.worlds, max_episode_steps=1_000, **world)
    model = learner(envs, args.seed)
    model.learn(args.total_steps, log_interval=args.worlds)
    envs.close()
    if args.out is not None:
        model.save(args.out)
    # Test worlds have seeds below 1000.
    test = make_vec_env(name, args.test_worlds, max_episode_steps=args.test_steps + 1, **world)
    compare(test, model, args.test_steps)
    test.close()


if __name__ == "__main__":
    main()
