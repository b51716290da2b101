"""RLlib's PPO on all robots of a world, which share one policy.

    python rllib_team.py --iterations 50 --robots 4

To train one policy per robot, name them all in `policies` and `policy_mapping_fn`.
"""

from __future__ import annotations

import argparse
import warnings
from typing import Any

import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env


def make(settings: dict[str, Any]) -> ParallelPettingZooEnv:
    """Makes the environment in the runner's process. Observations are flat windows from 0 to 1."""
    import emberwatch

    with warnings.catch_warnings(action="ignore"):  # SuperSuit imports deprecated wrappers
        import supersuit

    team = supersuit.dtype_v0(emberwatch.parallel_env(**settings), "float32")
    return ParallelPettingZooEnv(supersuit.flatten_v0(supersuit.normalize_obs_v0(team)))


def main() -> None:
    """Trains, and prints the team's mean return of an episode."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--iterations", type=int, default=50)
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--runners", type=int, default=2)
    parser.add_argument("--batch", type=int, default=4000, help="moves per iteration")
    parser.add_argument("--reward", default="share", choices=("share", "team", "marginal"))
    args = parser.parse_args()

    ray.init(include_dashboard=False, log_to_driver=False)
    register_env("wildfire-team", make)
    world = {"model": "wildfire-small", "height": 24, "width": 24, "n_moves": 16, "burn_in": 3000}
    world |= {"robots": args.robots, "reward": args.reward, "max_episode_steps": 240}
    config = (
        PPOConfig()
        .environment("wildfire-team", env_config=world)
        .multi_agent(policies={"robot"}, policy_mapping_fn=lambda *_, **__: "robot")
        .env_runners(num_env_runners=args.runners, num_cpus_per_env_runner=0.5)
        .training(train_batch_size=args.batch, minibatch_size=500, num_epochs=4, gamma=0.95)
        .debugging(seed=1000)
    )
    algorithm = config.build_algo()
    for iteration in range(args.iterations):
        runners = algorithm.train()["env_runners"]
        steps = runners["num_env_steps_sampled_lifetime"]
        pay = runners.get("episode_return_mean", float("nan"))
        print(f"iteration {iteration}: {steps} moves, reward of an episode {pay:.1f}", flush=True)
    algorithm.stop()
    ray.shutdown()


if __name__ == "__main__":
    main()
