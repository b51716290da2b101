"""Plots a running server live, as an observer that never slows the server.

emberwatch-server & emberwatch-agent run & python live_plot.py
python live_plot.py --start --frames 200 --out plot.png      # without a screen
"""

from __future__ import annotations

import argparse
import subprocess
from collections import deque

import matplotlib
import numpy as np

import emberwatch


def main() -> None:
    """Draws the last observed value of each cell, and the rewards."""
    parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--instance", default="default")
    parser.add_argument("--world", type=int, default=0)
    parser.add_argument("--start", action="store_true", help="start a server and an agent")
    parser.add_argument(
        "--frames", type=int, default=0, help="end after this many frames, 0 for never"
    )
    parser.add_argument("--every", type=int, default=20, help="draw every n-th frame")
    parser.add_argument("--out", help="write the last picture here instead of showing a window")
    args = parser.parse_args()
    if args.out:
        matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    programs = []
    if args.start:
        server = ["emberwatch-server", "--instance", args.instance]
        agent = ["emberwatch-agent", "run", "--instance", args.instance]
        programs.append(subprocess.Popen(server))
        emberwatch.connect(args.instance, wait=20).close()
        programs.append(subprocess.Popen(agent, stderr=subprocess.DEVNULL))

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.5), layout="constrained")
    seen, rewards = None, deque(maxlen=1000)
    image, (line,) = None, right.plot([], [], ".", markersize=3, color="#c8371b")
    left.set(title="last observed value of each cell", xticks=[], yticks=[])
    right.set(title="reward", xlabel="step k", ylabel="distinct burning cells found")
    n_lost = 0
    for n_frames, frame in enumerate(emberwatch.observe(args.instance, world=args.world), 1):
        if seen is None or frame.result.step == 0:
            seen = np.full(frame.frame.shape, np.nan)
        is_seen = frame.frame != 255
        seen[is_seen] = frame.frame[is_seen]
        n_lost += frame.n_lost
        rewards.append((frame.result.step, frame.result.reward))
        if n_frames % args.every == 0:
            if image is None:
                colors = matplotlib.colors.ListedColormap(["#3b6ea5", "#e3b23c", "#c8371b"])
                image = left.imshow(seen, cmap=colors, vmin=0, vmax=2)
            image.set_data(seen)
            line.set_data(*zip(*rewards, strict=True))
            right.set_title(f"reward ({n_frames} frames received, {n_lost} missed)")
            right.relim()
            right.autoscale_view()
            plt.pause(0.001)
        if n_frames == args.frames:
            break
    if args.out:
        figure.savefig(args.out, dpi=100)
    for program in reversed(programs):
        program.terminate()
        program.wait(timeout=20)


if __name__ == "__main__":
    main()
