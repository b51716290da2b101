"""Stable-Baselines3's DQN on `emberwatch/WildfireMoves-v0`, without a wrapper.

python sb3_moves.py --total-steps 50000
"""

from __future__ import annotations

import argparse

import gymnasium
from stable_baselines3 import DQN
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

import emberwatch  # noqa: F401  (registers the environments)


def main() -> None:
    """Trains, then evaluates on worlds that were not trained on."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--total-steps", type=int, default=50_000, help="moves")
    parser.add_argument("--grid", type=int, default=40, help="height and width, cells")
    parser.add_argument("--seed", type=int, default=1000)
    args = parser.parse_args()

    env = Monitor(
        gymnasium.make(
            "emberwatch/WildfireMoves-v0",
            reward="move",
            height=args.grid,
            width=args.grid,
            max_episode_steps=64 * 50,
        )
    )
    model = DQN(
        "MultiInputPolicy",  # a convolutional network for the images, one-hot robot and move
        env,
        seed=args.seed,
        buffer_size=5_000,
        learning_starts=500,
        train_freq=8,
        exploration_fraction=0.3,
        verbose=1,
    )
    model.learn(args.total_steps, log_interval=1)
    model.get_env().seed(0)  # seeds below 1000 are for tests
    mean, spread = evaluate_policy(model, model.get_env(), n_eval_episodes=1)
    print(f"reward of an episode of 50 paths: {mean:.1f} +- {spread:.1f}")
    env.close()


if __name__ == "__main__":
    main()
