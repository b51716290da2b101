"""Measures the alternatives with which `scripts/bench` compares Emberwatch in the same run.

- Gymnasium's AsyncVectorEnv with shared memory. Its environments do nothing but have the same spaces as Emberwatch's
  (observations of 4 KiB, actions of 64 integers), so this measures the cost of the process boundary.
- The wildfire model's transition, the known-model filter and the shooting planner, written in plain numpy.

Prints medians with minimum and maximum over rounds. Needs gymnasium and numpy.
"""

import statistics
import time

import gymnasium
import numpy as np

SHAPE = (64, 64)
N_MOVES = 64


class Trivial(gymnasium.Env):
    """An environment with the spaces of Emberwatch's environment, but without a simulation."""

    observation_space = gymnasium.spaces.Box(0, 255, (*SHAPE, 1), np.uint8)
    action_space = gymnasium.spaces.MultiDiscrete([4] * N_MOVES)

    def __init__(self):
        self.frame = np.full((*SHAPE, 1), 255, np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.frame, {}

    def step(self, action):
        return self.frame, 0.0, False, False, {}


def quantiles(micros):
    ordered = sorted(micros)
    return ordered[len(ordered) // 2], ordered[int(len(ordered) * 0.99)]


def async_vector_env(n_envs, n_steps):
    envs = gymnasium.vector.AsyncVectorEnv([Trivial] * n_envs, shared_memory=True)
    envs.reset(seed=0)
    actions = envs.action_space.sample()
    micros = []
    for _ in range(n_steps):
        start = time.perf_counter()
        envs.step(actions)
        micros.append((time.perf_counter() - start) * 1e6)
    envs.close()
    p50, p99 = quantiles(micros)
    rate = n_envs * len(micros) / (sum(micros) / 1e6)
    print(f"AsyncVectorEnv, {n_envs:>2} trivial envs     p50 {p50:7.1f} p99 {p99:7.1f} us   {rate:9.0f} env-steps/s")


def wildfire_kernel():
    """Returns the kernel weights w[to, from, row, col] of config/models/wildfire.toml."""
    around = np.full((3, 3), 0.1)
    around[1, 1] = 1.0
    drift = around * np.array([[1.2], [1.0], [0.8]])
    drift[1] = around[1]
    kernel = np.zeros((3, 3, 3, 3), np.float32)
    kernel[0, 0], kernel[0, 2] = 0.9999 * around, 0.0001 * around
    kernel[1, 1], kernel[1, 0] = 0.99992 * around, 0.00008 * around
    kernel[2, 1], kernel[2, 2] = 0.001 * around, 0.999 * drift
    return kernel


def phi(kernel, belief):
    """Applies eqs. 2 to 4 of the paper to probabilities of shape [S, H, W]."""
    _, height, width = belief.shape
    padded = np.pad(belief, ((0, 0), (1, 1), (1, 1)))
    total = np.zeros_like(belief)
    for row in range(3):
        for col in range(3):
            window = padded[:, row : row + height, col : col + width]
            total += np.tensordot(kernel[:, :, row, col], window, axes=1)
    return total / total.sum(0)


def transition(kernel, states, rng):
    chances = phi(kernel, np.eye(3, dtype=np.float32)[states].transpose(2, 0, 1))
    draws = rng.random(SHAPE, dtype=np.float32)
    return (draws > chances[0]).astype(np.uint8) + (draws > chances[0] + chances[1])


def shooting(values, rng, n_samples=2048):
    basis = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])
    cells = np.full((n_samples, 2), 32)
    visited = np.zeros((n_samples, *SHAPE), bool)
    samples = np.arange(n_samples)
    for moves in rng.integers(0, 4, (N_MOVES, n_samples)):
        cells = np.clip(cells + basis[moves], 0, 63)
        visited[samples, cells[:, 0], cells[:, 1]] = True
    return (visited * values).sum((1, 2)).argmax()


def report(what, function, rounds):
    function()
    micros = []
    for _ in range(rounds):
        start = time.perf_counter()
        function()
        micros.append((time.perf_counter() - start) * 1e6)
    print(f"numpy {what:<28} {statistics.median(micros):9.1f} us  ({min(micros):.1f} to {max(micros):.1f})")


def main():
    rng = np.random.default_rng(0)
    kernel, states = wildfire_kernel(), rng.integers(0, 3, SHAPE).astype(np.uint8)
    belief = rng.dirichlet(np.ones(3), SHAPE).transpose(2, 0, 1).astype(np.float32)
    report("world transition, 64 x 64", lambda: transition(kernel, states, rng), 200)
    report("filter prediction, 64 x 64", lambda: phi(kernel, belief), 200)
    report("shooting, 2048 x 64", lambda: shooting(belief[2], rng), 5)
    for n_envs, n_steps in ((1, 5000), (8, 1000), (64, 200)):
        async_vector_env(n_envs, n_steps)


if __name__ == "__main__":
    main()
