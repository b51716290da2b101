"""Parameter sharing with SuperSuit and Stable-Baselines3: one policy flies all robots of a world.

    python supersuit_team.py --total-steps 500000 --robots 4 --out team

Without SuperSuit, `emberwatch.sb3.make_vec_env("emberwatch/WildfireMoves-v0", 64, robots=4)` gives
learners the same rows, and simulates all worlds together.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from typing import Any

from sb3_moves import Windows
from stable_baselines3 import PPO
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecMonitor, VecTransposeImage

import emberwatch
from emberwatch.benchmark import evaluate, summary

with warnings.catch_warnings(action="ignore"):  # SuperSuit imports deprecated wrappers
    import supersuit


def main() -> None:
    """Trains, then scores the team for the benchmark's table."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--total-steps", type=int, default=500_000, help="moves of all robots")
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--worlds", type=int, default=8)
    parser.add_argument("--grid", type=int, default=24, help="height and width in cells")
    parser.add_argument("--reward", default="marginal", choices=("share", "team", "marginal"))
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=Path("team"), help="output folder")
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
    team = emberwatch.parallel_env(reward=args.reward, max_episode_steps=800, **world)
    rows = supersuit.pettingzoo_env_to_vec_env_v1(team)
    envs = supersuit.concat_vec_envs_v1(rows, args.worlds, base_class="stable_baselines3")
    set_random_seed(args.seed)  # SuperSuit's environments draw their own seeds
    model = PPO(
        "CnnPolicy",
        VecMonitor(VecTransposeImage(envs)),
        policy_kwargs={"features_extractor_class": Windows},
        n_steps=32,
        batch_size=512,
        n_epochs=4,
        learning_rate=7e-4,
        gamma=0.95,
        gae_lambda=0.9,
        ent_coef=0.01,
        device="cpu",
        verbose=1,
    )
    model.learn(args.total_steps, log_interval=10)
    model.save(args.out / "ppo")
    envs.close()

    (args.out / "rows.csv").unlink(missing_ok=True)  # from an earlier training
    first, end = map(int, args.evaluate.split(".."))
    scores = evaluate(
        model,
        name=f"ppo_{args.reward}",
        deterministic=False,  # the most probable moves may run in circles
        seeds=range(first, end),
        steps=args.steps,
        csv=args.out / "rows.csv",
        **world,
    )
    print(summary(scores))
    print(f"visited twice: {sum(row.mean_repeated for row in scores) / len(scores):.0%}")


if __name__ == "__main__":
    main()
