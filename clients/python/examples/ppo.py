"""PPO on `emberwatch/WildfireMoves-v0` in one file, from a window of the belief around the robot.

python ppo.py --imitate 60 --cpu-seconds 600 --out ppo --evaluate 0..32

`--observation recent` shows the last observations instead, which need no model and no filter.

With `--imitate`, the network first imitates beam search on the same belief, in the states that its
own moves reach (DAgger: Ross, Gordon, Bagnell, 2011). Then PPO improves it.
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
from torch.distributions import Categorical

from emberwatch.benchmark import evaluate, summary
from emberwatch.planning import beam_search

ENV = "emberwatch/WildfireMoves-v0"
MOVES = np.array([(-1, 0), (1, 0), (0, -1), (0, 1)])
#: Moves of a rollout, and the batches, epochs and constants of PPO.
HORIZON, BATCH, EPOCHS, LEARNING_RATE = 32, 512, 4, 7e-4
GAMMA, LAMBDA, ENTROPY = 0.95, 0.9, 0.01
#: Number of rollouts after an imitation in which only the value function learns.
VALUE_ROUNDS = 5


class Network(nn.Module):
    """Policy and value of a window `(n, side, side, channels)` around the robot."""

    def __init__(self, side: int, n_channels: int) -> None:
        super().__init__()
        self.margin = side // 2 - 3
        self.far = nn.Sequential(
            *(nn.Conv2d(n_channels, 24, 3, 2, 1), nn.ReLU()),
            *(nn.Conv2d(24, 32, 3, 1, 1), nn.ReLU()),
            *(nn.Conv2d(32, 32, 3, 2, 1), nn.ReLU(), nn.Flatten()),
        )
        self.near = nn.Sequential(nn.Flatten(), nn.Linear(49 * n_channels, 128), nn.ReLU())
        n_far = self.far(torch.zeros(1, n_channels, side, side)).shape[1]
        self.both = nn.Sequential(
            *(nn.Linear(n_far + 128, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU())
        )
        self.policy = nn.Linear(128, 4)
        self.value = nn.Sequential(nn.Linear(128, 64), nn.ReLU(), nn.Linear(64, 1))
        nn.init.orthogonal_(self.policy.weight, 0.01)
        nn.init.zeros_(self.policy.bias)

    def forward(self, windows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        images = windows.permute(0, 3, 1, 2).float() / 255
        near = slice(self.margin, self.margin + 7)
        both = self.both(torch.cat((self.far(images), self.near(images[:, :, near, near])), 1))
        return self.policy(both), self.value(both)[:, 0]


def symmetries() -> list[tuple[int, bool, torch.Tensor]]:
    """Returns the square's symmetries: quarter turns, a mirror flag, and the moves' new numbers."""
    found = []
    for mirrored in (False, True):
        for turns in range(4):
            names = []
            for move in MOVES:
                cells = np.zeros((3, 3))
                cells[tuple(1 + move)] = 1
                cells = np.rot90(cells[:, ::-1] if mirrored else cells, turns)
                after = np.argwhere(cells)[0] - 1
                names.append(int(np.flatnonzero((after == MOVES).all(1))[0]))
            found.append((turns, mirrored, torch.tensor(names)))
    return found


SYMMETRIES = symmetries()


def turned(windows: torch.Tensor, turns: int, mirrored: bool) -> torch.Tensor:
    return torch.rot90(torch.flip(windows, (2,)) if mirrored else windows, turns, (1, 2))


class Training:
    """The network, its worlds and its log."""

    def __init__(self, args: argparse.Namespace) -> None:
        torch.set_num_threads(1)
        torch.manual_seed(args.seed)
        self.args = args
        imitates = ("belief", "robot", "visited", "move") if args.imitate > 0 else ()
        self.envs = gymnasium.make_vec(
            ENV,
            num_envs=args.worlds,
            autoreset_mode="SameStep",
            max_episode_steps=args.n_moves * 50,
            reward="move",
            observation=(args.observation, *imitates),
            **world(args),
        )
        side, _, n_channels = self.envs.single_observation_space[args.observation].shape
        self.network = Network(side, n_channels)
        self.rng = np.random.default_rng(args.seed)
        self.seen, _ = self.envs.reset(seed=args.seed)
        self.begin = time.process_time()
        self.moves, self.rewards = 0, []
        args.out.mkdir(parents=True, exist_ok=True)

    def used(self) -> float:
        """Returns the processor seconds used so far."""
        return time.process_time() - self.begin

    def windows(self) -> np.ndarray:
        return self.seen[self.args.observation]

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
        self.seen, rewards, _, truncated, infos = self.envs.step(actions)
        self.moves += len(actions)
        self.rewards.append(rewards.mean())
        return rewards, truncated, infos

    def report(self, phase: str) -> None:
        """Prints the mean reward per path since the last report, and saves the network."""
        reward = float(np.mean(self.rewards)) * self.args.n_moves
        self.rewards.clear()
        print(f"{phase} {self.used():5.0f} s, {self.moves} moves: reward per path {reward:.2f}")
        torch.save(self.network.state_dict(), self.args.out / "ppo.pt")

    def imitate(self) -> None:
        """Learns the first moves of beam search, in the states that its own moves reach."""
        args = self.args
        shape = self.envs.single_observation_space[args.observation].shape
        windows, wanted = np.zeros((40_960, *shape), np.uint8), np.zeros(40_960, np.int64)
        optimizer = torch.optim.Adam(self.network.parameters(), 1e-3)
        n_known, round_, target = 0, 0, self.envs.unwrapped.model.target_state
        while self.used() < args.imitate:
            for group in optimizer.param_groups:
                group["lr"] = 1e-3 * (1.02 - self.used() / args.imitate)
            for _ in range(args.n_moves):
                seen, left = self.seen, args.n_moves - int(self.seen["move"][0])
                values = seen["belief"][..., target] / 255 + 0.02
                paths = beam_search(
                    *(values, seen["robot"], left),
                    rng=self.rng,
                    visited=seen["visited"][..., 0],
                    width=32,
                )
                best = paths[:, 0].astype(np.int64)
                at = (n_known + np.arange(len(best))) % len(wanted)
                windows[at], wanted[at] = self.windows(), best
                n_known += len(best)
                with torch.no_grad():
                    logits, _ = self.network(torch.from_numpy(self.windows()))
                own = Categorical(logits=logits).sample().numpy()
                guided = self.rng.random(len(best)) < 1 - round_ / 20
                self.step(np.where(guided, best, own))
            for _ in range(3):
                batch = self.rng.integers(0, min(n_known, len(wanted)), 512)
                turns, mirrored, names = SYMMETRIES[self.rng.integers(8)]
                images = turned(torch.from_numpy(windows[batch]), turns, mirrored)
                logits, _ = self.network(images)
                loss = nn.functional.cross_entropy(logits, names[wanted[batch]])
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
            round_ += 1
            if round_ % 25 == 0:
                self.report("imitation")

    def improve(self) -> None:
        """Improves the policy by proximal policy optimisation (Schulman et al., 2017)."""
        args, first = self.args, self.used()
        optimizer = torch.optim.Adam(self.network.parameters(), LEARNING_RATE, eps=1e-5)
        rounds = 0
        while self.used() < args.cpu_seconds:
            share = (self.used() - first) / (args.cpu_seconds - first)
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * (1 - share)
            rollout = self.rollout()
            only_value = args.imitate > 0 and rounds < VALUE_ROUNDS
            self.update(optimizer, rollout, only_value=only_value)
            rounds += 1
            if rounds % 10 == 0:
                self.report("PPO")

    def rollout(self) -> list[torch.Tensor]:
        """Flies `horizon` moves. Returns windows, actions, log-probabilities, advantages,
        returns."""
        args, n = self.args, self.args.worlds
        # Mirroring preserves the dynamics. Rotation does not, because fire drifts in one direction.
        turns, mirrored, names = SYMMETRIES[4 * self.rng.integers(2)]
        back = names.argsort()
        windows, actions, log_probabilities, values, rewards, ends = [], [], [], [], [], []
        for _ in range(HORIZON):
            window = turned(torch.from_numpy(self.windows()), turns, mirrored)
            with torch.no_grad():
                logits, value = self.network(window)
            moves = Categorical(logits=logits)
            action = moves.sample()
            reward, truncated, infos = self.step(back[action].numpy())
            earned, end = torch.from_numpy(reward).float(), torch.from_numpy(truncated)
            if truncated.any():  # the world itself did not end
                last = np.stack([seen[args.observation] for seen in infos["final_obs"][truncated]])
                with torch.no_grad():
                    last = turned(torch.from_numpy(last), turns, mirrored)
                    earned[end] += GAMMA * self.network(last)[1]
            windows.append(window)
            actions.append(action)
            log_probabilities.append(moves.log_prob(action))
            values.append(value)
            rewards.append(earned)
            ends.append(end.float())
        with torch.no_grad():
            last = turned(torch.from_numpy(self.windows()), turns, mirrored)
            values.append(self.network(last)[1])
        advantages, advantage = [], torch.zeros(n)
        for at in reversed(range(HORIZON)):
            continues = 1 - ends[at]
            error = rewards[at] + GAMMA * continues * values[at + 1] - values[at]
            advantage = error + GAMMA * LAMBDA * continues * advantage
            advantages.insert(0, advantage)
        returns = [a + v for a, v in zip(advantages, values, strict=False)]
        parts = (windows, actions, log_probabilities, advantages, returns)
        return [torch.cat(part) for part in parts]

    def update(self, optimizer: Any, rollout: list[torch.Tensor], *, only_value: bool) -> None:
        for _ in range(EPOCHS):
            for batch in torch.randperm(len(rollout[0])).split(BATCH):
                windows, actions, before, advantages, returns = (part[batch] for part in rollout)
                logits, values = self.network(windows)
                moves = Categorical(logits=logits)
                ratio = (moves.log_prob(actions) - before).exp()
                advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
                gain = torch.min(ratio * advantages, ratio.clamp(0.8, 1.2) * advantages).mean()
                entropy = moves.entropy().mean()
                loss = 0.5 * (values - returns).square().mean()
                if not only_value:
                    loss = 0.5 * loss - gain - ENTROPY * entropy
                optimizer.zero_grad()
                loss.backward()
                if only_value:  # shared layers and policy stay unchanged
                    for name, parameter in self.network.named_parameters():
                        parameter.grad = parameter.grad if name.startswith("value") else None
                nn.utils.clip_grad_norm_(self.network.parameters(), 0.5)
                optimizer.step()


def acting(network: Network, *, sampled: bool) -> Any:
    """Returns a policy for the benchmark, which averages logits over both mirror images.

    It samples a move, or takes the most probable one.
    """

    @torch.no_grad()
    def act(windows: np.ndarray) -> np.ndarray:
        total = torch.zeros(len(windows), 4)
        for turns, mirrored, names in (SYMMETRIES[0], SYMMETRIES[4]):
            logits, _ = network(turned(torch.from_numpy(windows), turns, mirrored))
            total += logits.log_softmax(1)[:, names]
        if sampled:
            return Categorical(logits=total / 2).sample().numpy()
        return total.argmax(1).numpy()

    return act


def world(args: argparse.Namespace) -> dict[str, Any]:
    """Returns the keyword arguments of the environments."""
    names = ("model", "height", "width", "n_moves", "burn_in")
    # A long timeout, for busy machines.
    return {name: getattr(args, name) for name in names} | {"timeout": 60.0}


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--cpu-seconds", type=float, default=600, help="processor seconds to train")
    parser.add_argument("--imitate", type=float, default=0, help="processor seconds to imitate")
    parser.add_argument("--out", type=Path, default=Path("ppo"), help="output folder")
    parser.add_argument(
        "--evaluate", default="5000..5008", help="seeds, FIRST..END; test worlds are below 1000"
    )
    parser.add_argument("--steps", type=int, default=100, help="evaluated paths per world")
    parser.add_argument("--sampled", action="store_true", help="evaluate sampled moves")
    parser.add_argument("--name", default="ppo", help="name in the benchmark's table")
    parser.add_argument("--seed", type=int, default=1000, help="seed, also of the first world")
    parser.add_argument("--model", default="wildfire-small")
    for name, default in (("height", 16), ("width", 16), ("n-moves", 16), ("burn-in", 3000)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--observation", choices=("local", "recent"), default="local")
    parser.add_argument("--worlds", type=int, default=64)
    return parser.parse_args()


def main() -> None:
    """Trains, then scores the policy for the benchmark's table."""
    args = arguments()
    training = Training(args)
    training.imitate()
    training.improve()
    training.envs.close()
    (args.out / "rows.csv").unlink(missing_ok=True)  # from an earlier training
    rows = evaluate(
        acting(training.network, sampled=args.sampled),
        name=args.name,
        seeds=range(*map(int, args.evaluate.split(".."))),
        steps=args.steps,
        observation=args.observation,
        csv=args.out / "rows.csv",
        **world(args),
    )
    print(summary(rows))


if __name__ == "__main__":
    main()
