"""Monte Carlo tree search for paths, in worlds that are sampled from a belief.

python mcts.py --seeds 1000..1004 --out mcts.csv

A node is a sequence of paths. Each simulation samples a world from the belief and flies down the
tree in it; `Model.advance` moves this world on after each path.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gymnasium
import numpy as np

from emberwatch.benchmark import evaluate, summary
from emberwatch.model.moves import fly
from emberwatch.planning import beam_search

SPEC = gymnasium.make("emberwatch/WildfireSmall-v0").unwrapped.world_spec
RNG = np.random.default_rng(1)
#: Length of a node's sequence of paths, candidates for each path, and simulations.
DEPTH, CANDIDATES, SIMULATIONS = 2, 8, 256
#: Weight of the bonus for rarely tried candidates, about the spread of a path's reward.
EXPLORATION = 2.0


class Node:
    """The candidates for a robot's next path, and the rewards that followed them."""

    def __init__(self, cell: np.ndarray, values: np.ndarray, n: int) -> None:
        cells, noise = np.tile(cell, (n, 1)), RNG.uniform(0.5, 1.5, (n, *values.shape))
        noise[0] = 1.0  # the first candidate is the plan of beam search
        self.paths = beam_search(noise * values, cells, SPEC.n_moves, rng=RNG)
        flown = fly(cells, self.paths, SPEC)
        self.ends, self.visited = flown[:, -1], np.zeros((n, *values.shape), bool)
        self.visited[np.arange(n)[:, np.newaxis], flown[..., 0], flown[..., 1]] = True
        self.children: dict[int, Node] = {}
        self.visits, self.rewards = np.zeros(n), np.zeros(n)

    def simulate(self, pays: list[np.ndarray], values: list[np.ndarray]) -> float:
        """Flies paths in a world whose cells pay `pays` (H, W) in each step; returns the reward."""
        if self.visits.all():  # the highest upper confidence bound (UCB1)
            bonus = EXPLORATION * np.sqrt(np.log(self.visits.sum()) / self.visits)
            choice = int(np.argmax(self.rewards / self.visits + bonus))
        else:
            choice = int(np.argmin(self.visits))
        reward = pays[0][self.visited[choice]].sum()
        if len(pays) > 1:
            n = CANDIDATES if len(pays) > 2 else 1  # beam search plans the last path
            if choice not in self.children:
                self.children[choice] = Node(self.ends[choice], values[1], n)
            reward += self.children[choice].simulate(pays[1:], values[1:])
        self.visits[choice] += 1
        self.rewards[choice] += reward
        return reward


def search(belief: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Returns a robot's next path; `belief` (S, H, W) is about the states that it will find."""
    drawn = RNG.random((SIMULATIONS, 1, *belief.shape[1:])) * belief.sum(axis=0)
    worlds = (drawn >= belief.cumsum(axis=0)[:-1]).sum(axis=1).astype(np.uint8)
    pays, seeds = [SPEC.model.reward[worlds]], RNG.integers(2**63, size=SIMULATIONS)
    for step in range(DEPTH - 1):
        worlds = SPEC.model.advance(worlds, seed=seeds, step=step)
        pays.append(SPEC.model.reward[worlds])
    values = [it.mean(axis=0) for it in pays]
    values[0] = np.tensordot(SPEC.model.reward, belief, 1)
    root = Node(cell, values[0], CANDIDATES)
    for world in range(SIMULATIONS):
        root.simulate([it[world] for it in pays], values)
    return root.paths[np.argmax(root.visits)]


def policy(seen: dict[str, np.ndarray]) -> np.ndarray:
    """Searches in each world of `evaluate`."""
    beliefs = np.moveaxis(seen["belief"], -1, 1) / 255.0
    return np.array([search(*each) for each in zip(beliefs, seen["robot"], strict=True)])


def main() -> None:
    """Scores the search on worlds of the task `small`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="1000..1004", help="FIRST..END; below 1000 are tests")
    parser.add_argument("--steps", type=int, default=300, help="paths in each world")
    parser.add_argument("--out", type=Path, help="CSV file, for `emberwatch-agent compare --add`")
    args = parser.parse_args()
    seeds = range(*map(int, args.seeds.split("..")))
    worlds = {"env": "emberwatch/Wildfire-v0", "task": "small", "observation": ("belief", "robot")}
    rows = evaluate(policy, name="mcts", seeds=seeds, steps=args.steps, csv=args.out, **worlds)
    print(summary(rows))


if __name__ == "__main__":
    main()
