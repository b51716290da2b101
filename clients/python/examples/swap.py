"""Swaps agents on a running simulator: Rust, then Python, then Rust again.

The server never restarts, and each agent finds the world where the last one left it.

    python swap.py
"""

from __future__ import annotations

import argparse
import subprocess

import numpy as np

import emberwatch


def main() -> None:
    """Runs the three agents one after another and prints where each begins and ends."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--steps", type=int, default=200, help="steps of the Python agent")
    parser.add_argument("--instance", default="swap", help="instance of the server to start")
    args = parser.parse_args()
    instance = args.instance
    server = subprocess.Popen(["emberwatch-server", "--instance", instance])
    client = emberwatch.connect(instance, wait=20)

    agent = ["emberwatch-agent", "run", "--instance", instance]
    first = subprocess.Popen(agent, stderr=subprocess.DEVNULL)
    for frame in emberwatch.observe(instance, timeout=60):
        if frame.result.step >= args.steps:
            break
    lease = client.acquire(takeover=True)
    taken = lease.observe().result().world
    print(f"the Rust agent flew to k = {taken.step}; Python takes over")

    generator = np.random.default_rng(0)
    rewards = [
        lease.step(generator.integers(4, size=client.info.n_moves)).result().world.reward
        for _ in range(args.steps)
    ]
    given = lease.observe().result().world
    print(f"Python flew to k = {given.step}, {np.mean(rewards):.2f} fires a step; hands back")
    print(f"the first agent ended with code {first.wait(timeout=20)} (3: lease lost)")
    lease.release()

    subprocess.run([*agent, "--steps", str(args.steps)], check=True, stderr=subprocess.DEVNULL)
    last = client.observe().result().world
    print(f"the second Rust agent flew from k = {given.step} to k = {last.step}")
    assert last.step == given.step + args.steps
    client.shutdown()
    client.close()
    server.wait(timeout=20)


if __name__ == "__main__":
    main()
