"""Deep Q-learning on `emberwatch/WildfireMoves-v0`, in one file.

A convolutional network sees three images: the latest frame, the cells already visited on this path,
and the robot's cell. It learns a value for each of the four moves. The reward of a cell comes with
the move that enters it (`reward="move"`), so that credit need not propagate back over a whole path.

    python dqn.py --total-steps 200000
"""

from __future__ import annotations

import argparse
import random
import time
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

import emberwatch  # noqa: F401  (registers the environments)


def parse() -> argparse.Namespace:
    """Reads the flags."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--total-steps", type=int, default=200_000, help="training moves")
    parser.add_argument("--grid", type=int, default=16, help="height and width in cells")
    parser.add_argument("--moves", type=int, default=16, help="moves per path")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--learning-rate", type=float, default=5e-4)
    parser.add_argument("--gamma", type=float, default=0.9)
    parser.add_argument("--buffer-size", type=int, default=50_000)
    parser.add_argument("--batch-size", type=int, default=64)
    parser.add_argument("--learning-starts", type=int, default=1_000)
    parser.add_argument("--train-every", type=int, default=4)
    parser.add_argument("--target-every", type=int, default=1_000)
    parser.add_argument("--final-epsilon", type=float, default=0.05)
    parser.add_argument("--report-every", type=int, default=10_000)
    return parser.parse_args()


class QNetwork(nn.Module):
    """Maps images `(N, 3, H, W)` to the values of the four moves."""

    def __init__(self, grid: int) -> None:
        super().__init__()
        self.network = nn.Sequential(
            nn.Conv2d(3, 16, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(16, 32, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(32 * ((grid + 1) // 2) ** 2, 128),
            nn.ReLU(),
            nn.Linear(128, 4),
        )

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.network(images)


class ReplayBuffer:
    """A ring buffer of the latest transitions, with images as bytes."""

    def __init__(self, size: int, image: tuple[int, ...]) -> None:
        self.images = np.zeros((size, *image), np.uint8)
        self.next_images = np.zeros((size, *image), np.uint8)
        self.actions = np.zeros(size, np.int64)
        self.rewards = np.zeros(size, np.float32)
        self.terminated = np.zeros(size, np.float32)
        self.n_added = 0

    def add(
        self, image: Any, action: int, reward: float, next_image: Any, terminated: bool
    ) -> None:
        index = self.n_added % len(self.actions)
        self.images[index], self.next_images[index] = image, next_image
        self.actions[index], self.rewards[index] = action, reward
        self.terminated[index] = terminated
        self.n_added += 1

    def sample(self, n: int, generator: np.random.Generator) -> list[torch.Tensor]:
        chosen = generator.integers(min(self.n_added, len(self.actions)), size=n)
        columns = (self.images, self.actions, self.rewards, self.next_images, self.terminated)
        return [torch.from_numpy(column[chosen]) for column in columns]


def picture(observation: dict[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """Returns an observation as bytes `(3, H, W)`: frame (fire brightest), visited cells, robot."""
    frame = observation["frame"][:, :, 0]
    robot = np.zeros_like(frame)
    robot[tuple(observation["robot"])] = 255
    shades = np.where(frame == 255, 0, 85 * (frame + 1)).astype(np.uint8)
    return np.stack((shades, observation["visited"][:, :, 0], robot))


def main() -> None:
    """Trains, and prints the reward per path."""
    args = parse()
    random.seed(args.seed)
    torch.manual_seed(args.seed)
    generator = np.random.default_rng(args.seed)

    env = gymnasium.make(
        "emberwatch/WildfireMoves-v0",
        reward="move",
        observation=("frame", "visited", "robot"),
        model="wildfire-small",  # its fires persist on small grids
        burn_in=3000,
        height=args.grid,
        width=args.grid,
        n_moves=args.moves,
        max_episode_steps=500 * args.moves,
    )
    env.action_space.seed(args.seed)
    network, target = QNetwork(args.grid), QNetwork(args.grid)
    target.load_state_dict(network.state_dict())
    optimizer = torch.optim.Adam(network.parameters(), lr=args.learning_rate)
    buffer = ReplayBuffer(args.buffer_size, (3, args.grid, args.grid))

    image = picture(env.reset(seed=args.seed)[0])
    earned, since, start = 0.0, 0, time.perf_counter()
    for step in range(args.total_steps):
        epsilon = max(args.final_epsilon, 1 - step / (0.3 * args.total_steps))
        if random.random() < epsilon:
            action = int(env.action_space.sample())
        else:
            with torch.no_grad():
                values = network(torch.from_numpy(image).unsqueeze(0).float() / 255)
            action = int(values.argmax())
        observation, reward, terminated, truncated, _ = env.step(action)
        next_image = picture(observation)
        # Only termination ends the return: a truncated episode would have continued.
        buffer.add(image, action, float(reward), next_image, terminated)
        image = next_image
        earned, since = earned + float(reward), since + 1
        if terminated or truncated:
            image = picture(env.reset()[0])

        if step >= args.learning_starts and step % args.train_every == 0:
            images, actions, rewards, next_images, ends = buffer.sample(args.batch_size, generator)
            with torch.no_grad():
                best = target(next_images.float() / 255).max(dim=1).values
                goals = rewards + args.gamma * best * (1 - ends)
            values = network(images.float() / 255).gather(1, actions.unsqueeze(1)).squeeze(1)
            loss = nn.functional.smooth_l1_loss(values, goals)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        if step % args.target_every == 0:
            target.load_state_dict(network.state_dict())
        if (step + 1) % args.report_every == 0 or step + 1 == args.total_steps:
            rate = (step + 1) / (time.perf_counter() - start)
            print(
                f"moves {step + 1}  reward per path {earned / since * args.moves:.2f}  "
                f"epsilon {epsilon:.2f}  {rate:.0f} moves/s",
                flush=True,
            )
            earned, since = 0.0, 0
    env.close()


if __name__ == "__main__":
    main()
