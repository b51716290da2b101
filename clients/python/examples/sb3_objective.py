"""Stable-Baselines3's PPO in place of the paper's high-level decision.

Filter and planner stay in Rust; PPO sees a summary of the belief and chooses what the next path
is for. Compare with always choosing fire, which is hard to beat under the default model.

    python sb3_objective.py --total-steps 50000
"""

from __future__ import annotations

import argparse

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from emberwatch.sb3 import make_vec_env


def mean_reward(envs: VecEnv, choose, seed: int, n_steps: int) -> float:
    """The mean reward per step of as many worlds, from a seed on."""
    envs.seed(seed)
    observations = envs.reset()
    rewards = []
    for _ in range(n_steps):
        observations, reward, _, _ = envs.step(choose(observations))
        rewards.append(reward)
    return float(np.mean(rewards))


def main() -> None:
    """Trains, then compares with constant objectives on worlds that were not trained on."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--total-steps", type=int, default=50_000)
    parser.add_argument("--worlds", type=int, default=8)
    parser.add_argument("--evaluation-steps", type=int, default=500, help="of each world")
    parser.add_argument("--seed", type=int, default=1000)
    args = parser.parse_args()

    envs = make_vec_env("emberwatch/WildfireObjective-v0", args.worlds, max_episode_steps=500)
    model = PPO(
        "MlpPolicy",
        VecMonitor(envs),
        seed=args.seed,
        n_steps=50,
        batch_size=100,
        gamma=0.9,
        verbose=1,
    )
    model.learn(args.total_steps)

    test_seed = 0  # seeds below 1000 are for tests
    policies = {
        f"always {name}": (lambda _, index=index: np.full(args.worlds, index))
        for index, name in enumerate(envs.get_attr("objectives")[0])
    }
    policies["PPO"] = lambda observations: model.predict(observations, deterministic=True)[0]
    for name, choose in policies.items():
        reward = mean_reward(envs, choose, test_seed, args.evaluation_steps)
        print(f"{name:15} {reward:6.2f} fires found a step")
    envs.close()


if __name__ == "__main__":
    main()
