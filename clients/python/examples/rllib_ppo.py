"""RLlib's PPO with several environment runners.

Each runner makes its own environment, which simulates its world in the runner's process. This
scales to many machines, which cannot share memory: use a Ray cluster and more runners.

    python rllib_ppo.py --iterations 20 --runners 2
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium
import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.tune.registry import register_env


def make(settings: dict[str, Any]) -> gymnasium.Env:
    """Makes the environment in the runner's process. RLlib expects flat observations."""
    import emberwatch  # noqa: F401  (registers the environments there)

    env = gymnasium.make("emberwatch/WildfireObjective-v1", **settings)
    return gymnasium.wrappers.FlattenObservation(env)


def main() -> None:
    """Trains, and prints the mean return of an episode."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--iterations", type=int, default=20)
    parser.add_argument("--runners", type=int, default=2)
    parser.add_argument("--batch", type=int, default=1000, help="steps per iteration")
    args = parser.parse_args()

    ray.init(include_dashboard=False, log_to_driver=False)
    register_env("wildfire-objective", make)
    config = (
        PPOConfig()
        .environment("wildfire-objective", env_config={"max_episode_steps": 250})
        .env_runners(num_env_runners=args.runners, num_cpus_per_env_runner=0.5)
        .training(train_batch_size=args.batch, minibatch_size=100, num_epochs=4, gamma=0.9)
        .debugging(seed=1000)
    )
    algorithm = config.build_algo()
    for iteration in range(args.iterations):
        runners = algorithm.train()["env_runners"]
        steps = runners["num_env_steps_sampled_lifetime"]
        pay = runners.get("episode_return_mean", float("nan"))
        print(f"iteration {iteration}: {steps} steps, reward of an episode {pay:.1f}", flush=True)
    algorithm.stop()
    ray.shutdown()


if __name__ == "__main__":
    main()
