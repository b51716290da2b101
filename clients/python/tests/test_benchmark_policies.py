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


class Forwarding(Recurrent):
    def predict(self, seen: Any, **others: Any) -> Any:  # type: ignore[override]
        return super().predict(seen, **others)


@pytest.mark.parametrize("deterministic", [False, True])
def test_models_and_functions_receive_their_state(deterministic: bool) -> None:
    plain, model, forwarding = Recurrent(), Recurrent(), Forwarding()

    def act(frames: Any, state: Any, *, episode_start: Any) -> Any:
        return plain.predict(frames, state, episode_start, deterministic)

    for policy in (act, model, forwarding):
        play(policy, batch=2, deterministic=deterministic)
    # Worlds 3 and 4 run together, then world 5 from the start.
    moves = [(n, rows) for rows in (2, 1) for n in range(N_STEPS * N_MOVES)]
    expected = [([n] * rows, [n == 0] * rows, deterministic) for n, rows in moves]
    assert plain.calls == model.calls == forwarding.calls == expected
    assert (plain.begun, model.begun) == ([], [2, 1])


@pytest.mark.parametrize("n_worlds", [1, 2, 3])
@pytest.mark.parametrize("env", [MOVES, WILDFIRE])
def test_actions_are_accepted_in_any_form(env: str, n_worlds: int) -> None:
    shape = (n_worlds,) if env == MOVES else (n_worlds, N_MOVES)
    ones, options = np.ones(shape, int), {"env": env, "seeds": range(3, 3 + n_worlds)}
    whole = [row.mean_reward for row in play(lambda _: ones, **options)]
    for outcome in (ones, (ones, None), ones.tolist(), tuple(ones), tuple(ones.tolist())):
        model = type("Plain", (), {"predict": lambda self, seen, outcome=outcome: outcome})()
        for policy in (model, model.predict):
            assert [row.mean_reward for row in play(policy, **options)] == whole


@pytest.mark.parametrize(
    ("outcome", "problem"),
    [
        ((np.ones(3, int), np.zeros(3)), "policy: it returns a state with its actions, but has"),
        (([1, 2], [1, 2, 3]), "policy: expected actions, got tuple: "),
        (np.ones(4, int), r"action: expected integers of shape \(3,\), got int64 \(4,\)"),
        (np.ones(3), r"action: expected integers of shape \(3,\), got float64 \(3,\)"),
        (None, r"action: expected integers of shape \(3,\), got object \(\)"),
    ],
)
def test_invalid_actions_are_named(outcome: Any, problem: str) -> None:
    with refuses(problem):
        play(lambda _: outcome)


def test_a_policy_receives_masks(tmp_path: Path) -> None:
    masks: list[NDArray[np.bool_]] = []

    def act(frames: Any, action_masks: NDArray[np.bool_]) -> Any:
        masks.append(action_masks)
        return np.argmax(action_masks, axis=1)

    rows = play(act, model=wall(tmp_path))
    assert len(masks) == N_STEPS * N_MOVES and not np.all(masks)
    assert all(mask.shape == (3, 4) and mask.dtype == np.bool_ for mask in masks)
    # Every masked move takes its robot to another cell.
    assert all(row.mean_distinct_cells > 1 for row in rows)
    play(act, robots=2)
    assert masks[-1].shape == (6, 4)
    play(lambda frames, action_masks=None: np.zeros((len(frames), N_MOVES), int), env=WILDFIRE)
    with refuses("env: expected an environment with action masks, .* got one without"):
        play(act, env=WILDFIRE)


FRAME = spaces.Box(0, 255, (7, 9, 1), np.uint8)


def test_a_model_for_other_observations_is_refused() -> None:
    model: Any = Recurrent()
    stacked, normalized = spaces.Box(0, 255, (7, 9, 4), np.uint8), spaces.Box(-10, 10, (7, 9, 1))
    for other in (stacked, normalized, spaces.Dict({"frame": FRAME}), spaces.Discrete(4)):
        model.observation_space = other
        for policy in (model, model.predict):
            with refuses("policy: expected the observations .*: pass the observation= .* wrap=, s"):
                play(policy)
    assert model.calls == []
    for fits in (FRAME, spaces.Box(0, 255, (1, 7, 9), np.uint8)):  # channels first
        model.observation_space = fits
        play(model)
