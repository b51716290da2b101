"""Stable-Baselines3's PPO on many worlds of `emberwatch/WildfireMoves-v0`, with local windows.

python sb3_moves.py --total-steps 500000 --out sb3 --evaluate 0..32
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import gymnasium
import matplotlib.pyplot as plt
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
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


class Curve(BaseCallback):
    """Writes moves and reward per path to a file, one row per rollout."""

    def __init__(self, file: Path, n_moves: int) -> None:
        super().__init__()
        self.file, self.n_moves = file, n_moves

    def _on_training_start(self) -> None:
        self.file.write_text("moves,reward_per_path\n")

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        reward = self.model.rollout_buffer.rewards.mean() * self.n_moves
        with self.file.open("a") as file:
            file.write(f"{self.num_timesteps},{reward}\n")


def draw(log: Path) -> None:
    """Plots the learning curve from the log."""
    rows = [tuple(map(float, line.split(","))) for line in log.read_text().splitlines()[1:]]
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    axes.plot(*zip(*rows, strict=True))
    axes.set(xlabel="moves", ylabel="reward per path, sampled moves")
    figure.savefig(log.with_name("curve.png"), dpi=120)


def main() -> None:
    """Trains, then scores the policy for the benchmark's table."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--total-steps", type=int, default=500_000, help="training moves")
    parser.add_argument("--worlds", type=int, default=64)
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
    }
    envs = make_vec_env(
        "emberwatch/WildfireMoves-v0", args.worlds, reward="move", max_episode_steps=800, **world
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
        verbose=1,
    )
    log = args.out / "log.csv"
    model.learn(args.total_steps, callback=Curve(log, world["n_moves"]), log_interval=10)
    model.save(args.out / "ppo")
    model.get_env().close()
    draw(log)

    (args.out / "rows.csv").unlink(missing_ok=True)  # from an earlier training
    first, end = map(int, args.evaluate.split(".."))
    rows = evaluate(
        model,
        name="sb3_ppo",
        deterministic=False,  # the most probable moves may run in circles
        seeds=range(first, end),
        steps=args.steps,
        csv=args.out / "rows.csv",
        **world,
    )
    print(summary(rows))


if __name__ == "__main__":
    main()
