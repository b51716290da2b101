"""Stable-Baselines3's PPO on many worlds of `emberwatch/WildfireMoves-v0`, with local windows.

python sb3_moves.py --total-steps 500000 --out sb3 --evaluate 0..32

With `--robots 4 --reward marginal`, one policy flies all robots of a world, each of which sees the
belief from its own frames.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import gymnasium
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecMonitor
from torch import nn

from emberwatch.benchmark import evaluate, summary
from emberwatch.sb3 import make_vec_env


class Windows(BaseFeaturesExtractor):
    """A network for windows, which are too small for SB3's default convolutional network."""

    def __init__(self, space: gymnasium.spaces.Box) -> None:
        super().__init__(space, features_dim=128)
        self.layers = nn.Sequential(
            *(nn.Conv2d(space.shape[0], 24, 3, 2, 1), nn.ReLU()),
            *(nn.Conv2d(24, 32, 3, 2, 1), nn.ReLU(), nn.Flatten()),
        )
        n_features = self.layers(torch.zeros(1, *space.shape)).shape[1]
        self.last = nn.Sequential(nn.Linear(n_features, 128), nn.ReLU())

    def forward(self, windows: torch.Tensor) -> torch.Tensor:
        return self.last(self.layers(windows))


def main() -> None:
    """Trains, then scores the policy for the benchmark's table."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--total-steps", type=int, default=500_000, help="moves of all robots")
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--robots", type=int, default=1, help="robots in each world")
    parser.add_argument("--reward", default="move", help="with several robots: marginal, share ...")
    parser.add_argument("--grid", type=int, default=16, help="height and width in cells")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=Path("sb3"), help="output folder")
    parser.add_argument("--evaluate", default="5000..5008", help="seeds; test worlds: below 1000")
    parser.add_argument("--steps", type=int, default=100, help="evaluated paths per world")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)

    world: dict[str, Any] = {
        "model": "wildfire-small",
        "height": args.grid,
        "width": args.grid,
        "n_moves": 16,
        "burn_in": 3000,
        "observation": "local",
        "robots": args.robots,
    }
    envs = make_vec_env(
        "emberwatch/WildfireMoves-v0",
        args.worlds * args.robots,
        reward=args.reward,
        max_episode_steps=800,
        **world,
    )
    model = PPO(
        "CnnPolicy",
        VecMonitor(envs),
        policy_kwargs={"features_extractor_class": Windows},
        n_steps=32,
        batch_size=512,
        n_epochs=4,
        learning_rate=7e-4,
        gamma=0.95,
        gae_lambda=0.9,
        ent_coef=0.01,
        seed=args.seed,
        device="cpu",
        verbose=1,  # prints the mean reward of an episode
    )
    model.learn(args.total_steps, log_interval=10)
    model.save(args.out / "ppo")
    model.get_env().close()

    (args.out / "rows.csv").unlink(missing_ok=True)  # from an earlier training
    rows = evaluate(
        model,
        name="sb3_ppo",
        deterministic=False,  # the most probable moves may run in circles
        seeds=range(*map(int, args.evaluate.split(".."))),
        steps=args.steps,
        csv=args.out / "rows.csv",
        **world,
    )
    print(summary(rows))


if __name__ == "__main__":
    main()
