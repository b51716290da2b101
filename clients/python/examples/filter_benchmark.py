"""Scores filters on the forest fires of N. Haksar, J. Lorenzetti and M. Schwager (CDC 2019).

    python filter_benchmark.py                          # on simulated fires
    python filter_benchmark.py --fires fires-all.npz    # on recorded fires

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
HEALTHY, BURNING, BURNT = range(3)
RATES = np.linspace(0.1, 0.4, SIDE)  # a: probability of ignition per burning neighbour, by column
BURNS_ON = float(np.exp(-0.1))
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
base = {1.0 - BURNS_ON}
"""  # noqa: E501


def model() -> Model:
    """Returns the fire's model: exactly the rule above, with a map of the rates."""
    rate = np.tile(np.log1p(-RATES) / np.log1p(-0.1), (SIDE, 1))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "forest.toml"
        path.write_text(MODEL)
        np.savez(path.with_name("forest.npz"), rate=rate)
        return Model.named(path)


def burn(random: np.random.Generator) -> NDArray[np.uint8]:
    """Simulates one fire until nothing burns; states of shape (K, 25, 25)."""
    state = np.zeros((SIDE, SIDE), np.uint8)
    state[11:15, 11:15] = BURNING
    states = [state]
    while (state == BURNING).any():
        burning = np.pad(state == BURNING, 1).astype(int)
        near = burning[:-2, 1:-1] + burning[2:, 1:-1] + burning[1:-1, :-2] + burning[1:-1, 2:]
        ignites = random.random(state.shape) < 1.0 - (1.0 - RATES) ** near
        burns_out = random.random(state.shape) > BURNS_ON
        next_state = state.copy()
        next_state[(state == HEALTHY) & ignites] = BURNING
        next_state[(state == BURNING) & burns_out] = BURNT
        states.append(state := next_state)
    return np.stack(states)


def observe(
    states: NDArray[np.uint8], seen: NDArray[np.bool_], random: np.random.Generator
) -> NDArray[np.uint8]:
    """Returns frames that show the trees marked in `seen`."""
    shown = (states + random.choice(3, states.shape, p=[0.9, 0.05, 0.05])) % 3
    return np.where(seen, shown, 255).astype(np.uint8)


def window(steps: int, random: np.random.Generator) -> NDArray[np.bool_]:
    """Returns masks of the 9 x 9 trees that a camera sees as it flies between random points."""
    seen = np.zeros((steps, SIDE, SIDE), bool)
    at, goal = np.array([12, 12]), np.array([12, 12])
    for step in range(steps):
        while (at == goal).all():
            goal = random.integers(4, SIDE - 4, 2)
        at = at + np.sign(goal - at)
        seen[step, at[0] - 4 : at[0] + 5, at[1] - 4 : at[1] + 5] = True
    return seen


def simulated(which: str, n_fires: int, seed: int) -> Iterator[Fire]:
    """Simulates fires. `which` selects the observed trees: "all", "tenth" or "window"."""
    for fire in range(n_fires):
        random = np.random.default_rng([seed, fire])
        states = burn(random)
        seen = np.ones(states.shape, bool)
        if which == "tenth":
            seen = random.random(states.shape) < 0.1
        elif which == "window":
            seen = window(len(states), random)
        yield states, observe(states, seen, random)


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
    """Scores filters of the known model on simulated or recorded fires."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--fires", type=Path, action="append", help="file of recorded fires (.npz); repeatable"
    )
    parser.add_argument(
        "--simulate", type=int, default=12, metavar="N", help="number of simulated fires"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the simulated fires")
    kinds = [name for name, kind in belief.kinds().items() if not kind.needs_checkpoint]
    parser.add_argument("--kinds", default=",".join(kinds), help="kinds of belief, comma-separated")
    args = parser.parse_args()
    for path in args.fires or []:
        print(f"\n{path.name}\n")
        score(list(recorded(path)), args.kinds.split(","))
    for which in ("all", "tenth", "window") if args.fires is None else ():
        print(f"\n{args.simulate} simulated fires, seen: {which}\n")
        score(list(simulated(which, args.simulate, args.seed)), args.kinds.split(","))


if __name__ == "__main__":
    main()
