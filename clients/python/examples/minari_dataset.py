"""Records a data set with Minari and reads it back, for offline learning.

python minari_dataset.py --episodes 10
"""

from __future__ import annotations

import argparse
import os
import tempfile

import gymnasium

import emberwatch  # noqa: F401  (registers the environments)


def main() -> None:
    """Flies random paths, records them, and reads them back."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--steps", type=int, default=100, help="steps per episode")
    parser.add_argument("--folder", help="folder of data sets; None: a temporary one")
    args = parser.parse_args()
    os.environ["MINARI_DATASETS_PATH"] = args.folder or tempfile.mkdtemp(prefix="emberwatch-")
    import minari  # reads MINARI_DATASETS_PATH

    # JPEG would change the values: a frame holds codes, not shades of grey.
    env = minari.DataCollector(
        gymnasium.make("emberwatch/Wildfire-v0", max_episode_steps=args.steps),
        data_format="arrow",
        jpeg_encoding=False,
    )
    env.action_space.seed(0)
    for episode in range(args.episodes):
        env.reset(seed=1000 + episode)
        is_over = False
        while not is_over:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            is_over = terminated or truncated
    name = "emberwatch/wildfire/random-v0"
    env.create_dataset(name, algorithm_name="random moves", requirements=["emberwatch"])
    env.close()

    dataset = minari.load_dataset(name)
    print(f"{dataset.total_episodes} episodes, {dataset.total_steps} steps in {name}")
    for episode in dataset.iterate_episodes():
        frames = episode.observations["frame"]
        seen = (frames[1:] != 255).sum() / len(episode.actions)
        print(
            f"episode {episode.id}: {len(episode.actions)} steps, "
            f"reward {episode.rewards.sum():.0f}, {seen:.1f} cells seen per step"
        )


if __name__ == "__main__":
    main()
