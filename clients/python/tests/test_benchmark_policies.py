"""The arguments that `evaluate` passes to a policy, and the results that it accepts."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import play, wall
from environments import MOVES, WILDFIRE
from failures import refuses
from gymnasium import spaces
from numpy.typing import NDArray

N_MOVES, N_STEPS = 4, 5


class Recurrent:
    """A model with a state: it counts its moves in each world, and flies in circles."""

    def __init__(self) -> None:
        self.calls: list[Any] = []
        self.begun: list[int] = []

    def begin(self, n_worlds: int) -> None:
        self.begun.append(n_worlds)

    def predict(
        self, seen: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> Any:
        count = np.zeros(len(seen), int) if state is None else np.where(episode_start, 0, state)
        self.calls.append((count.tolist(), episode_start.tolist(), deterministic))
        return count % 4, count + 1


@pytest.mark.parametrize("deterministic", [False, True])
def test_models_receive_their_state(deterministic: bool) -> None:
    model = Recurrent()
    play(model, batch=2, deterministic=deterministic)
    # Worlds 3 and 4 run together, then world 5 from the start.
    moves = [(n, rows) for rows in (2, 1) for n in range(N_STEPS * N_MOVES)]
    assert model.calls == [([n] * rows, [n == 0] * rows, deterministic) for n, rows in moves]
    assert model.begun == [2, 1]


@pytest.mark.parametrize("env", [MOVES, WILDFIRE])
def test_functions_return_arrays_or_lists(env: str) -> None:
    ones, options = np.ones((3,) if env == MOVES else (3, N_MOVES), int), {"env": env}
    whole = [row.mean_reward for row in play(lambda _: ones, **options)]
    for outcome in (ones.tolist(), tuple(ones)):
        rows = play(lambda _, outcome=outcome: outcome, **options)
        assert [row.mean_reward for row in rows] == whole


@pytest.mark.parametrize(
    ("outcome", "problem"),
    [
        ((np.ones(3, int), None), "policy: expected actions, without a state, got tuple: "),
        (np.ones(4, int), r"action: expected integers of shape \(3,\), got int64 \(4,\)"),
    ],
)
def test_invalid_actions_are_named(outcome: Any, problem: str) -> None:
    with refuses(problem):
        play(lambda _: outcome)


class Masked:
    """A model that makes the first unmasked move."""

    def __init__(self) -> None:
        self.masks: list[NDArray[np.bool_]] = []

    def predict(self, seen: Any, action_masks: Any = None, **_: Any) -> Any:
        self.masks.append(action_masks)
        return np.argmax(action_masks, axis=1), None


def test_a_model_receives_masks(tmp_path: Path) -> None:
    model = Masked()
    rows = play(model, model=wall(tmp_path))
    assert len(model.masks) == N_STEPS * N_MOVES and not np.all(model.masks)
    assert all(mask.shape == (3, 4) and mask.dtype == np.bool_ for mask in model.masks)
    # Every masked move takes its robot to another cell.
    assert all(row.mean_distinct_cells > 1 for row in rows)
    play(model, robots=2)
    assert model.masks[-1].shape == (6, 4)
    with refuses("env: expected an environment with action masks, .* got one without"):
        play(model, env=WILDFIRE)


FRAME = spaces.Box(0, 255, (7, 9, 1), np.uint8)


def test_a_model_for_other_observations_is_refused() -> None:
    model: Any = Recurrent()
    stacked, normalized = spaces.Box(0, 255, (7, 9, 4), np.uint8), spaces.Box(-10, 10, (7, 9, 1))
    for other in (stacked, normalized, spaces.Dict({"frame": FRAME}), spaces.Discrete(4)):
        model.observation_space = other
        with refuses("policy: expected the observations .*: pass the observation= .* wrap=, s"):
            play(model)
    assert model.calls == []
    for fits in (FRAME, spaces.Box(0, 255, (1, 7, 9), np.uint8)):  # channels first
        model.observation_space = fits
        play(model)
