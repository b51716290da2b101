"""Warnings about worlds that are of little use, or are meant for tests."""

import inspect
import warnings
from collections.abc import Sequence

import numpy as np

from emberwatch._native import FIRST_TRAINING_SEED
from emberwatch.client.wire import StepAnswer
from emberwatch.envs.settings import WorldSpec
from emberwatch.errors import TrainingOnTestWorldsWarning
from emberwatch.model.tasks import Task


def warn_without_rewards(spec: WorldSpec) -> None:
    """Warns if no state of the worlds has a reward."""
    described = spec.described
    if described is not None and not described.reward.any():
        kind = "model" if spec.description is None else "description"
        warn(
            f"{kind} {described.name!r}: no state pays: every reward will be 0; give a state "
            f"a `reward` in the {kind}'s file"
        )


def about_barren_worlds(spec: WorldSpec, answer: StepAnswer) -> str | None:
    """Returns advice if simulated worlds begin with no cell in the state that pays most."""
    worlds = answer.worlds
    barren = np.flatnonzero((worlds["n_target_cells"] == 0) & (worlds["step"] == 0))
    if spec.is_recorded or not len(barren):
        return None
    return (
        f"no cell of world {barren[0]} is in the state that pays most (the same in "
        f"{len(barren)} of {len(worlds)} worlds): use a longer burn_in (0 for a model that dies "
        "out), a larger grid, or a model for small grids, model='wildfire-small'"
    )


def warn_of_test_worlds(task: Task | None, seeds: Sequence[int]) -> None:
    """Warns if episodes begin with seeds that a task reserves for tests."""
    if task is None or not any(seed in task.test_seeds for seed in seeds):
        return
    tests, others = task.test_seeds, max(FIRST_TRAINING_SEED, task.test_seeds.stop)
    # Attributed to this line instead of the caller's, so that Python shows it once per process.
    warnings.warn(
        f"task {task.name!r}: an episode begins on a test world (seeds {tests.start} to "
        f"{tests.stop - 1}); train on seeds from {others} on, with reset(seed={others}) or a "
        f"trainer's seed={others}; to test, use emberwatch.benchmark.evaluate, or ignore "
        "emberwatch.TrainingOnTestWorldsWarning with warnings.filterwarnings",
        TrainingOnTestWorldsWarning,
        stacklevel=1,
    )


def warn(message: str) -> None:
    """Warns at the caller's line: the innermost one outside this package and Gymnasium."""
    frame, level = inspect.currentframe(), 1
    while frame and frame.f_globals["__name__"].partition(".")[0] in ("emberwatch", "gymnasium"):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)
