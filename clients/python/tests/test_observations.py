"""Parts of observations: their contents, and agreement of single and vector environments."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from environments import (
    LIVELY,
    MOVES,
    WILDFIRE,
    actions,
    assert_same,
    make,
    make_vec,
    no_warnings,
    rollout,
    serving,
)
from failures import refuses

from emberwatch.belief import known
from emberwatch.envs.last_seen import LastSeen
from emberwatch.envs.observations import Observations
from emberwatch.wrappers import BeliefObservation


def test_an_image_is_the_frame_one_hot() -> None:
    for seen in [step[0] for step in rollout(make(observation=("frame", "image")), 9, seed=4)]:
        frame = seen["frame"][..., 0]
        assert np.array_equal(seen["image"], 255 * np.eye(4)[np.where(frame == 255, 3, frame)])


def test_strengths_halve_in_16_steps_and_ages_stop_at_255() -> None:
    row, frame = np.array([True]), np.array([[[2, 255]]], np.uint8)
    seen = LastSeen(1, 1, 2, 3)
    seen.reset(row, frame)
    strengths = [seen.fading(row)[0, 0].tolist()]
    for _ in range(300):
        seen.update(row, np.full_like(frame, 255))
        strengths.append(seen.fading(row)[0, 0].tolist())
    assert [strengths[age] for age in (0, 16, 32)] == [
        [[0, 0, n], [0, 0, 0]] for n in (255, 128, 64)
    ]
    assert seen.ages.tolist() == [[[255, 255]]]


@pytest.mark.parametrize("name", [WILDFIRE, MOVES])
def test_the_belief_part_is_the_filters_prediction(name: str) -> None:
    env, filtered = make(name, observation="belief"), BeliefObservation(make(name), kind="known")
    seen = [env.reset(seed=5)[0], *(env.step(action)[0] for action in actions(env, 9))]
    filtered.reset(seed=5)
    for number, action in enumerate(actions(env, 9), 1):
        posterior = filtered.step(action)[0]
        predictor = known(filtered.unwrapped.model, prior=posterior, kind="known")
        predictor.predict()
        assert np.array_equal(seen[number], np.rint(255 * predictor.belief.transpose(1, 2, 0)))
    assert not np.array_equal(seen[0], seen[9])


def test_a_belief_needs_a_revealed_model() -> None:
    with serving(reveal_model=False) as instance:
        for part in ("belief", "local"):
            with refuses("observation: expected a server that reveals its mo"):
                make(MOVES, instance=instance, observation=part)


#: Parts that remember frames, and parts about a path.
OF_PATHS = ("frame", "age", "belief")
OF_MOVES = (*OF_PATHS, "local", "recent", "visited", "move")

#: Environments: how to make one, its observation and its number of steps before it is left.
JOINED: dict[str, tuple[Callable[..., Any], tuple[str, ...], int]] = {
    "path": (make, OF_PATHS, 9),
    "moves": (partial(make, MOVES), OF_MOVES, 12),
    "paths": (partial(make_vec, 3), OF_PATHS, 9),
    "many moves": (partial(make_vec, 3, MOVES), OF_MOVES, 12),
}


@pytest.mark.parametrize("of", JOINED)
def test_a_joined_episode_continues_from_the_recalled_frames(of: str) -> None:
    maker, parts, n_steps = JOINED[of]
    with serving(model=LIVELY, worlds=3) as instance:
        first = maker(instance=instance, observation=parts)
        last = rollout(first, n_steps, seed=4)[-1][0]
        first.close()
        second = maker(instance=instance, observation=parts)
        joined, _ = second.reset(options={"resume": True})
        assert_same(joined, last)


def test_rows_of_different_steps_join_together(monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(model=LIVELY, worlds=3) as instance:
        first = make_vec(3, instance=instance, observation=OF_PATHS)
        rollout(first, 7, seed=4)
        first.reset(options={"reset_mask": np.array([False, True, False])})
        last = first.step(actions(first, 1)[0])[0]
        first.close()
        update, updates = Observations.update, list[Any]()
        monkeypatch.setattr(
            Observations,
            "update",
            lambda self, moved, *seen: (updates.append(moved), update(self, moved, *seen)),
        )
        second = make_vec(3, instance=instance, observation=OF_PATHS)
        assert_same(second.reset(options={"resume": True})[0], last)
        # One update for each step after the first, not for each step of each row.
        assert np.array(updates).sum(axis=0).tolist() == [8, 1, 8] and len(updates) == 8


@pytest.mark.parametrize("of", JOINED)
def test_a_resumed_environment_continues_its_own_path_and_memory(of: str) -> None:
    maker, parts, n_steps = JOINED[of]
    whole, halved = (maker(observation=parts) for _ in range(2))
    chosen = actions(whole, n_steps + 9)
    for env in (whole, halved):
        env.reset(seed=4)
    before: Any = None
    for step, action in enumerate(chosen):
        expected = whole.step(action)
        if step in (n_steps // 2 - 1, n_steps):
            assert_same(halved.reset(options={"resume": True})[0], before)
        assert_same(halved.step(action), expected)
        before = expected[0]


def test_a_robot_joins_its_team_with_its_earlier_frames() -> None:
    with serving(model=LIVELY, robots=2) as instance:
        first = make(instance=instance, robot=1, observation=OF_PATHS)
        last = rollout(first, 9, seed=None)[-1][0]
        first.close()
        second = make(instance=instance, robot=1, observation=OF_PATHS)
        assert_same(second.reset()[0], last)


def test_a_gap_before_the_kept_frames_causes_one_warning() -> None:
    with serving(model=LIVELY, history=3) as instance:
        first = make(instance=instance)
        rollout(first, 9, seed=4)
        first.close()
        second = make(instance=instance, observation=OF_PATHS)
        with pytest.warns(UserWarning, match="joins an episode whose first . steps are no longer"):
            joined, _ = second.reset(options={"resume": True})
        ages = np.unique(joined["age"]).tolist()
        assert ages[-1] == 255 and max(ages[:-1]) <= 3
        with no_warnings():
            BeliefObservation(second).reset(options={"resume": True})


def test_a_belief_never_continues_another_episode_with_the_same_last_frame() -> None:
    flown, others = ((0, 0, 2), (3, 2, 2))  # both observe only the corner at last
    with serving(model=LIVELY) as instance:
        first, second = (
            BeliefObservation(make(instance=instance, observation="frame"), keep=True)
            for _ in range(2)
        )
        n_same = 0
        for seed in range(3):
            last = []
            for env, moves in ((first, flown), (second, others)):
                env.reset(seed=seed)
                last.append([env.step([move] * 4)[0] for move in moves][-1])
                env.close()
            joined, _ = first.reset(options={"resume": True})
            first.close()
            assert_same(joined, last[1])
            n_same += np.array_equal(last[0]["frame"], last[1]["frame"])
        assert n_same > 0
