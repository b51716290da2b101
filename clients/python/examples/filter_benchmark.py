"""Scores filters on the forest fires of N. Haksar, J. Lorenzetti and M. Schwager (CDC 2019).

    python filter_benchmark.py ../tests/data/fires/*.npz

25 x 25 trees are healthy, burning or burnt. A healthy tree ignites with probability
1 - (1 - a)**f, where f of its four neighbours burn and a rises from .1 in the first column to .4 in
the last. A burning tree burns out with probability 1 - exp(-1/10). At the start, 4 x 4 trees in the
middle burn, which every filter knows. An observed tree shows its state with probability .9, and
each of the two other states with .05. The table leaves out the first step of each fire:

- accuracy: share of the trees whose most probable state is the true state; the median over steps,
  as in the paper, then the mean over fires;
- NLL: mean of -log p of the true state, which also measures a filter's confidence;
- difference: NLL minus the NLL of the first filter, paired by fire, with its standard error;
- us a step: microseconds to correct and predict once.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from emberwatch import belief
from emberwatch.model import Model

SIDE = 25
RATES = np.linspace(0.1, 0.4, SIDE)  # a: probability of ignition per burning neighbour, by column
Fire = tuple[NDArray[np.uint8], NDArray[np.uint8]]  # states and frames, both [K, 25, 25]


MODEL = f"""
name = "forest"
edge = "healthy"
maps = "forest.npz"
states = [
    {{ name = "healthy", color = "#2e8b57", initial = 0.9744, observed_as = [0.9, 0.05, 0.05] }},
    {{ name = "burning", color = "#c8371b", initial = 0.0256, reward = 1, observed_as = [0.05, 0.9, 0.05] }},
    {{ name = "burnt", color = "#4a4a4a", initial = 0.0, observed_as = [0.05, 0.05, 0.9] }},
]
observations = [
    {{ name = "healthy", color = "#2e8b57" }},
    {{ name = "burning", color = "#c8371b" }},
    {{ name = "burnt", color = "#4a4a4a" }},
]

[[transitions]]
from = "healthy"
to = "burning"
near.burning = [[0.0, 0.1, 0.0], [0.1, 0.0, 0.1], [0.0, 0.1, 0.0]]
times = ["rate"]

[[transitions]]
from = "burning"
to = "burnt"
base = {1.0 - np.exp(-0.1)}
"""  # noqa: E501


def model() -> Model:
    """Returns the fire's model: exactly the rule above, with a map of the rates."""
    rate = np.tile(np.log1p(-RATES) / np.log1p(-0.1), (SIDE, 1))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "forest.toml"
        path.write_text(MODEL)
        np.savez(path.with_name("forest.npz"), rate=rate)
        return Model.named(path)


def recorded(path: Path) -> Iterator[Fire]:
    """Reads fires from an .npz file with `states_N` and `frames_N` for each fire N."""
    with np.load(path) as arrays:
        for name in sorted(name for name in arrays.files if name.startswith("states_")):
            yield arrays[name], arrays[name.replace("states_", "frames_")]


def score(fires: list[Fire], kinds: list[str]) -> None:
    """Prints the table, with one row for each kind of belief."""
    forest = model()
    losses: dict[str, NDArray[np.float64]] = {}
    print("| filter | accuracy | NLL | difference | us a step |\n|---|--:|--:|--:|--:|")
    for kind in kinds:
        accuracy, loss, micros = np.array(figures(forest, fires, kind)).T
        losses[kind] = loss
        by = loss - losses[kinds[0]]
        error = by.std(ddof=1) / np.sqrt(len(by)) if len(by) > 1 else np.nan
        print(
            f"| {kind} | {accuracy.mean():.4f} | {loss.mean():.4f} "
            f"| {by.mean():+.4f} ± {error:.4f} | {micros.mean():.0f} |"
        )


def figures(forest: Model, fires: list[Fire], kind: str) -> list[tuple[float, float, float]]:
    """Returns the accuracy, the NLL and the microseconds per step of each fire.

    All fires start from the same state. Spatial filters learn the correlations between cells as
    they run, so they filter all fires twice, and only the second run is scored.
    """
    exact = np.eye(3)[fires[0][0][0]].transpose(2, 0, 1)
    it = belief.known(forest, prior=exact, kind=kind)
    for _, frames in fires if "spatial" in kind else ():
        it.reset(keep_correlations=True)
        run(it, frames)
    found = []
    for states, frames in fires:
        scores = belief.score(it, frames, states, keep_correlations=True)
        it.reset(keep_correlations=True)
        start = time.perf_counter()
        run(it, frames)
        micros = 1e6 * (time.perf_counter() - start) / len(frames)
        found.append((np.median(scores.accuracy[1:]), scores.log_loss[1:].mean(), micros))
    return found


def run(it: belief.Belief, frames: NDArray[np.uint8]) -> None:
    """Runs a filter through one fire."""
    for frame in frames:
        it.correct(frame)
        it.predict()


def main() -> None:
    """Scores filters of the known model on recorded fires."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("fires", type=Path, nargs="+", help="files of recorded fires (.npz)")
    kinds = [name for name, kind in belief.kinds().items() if not kind.needs_checkpoint]
    parser.add_argument("--kinds", default=",".join(kinds), help="kinds of belief, comma-separated")
    args = parser.parse_args()
    for path in args.fires:
        print(f"\n{path.name}\n")
        score(list(recorded(path)), args.kinds.split(","))


if __name__ == "__main__":
    main()
