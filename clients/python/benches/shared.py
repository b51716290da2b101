"""Measures steps per second of several processes with their own worlds, or with a shared server.

All processes step at the same time, each its own worlds as one vector environment. Rounds
alternate, so that noise on the machine affects both cases alike. Prints the total rate of all
processes, as the median over rounds.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
import subprocess
import time
from multiprocessing.connection import Connection
from typing import Any

import gymnasium
import numpy as np

import emberwatch

WILDFIRE = "emberwatch:emberwatch/Wildfire-v0"
SEEN: dict[str, Any] = {"observation": "frame", "max_episode_steps": 2**31 - 1}


def work(pipe: Connection, instance: str, process: int, n_worlds: int) -> None:
    """Steps for each duration received, and sends the rate; `None` ends the process."""
    shared = {"instance": instance, "world": process * n_worlds}
    peers = {
        "own": gymnasium.make_vec(WILDFIRE, n_worlds, **SEEN),
        "shared": gymnasium.make_vec(WILDFIRE, n_worlds, **shared, **SEEN),
    }
    for envs in peers.values():
        envs.reset(seed=1000)
    paths = peers["own"].action_space.sample().astype(np.uint8)
    pipe.send("ready")
    for kind, seconds in iter(pipe.recv, None):
        n_steps, began = 0, time.perf_counter()
        while time.perf_counter() - began < seconds:
            peers[kind].step(paths)
            n_steps += n_worlds
        pipe.send(n_steps / (time.perf_counter() - began))
    for envs in peers.values():
        envs.close()


def main() -> None:
    """Measures the rates for each number of processes."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--worlds", type=int, default=8, help="worlds per process")
    parser.add_argument("--seconds", type=float, default=0.5, help="seconds per round")
    parser.add_argument("--rounds", type=int, default=7)
    args = parser.parse_args()
    instance, most = f"shared-{os.getpid()}", max(args.processes)
    server = subprocess.Popen(
        ["emberwatch-server", f"--instance={instance}", f"--worlds={most * args.worlds}"]
    )
    emberwatch.connect(instance, wait=20).close()
    context = multiprocessing.get_context("spawn")
    pipes, processes = [], []
    for number in range(most):
        pipe, end = context.Pipe()
        processes.append(context.Process(target=work, args=(end, instance, number, args.worlds)))
        processes[-1].start()
        pipes.append(pipe)
    for pipe in pipes:
        pipe.recv()

    rates: dict[tuple[int, str], list[float]] = {}
    for _ in range(args.rounds):
        for n_processes in args.processes:
            for kind in ("own", "shared"):
                for pipe in pipes[:n_processes]:
                    pipe.send((kind, args.seconds))
                rate = sum(pipe.recv() for pipe in pipes[:n_processes])
                rates.setdefault((n_processes, kind), []).append(rate)
    for (n_processes, kind), rounds in rates.items():
        median, span = statistics.median(rounds), f"{min(rounds):.0f} to {max(rounds):.0f}"
        print(f"{n_processes} {kind:8} {median:9.0f} steps/s ({span})")
    for pipe, process in zip(pipes, processes, strict=True):
        pipe.send(None)
        process.join()
    server.terminate()
    server.wait()


if __name__ == "__main__":
    main()
