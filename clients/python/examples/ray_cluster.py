"""RLlib's PPO on several machines. The runners on each machine share one server.

Shared memory does not span machines, so each node of the cluster runs its own server. Each runner
leases a part of the server's worlds. Training survives the death of runners and servers.

    python ray_cluster.py --iterations 50                 # two nodes on this machine
    python ray_cluster.py --address auto --runners 30     # a running cluster
    python ray_cluster.py --kill                          # kills a runner, and later a server
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import threading
import uuid
from collections import defaultdict
from typing import Any

import gymnasium
import numpy as np
import ray
from gymnasium.wrappers.vector import TransformObservation
from ray.cluster_utils import Cluster
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.ppo import PPOConfig
from ray.tune.registry import register_env
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

import emberwatch
from emberwatch.errors import EmberwatchError

MOVES = "emberwatch/WildfireMoves-v0"
SEEN: dict[str, Any] = {"observation": "local", "max_episode_steps": 96}


@ray.remote(num_cpus=0, max_restarts=-1, max_task_retries=-1)
class NodeServer:
    """Keeps a server running on its node. The server ends with this actor."""

    def __init__(self, n_worlds: int) -> None:
        self._instance = f"ray-{uuid.uuid4().hex}"
        self._command = ["emberwatch-server", f"--instance={self._instance}", "--task=small"]
        self._command += [f"--worlds={n_worlds}", f"--exit-with={os.getpid()}"]
        self._start()

    def instance(self) -> str:
        """Returns the instance to attach to. Restarts the server if it has died."""
        try:
            emberwatch.connect(self._instance).close()
        except EmberwatchError:
            self._server.kill()
            self._server.wait()
            self._start()
        return self._instance

    def _start(self) -> None:
        self._server = subprocess.Popen(self._command)
        emberwatch.connect(self._instance, wait=20).close()


@ray.remote(num_cpus=0)
class Servers:
    """The servers of all nodes, each started on request. The servers end with the training, even if
    it crashes."""

    def __init__(self, n_worlds: int) -> None:
        self._n_worlds = n_worlds
        self._servers: dict[str, Any] = {}

    def instance(self, node: str) -> str:
        """Returns the instance on a node."""
        if node not in self._servers:
            self._servers[node] = NodeServer.options(**on(node)).remote(self._n_worlds)
        return ray.get(self._servers[node].instance.remote())


def on(node: str) -> dict[str, Any]:
    """Returns the options that pin an actor to this node."""
    return {"scheduling_strategy": NodeAffinitySchedulingStrategy(node, soft=False)}


def make(settings: dict[str, Any]) -> gymnasium.vector.VectorEnv:
    """Makes all environments of a runner, in its process."""
    n_worlds = settings["num_envs"]
    node = ray.get_runtime_context().get_node_id()
    instance = ray.get(ray.get_actor("servers").instance.remote(node))
    for part in range(settings["runners"]):
        envs = gymnasium.make_vec(MOVES, n_worlds, instance=instance, world=part * n_worlds, **SEEN)
        try:
            envs.reset(options={"resume": True})  # leases these worlds
            return scaled(envs)
        except EmberwatchError as error:
            envs.close()
            if error.code != "busy":
                raise
    raise RuntimeError(f"instance {instance}: other clients hold all its worlds")


def scaled(envs: gymnasium.vector.VectorEnv) -> gymnasium.vector.VectorEnv:
    """Flattens the windows to vectors of numbers from 0 to 1."""
    length = int(np.prod(envs.single_observation_space.shape))
    return TransformObservation(
        envs,
        lambda seen: seen.reshape(len(seen), length) / np.float32(255),
        single_observation_space=gymnasium.spaces.Box(0, 1, (length,)),
    )


def places(algorithm: Algorithm) -> dict[tuple[str, int], list[int]]:
    """Returns the runners' process ids by server, given as its node and process id."""

    def place(runner: Any) -> tuple[tuple[str, int], int]:
        node = ray.get_runtime_context().get_node_id()
        with emberwatch.connect(runner.env.unwrapped.instance) as client:
            return (node, client.info.pid), os.getpid()

    group = algorithm.env_runner_group
    found = defaultdict(list)
    for server, runner in group.foreach_env_runner(place, local_env_runner=False):
        found[server].append(runner)
    return found


def kill_soon(kind: str, pid: int) -> None:
    """Kills a process on this machine while the next iteration samples."""

    def kill() -> None:
        os.kill(pid, signal.SIGKILL)
        print(f"{kind} {pid} is killed", flush=True)

    threading.Timer(0.2, kill).start()


def train(algorithm: Algorithm, iterations: int, kills: bool) -> None:
    """Trains, and prints each iteration's return and runners.

    After kills, continues until all runners are back.
    """
    iteration = n_flying = 0
    victims = ["runner", "server"] if kills else []
    n_runners = algorithm.config.num_env_runners
    while iteration < iterations or (kills and (victims or n_flying < n_runners)):
        runners = algorithm.train()["env_runners"]
        steps = runners["num_env_steps_sampled_lifetime"]
        pay = runners.get("episode_return_mean", float("nan"))
        where = places(algorithm)
        words = [f"runners {sorted(where[at])} on server {at[1]}" for at in sorted(where)]
        print(
            f"iteration {iteration}: {steps:.0f} moves, reward of an episode {pay:.1f}, "
            f"{', '.join(words)}",
            flush=True,
        )
        if victims and where:  # empty if a busy machine was too slow
            at = min(where, key=lambda server: len(where[server]))
            victim = victims.pop(0)
            kill_soon(victim, where[at][0] if victim == "runner" else at[1])
        iteration, n_flying = iteration + 1, sum(map(len, where.values()))


def main() -> None:
    """Trains on a cluster; by default, on two nodes on this machine."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--address", help="a running cluster; None: start two nodes here")
    parser.add_argument("--iterations", type=int, default=20)
    parser.add_argument("--runners", type=int, default=4, help="at most 15 per node")
    parser.add_argument("--worlds", type=int, default=8, help="worlds per runner")
    parser.add_argument("--batch", type=int, default=4000, help="moves per iteration")
    parser.add_argument(
        "--kill", action="store_true", help="kill a local runner and a local server"
    )
    args = parser.parse_args()
    if args.kill and args.address is not None:
        parser.error("--kill: applies only without --address, as it kills local processes")

    cluster = None
    if args.address is None:
        node = {"num_cpus": (args.runners + 1) // 2, "object_store_memory": 100 * 2**20}
        cluster = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
        cluster.add_node(**node)
    ray.init(address=args.address or cluster.address, log_to_driver=False)
    register_env("wildfire", make)
    here = on(ray.get_runtime_context().get_node_id())
    servers = Servers.options(name="servers", **here).remote(args.runners * args.worlds)
    config = (
        PPOConfig()
        .environment("wildfire", env_config={"runners": args.runners})
        .env_runners(
            num_env_runners=args.runners,
            num_envs_per_env_runner=args.worlds,
            gym_env_vectorize_mode="vector_entry_point",
        )
        .fault_tolerance(restart_failed_env_runners=True, restart_failed_sub_environments=True)
        .training(train_batch_size=args.batch, minibatch_size=500, num_epochs=4, gamma=0.95)
        .debugging(seed=1000)
    )
    algorithm = config.build_algo()
    train(algorithm, args.iterations, args.kill)
    algorithm.stop()
    ray.kill(servers)
    ray.shutdown()
    if cluster is not None:
        cluster.shutdown()


if __name__ == "__main__":
    main()
