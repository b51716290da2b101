"""Stable-Baselines3's PPO in place of the paper's high-level decision.

Filter and planner stay in Rust; PPO sees a summary of the belief and chooses what the next path
is for. Compare with always choosing fire, which is hard to beat under the default model.

    python sb3_objective.py --total-steps 50000
"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor

import emberwatch  # noqa: F401  (registers the environments)


def mean_reward(env: gymnasium.Env, choose, seed: int, n_steps: int) -> float:
    """The mean reward per step on one world."""
    observation, _ = env.reset(seed=seed)
    rewards = []
    for _ in range(n_steps):
        observation, reward, _, truncated, _ = env.step(choose(observation))
        rewards.append(reward)
        if truncated:
            break
    return float(np.mean(rewards))


def main() -> None:
    """Trains, then compares with constant objectives on a world that was not trained on."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--total-steps", type=int, default=50_000)
    parser.add_argument("--evaluation-steps", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1000)
    args = parser.parse_args()

    env = Monitor(gymnasium.make("emberwatch/WildfireObjective-v0", max_episode_steps=500))
    model = PPO("MlpPolicy", env, seed=args.seed, n_steps=500, batch_size=100, gamma=0.9, verbose=1)
    model.learn(args.total_steps)

    test_seed = 0  # seeds below 1000 are for tests
    policies = {
        f"always {name}": (lambda _, index=index: index)
        for index, name in enumerate(env.unwrapped.objectives)
    }
    policies["PPO"] = lambda observation: model.predict(observation, deterministic=True)[0]
    for name, choose in policies.items():
        reward = mean_reward(env, choose, test_seed, args.evaluation_steps)
        print(f"{name:15} {reward:6.2f} fires found a step")
    env.close()


if __name__ == "__main__":
    main()
