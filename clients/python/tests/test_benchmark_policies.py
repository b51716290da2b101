"""The arguments that `evaluate` passes to a policy, and the results that it accepts."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import WORLDS, wall
from environments import MOVES, WILDFIRE
from failures import refuses
from gymnasium import spaces
from numpy.typing import NDArray

from emberwatch.benchmark import Row, evaluate

N_MOVES = 4


def go(policy: Any, **changes: Any) -> list[Row]:
    keywords = {**WORLDS, "observation": "frame", "seeds": range(3, 6), "steps": 3, **changes}
    return evaluate(policy, name="mine", progress=None, **keywords)


class Counter:
    """A model with a state: it counts its moves in each world, and flies in circles."""

    def __init__(self) -> None:
        self.counts: list[list[int]] = []
        self.starts: list[list[bool]] = []
        self.deterministic: set[bool] = set()

    def step(self, seen: Any, state: Any, starts: Any) -> Any:
        count = np.zeros(len(seen), int) if state is None else state[0]
        if starts is not None:
            self.starts.append(starts.tolist())
            count = np.where(starts, 0, count)
        self.counts.append(count.tolist())
        return count % 4, (count + 1,)


class Recurrent(Counter):
    def predict(
        self, seen: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> Any:
        self.deterministic.add(deterministic)
        return self.step(seen, state, episode_start)


class Forwarding(Recurrent):
    def predict(self, seen: Any, **others: Any) -> Any:  # type: ignore[override]
        assert others.keys() == {"state", "episode_start", "deterministic"}
        return super().predict(seen, **others)


def test_models_and_functions_receive_their_state() -> None:
    for kind in (Recurrent, Forwarding):
        model = kind()
        go(model, batch=2)
        # Worlds 3 and 4 run together, then world 5 from the start.
        counts = list(range(3 * N_MOVES))
        assert model.counts == [[n, n] for n in counts] + [[n] for n in counts], kind
        assert model.starts == [[n == 0] * 2 for n in counts] + [[n == 0] for n in counts]
    counter = Counter()

    def act(frames: Any, state: Any, *, episode_start: Any) -> Any:
        return counter.step(frames, state, episode_start)

    go(act, batch=2)
    assert (counter.counts, counter.starts) == (model.counts, model.starts)
    model = Recurrent()
    go(model.predict, deterministic=False)
    assert model.counts[-1] == [3 * N_MOVES - 1] * 3 and model.deterministic == {False}


@pytest.mark.parametrize("n_worlds", [1, 2, 3])
@pytest.mark.parametrize("env", [MOVES, WILDFIRE])
def test_actions_are_accepted_in_any_form(env: str, n_worlds: int) -> None:
    shape = (n_worlds,) if env == MOVES else (n_worlds, N_MOVES)
    ones, options = np.ones(shape, int), {"env": env, "seeds": range(3, 3 + n_worlds)}
    whole = [row.mean_reward for row in go(lambda _: ones, **options)]
    predicts: list[Callable[..., Any]] = [
        *(
            lambda self, seen, outcome=outcome: outcome
            for outcome in (ones, (ones, None), ones.tolist(), tuple(ones), tuple(ones.tolist()))
        ),
        lambda self, seen, state: ones,
    ]
    for predict in predicts:
        model = type("Plain", (), {"predict": predict})()
        for policy in (model, model.predict):
            assert [row.mean_reward for row in go(policy, **options)] == whole


def test_the_first_parameter_is_the_observation() -> None:
    def act(state: Any, mask: Any = None) -> Any:
        assert state.shape == (3, 7, 9, 1) and mask is None
        return np.zeros(len(state), int)

    go(act)
    go(type("Named", (), {"predict": lambda self, state, mask=None: act(state, mask)})())


def test_invalid_actions_are_named() -> None:
    for outcome, problem in (
        ((np.ones(3, int), np.zeros(3)), "policy: it returns a state with its actions, but has"),
        (([1, 2], [1, 2, 3]), "policy: expected actions, got tuple: "),
        (np.ones(4, int), r"action: expected integers of shape \(3,\), got int64 \(4,\)"),
        (np.ones(3), r"action: expected integers of shape \(3,\), got float64 \(3,\)"),
        (None, r"action: expected integers of shape \(3,\), got object \(\)"),
    ):
        with refuses(problem):
            go(lambda _, outcome=outcome: outcome)


@pytest.fixture
def walled(tmp_path: Path) -> Path:
    return wall(tmp_path)


class Masked:
    """Imitates MaskablePPO."""

    def __init__(self) -> None:
        self.masks: list[NDArray[np.bool_]] = []

    def predict(
        self,
        seen: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
        action_masks: Any = None,
    ) -> Any:
        if action_masks is None:
            return np.zeros((len(seen), N_MOVES), int), None
        self.masks.append(action_masks)
        return np.argmax(action_masks, axis=1), None


def test_models_and_functions_receive_masks(walled: Path) -> None:
    model, masks = Masked(), []

    def act(frames: Any, action_masks: NDArray[np.bool_]) -> Any:
        masks.append(action_masks)
        return np.argmax(action_masks, axis=1)

    rows, others = go(model, model=walled), go(act, model=walled)
    assert len(masks) == 3 * N_MOVES
    assert all(mask.shape == (3, 4) and mask.dtype == np.bool_ for mask in masks)
    assert np.array_equal(masks, model.masks) and not np.all(masks)
    assert [row.mean_reward for row in rows] == [row.mean_reward for row in others]
    # Every masked move takes its robot to another cell.
    assert all(row.mean_distinct_cells > 1 for row in rows)
    masks.clear()
    go(act, model=walled, robots=2)
    assert {mask.shape for mask in masks} == {(6, 4)}
    go(Masked(), env=WILDFIRE)
    with refuses("env: expected an environment with action masks, .* got one without"):
        go(lambda frames, action_masks: 0, env=WILDFIRE)


FRAME = spaces.Box(0, 255, (7, 9, 1), np.uint8)


def test_a_model_for_other_observations_is_refused() -> None:
    model: Any = Recurrent()
    for space, words in (
        (spaces.Box(0, 255, (7, 9, 4), np.uint8), r"wrap=, such as lambda worlds: VecFrameStack\("),
        (spaces.Box(-10, 10, (7, 9, 1), np.float32), r"wrap=.*: VecNormalize.load\('stat"),
        (spaces.Dict({"frame": FRAME}), "pass the observation= of"),
        (spaces.Discrete(4), r"that it was trained on, Discrete\(4\), got Box"),
    ):
        model.observation_space = space
        for policy in (model, model.predict):
            with refuses("policy: expected the observations .*" + words):
                go(policy)
    assert model.counts == []
    for space in (FRAME, spaces.Box(0, 255, (1, 7, 9), np.uint8)):  # channels first
        model.observation_space = space
        go(model)


def test_a_policy_is_told_when_new_worlds_begin() -> None:
    begun: list[int] = []

    class Begun(Recurrent):
        def begin(self, n_worlds: int) -> None:
            begun.append(n_worlds)

    go(Begun(), batch=2)
    assert begun == [2, 1]
