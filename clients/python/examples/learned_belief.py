"""Beam search on a filter's belief that a network corrects, in one file.

python learned_belief.py --cpu-seconds 300 --evaluate 0..32 --out learned_belief

The filter treats cells as independent: an observation of one cell says nothing about its
neighbours. The network learns these dependencies. From the last observations of each cell and its
surroundings, it computes a correction to the filter's log-probabilities. Its loss is the negative
log-likelihood of the next observations under the model's observation matrix. It trains on frames
alone, without hidden states or rewards.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import nn

from emberwatch.benchmark import evaluate, summary
from emberwatch.model import Model
from emberwatch.planning import beam_search

ENV = "emberwatch/Wildfire-v0"
PARTS = ("belief", "frame", "robot")
UNOBSERVED = 255
#: Width of the beam, updates per step of the worlds, and steps between two lines of output.
BEAM, UPDATES, REPORTS = 64, 2, 100


class Sightings:
    """The last two observations of each cell, with their ages in steps."""

    def __init__(self, frames: np.ndarray, n_observations: int) -> None:
        self.never = n_observations
        self.values = np.full((2, *frames.shape), self.never, np.uint8)
        self.ages = np.full((2, *frames.shape), np.inf, np.float32)

    def forget(self, worlds: np.ndarray) -> None:
        self.values[:, worlds], self.ages[:, worlds] = self.never, np.inf

    def see(self, frames: np.ndarray) -> None:
        seen = frames != UNOBSERVED
        self.ages += 1
        self.values[1, seen], self.ages[1, seen] = self.values[0, seen], self.ages[0, seen]
        self.values[0, seen], self.ages[0, seen] = frames[seen], 1

    def images(self, beliefs: np.ndarray) -> torch.Tensor:
        """Returns the network's input, `(n, channels, H, W)`; the first channels are the belief."""
        one_hot = np.eye(self.never + 1, dtype=np.float32)[self.values]
        parts = [
            beliefs / np.float32(255),
            *one_hot,
            *(np.exp(-self.ages[0] / steps)[..., np.newaxis] for steps in (4, 32)),
            np.exp(-self.ages[1] / 32)[..., np.newaxis],
            np.ones((*beliefs.shape[:-1], 1), np.float32),  # 1 on the grid; padding is 0
        ]
        return torch.from_numpy(np.concatenate(parts, axis=-1)).permute(0, 3, 1, 2)


class Belief(nn.Module):
    """Log-probabilities of each cell's states: the filter's plus a learned correction."""

    def __init__(self, model: Model) -> None:
        super().__init__()
        self.n_states = model.n_states
        n_channels = self.n_states + 2 * (model.n_observations + 1) + 4
        self.layers = nn.Sequential(
            *(nn.Conv2d(n_channels, 32, 3, padding=1), nn.ReLU()),
            *(nn.Conv2d(32, 32, 3, padding=1), nn.ReLU()),
            *(nn.Conv2d(32, 32, 3, padding=1), nn.ReLU()),
            nn.Conv2d(32, self.n_states, 3, padding=1),
        )
        nn.init.zeros_(self.layers[-1].weight)
        nn.init.zeros_(self.layers[-1].bias)

    def filtered(self, images: torch.Tensor) -> torch.Tensor:
        # Beliefs are rounded to multiples of 1 / 255; half a step avoids log(0).
        return images[:, : self.n_states].clamp(min=1 / 510).log().log_softmax(1)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return (self.filtered(images) + self.layers(images)).log_softmax(1)


class Policy:
    """Plans paths over the cells that most probably pay, and remembers each world's
    observations."""

    def __init__(self, belief: Belief, model: Model, args: argparse.Namespace) -> None:
        self.belief, self.model, self.args = belief, model, args
        self.rng = np.random.default_rng(args.seed)
        self.sightings: Sightings | None = None

    def begin(self, n_worlds: int) -> None:
        """Forgets all observations, because new worlds begin."""
        self.sightings = None

    def look(self, seen: dict[str, np.ndarray]) -> torch.Tensor:
        """Records the observations and returns the network's input."""
        frames = seen["frame"][..., 0]
        if self.sightings is None:
            self.sightings = Sightings(frames, self.model.n_observations)
        self.sightings.see(frames)
        return self.sightings.images(seen["belief"])

    @torch.no_grad()
    def plan(self, images: torch.Tensor, robots: np.ndarray) -> np.ndarray:
        values = self.belief(images)[:, self.model.target_state].exp().numpy() + 0.02
        return beam_search(values, robots, self.args.n_moves, rng=self.rng, width=BEAM)

    def __call__(self, seen: dict[str, np.ndarray]) -> np.ndarray:
        return self.plan(self.look(seen), seen["robot"])


class Replay:
    """A replay buffer of network inputs, each with the frame observed next."""

    def __init__(self, images: torch.Tensor, size: int) -> None:
        self.images = torch.zeros((size, *images.shape[1:]), dtype=torch.float16)
        self.frames = np.full((size, *images.shape[2:]), UNOBSERVED, np.uint8)
        self.n_added = 0

    def add(self, images: torch.Tensor, frames: np.ndarray) -> None:
        at = (self.n_added + np.arange(len(images))) % len(self.images)
        self.images[at], self.frames[at] = images.half(), frames
        self.n_added += len(images)

    def sample(self, n: int, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        at = rng.integers(0, min(self.n_added, len(self.images)), n)
        images, frames = self.images[at].float(), torch.from_numpy(self.frames[at])
        if rng.random() < 0.5:  # mirroring preserves the dynamics
            images, frames = images.flip(3), frames.flip(2)
        return images, frames


class Training:
    """The worlds in which the policy flies, and the network that learns from its frames."""

    def __init__(self, args: argparse.Namespace) -> None:
        torch.set_num_threads(1)
        torch.manual_seed(args.seed)
        self.args, self.rng = args, np.random.default_rng([args.seed, 1])
        self.envs = gymnasium.make_vec(
            ENV,
            num_envs=args.worlds,
            autoreset_mode="SameStep",
            max_episode_steps=400,
            observation=PARTS,
            **world(args),
        )
        model = self.envs.unwrapped.model
        self.observed_as = torch.from_numpy(model.observation_matrix).float()
        self.belief = Belief(model)
        self.policy = Policy(self.belief, model, args)

    def learn(self) -> None:
        args = self.args
        args.out.mkdir(parents=True, exist_ok=True)
        optimizer = torch.optim.Adam(self.belief.parameters())
        seen, _ = self.envs.reset(seed=args.seed)
        images = self.policy.look(seen)
        replay, n_steps, log = Replay(images, 6_000), 0, []
        begin, used = time.process_time(), 0.0
        while n_steps == 0 or used < args.cpu_seconds:
            for group in optimizer.param_groups:
                group["lr"] = 2e-3 * (1.02 - used / args.cpu_seconds)
            paths = self.policy.plan(images, seen["robot"])
            explores = self.rng.random(len(paths)) < 0.1
            paths[explores] = self.rng.integers(0, 4, (int(explores.sum()), args.n_moves))
            seen, rewards, _, truncated, _ = self.envs.step(paths)
            # The first frame of an episode is empty, so nothing is learned from it.
            replay.add(images, seen["frame"][..., 0])
            self.policy.sightings.forget(truncated)
            images = self.policy.look(seen)
            losses = [self.update(optimizer, replay) for _ in range(UPDATES)]
            log.append((rewards.mean(), *np.mean(losses, axis=0)))
            n_steps += 1
            used = time.process_time() - begin
            if n_steps % REPORTS == 0 or used >= args.cpu_seconds:
                reward, loss, filters = np.nanmean(log, axis=0)
                log.clear()
                print(f"{used:.0f} s: reward {reward:.2f}, loss {loss:.4f}, filter's {filters:.4f}")
                torch.save(self.belief.state_dict(), args.out / "belief.pt")

    def update(self, optimizer: Any, replay: Replay) -> tuple[float, float]:
        """Updates the network once. Returns its loss and the filter's loss, in nats per cell."""
        images, frames = replay.sample(64, self.rng)
        visited = frames != UNOBSERVED
        if not visited.any():
            return np.nan, np.nan
        observed = frames[visited].long()[:, None]

        def loss_of(log_probabilities: torch.Tensor) -> torch.Tensor:
            states = log_probabilities.permute(0, 2, 3, 1)[visited].exp()
            return -(states @ self.observed_as).gather(1, observed).log().mean()

        loss = loss_of(self.belief(images))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        return loss.item(), loss_of(self.belief.filtered(images)).item()


def world(args: argparse.Namespace) -> dict[str, Any]:
    """Returns the keyword arguments of the environments."""
    names = ("model", "height", "width", "n_moves", "burn_in")
    # A long timeout, for busy machines.
    return {name: getattr(args, name) for name in names} | {"timeout": 60.0}


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--cpu-seconds", type=float, default=300, help="processor seconds to train")
    parser.add_argument("--out", type=Path, default=Path("learned_belief"), help="output folder")
    parser.add_argument(
        "--evaluate", default="5000..5008", help="seeds, FIRST..END; test worlds are below 1000"
    )
    parser.add_argument("--steps", type=int, default=100, help="evaluated paths per world")
    parser.add_argument("--name", default="learned_belief", help="name in the benchmark's table")
    parser.add_argument("--seed", type=int, default=1000, help="seed, also of the first world")
    parser.add_argument("--model", default="wildfire-small")
    for name, default in (("height", 16), ("width", 16), ("n-moves", 16), ("burn-in", 3000)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--worlds", type=int, default=64)
    return parser.parse_args()


def main() -> None:
    """Trains, then scores the policy for the benchmark's table."""
    args = arguments()
    training = Training(args)
    training.learn()
    training.envs.close()
    (args.out / "rows.csv").unlink(missing_ok=True)  # from an earlier training
    rows = evaluate(
        training.policy,
        name=args.name,
        env=ENV,
        estimator="network",
        observation=PARTS,
        seeds=range(*map(int, args.evaluate.split(".."))),
        steps=args.steps,
        csv=args.out / "rows.csv",
        **world(args),
    )
    print(summary(rows))


if __name__ == "__main__":
    main()
