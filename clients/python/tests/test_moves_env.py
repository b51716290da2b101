"""`emberwatch/WildfireMoves-v0` against `Wildfire-v0` flown with the same moves."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import MOVES, SMALL, actions, assert_same, make, rollout, serving
from failures import fails, refuses
from gymnasium.vector import AsyncVectorEnv

PARTS = ("frame", "robot", "age", "visited", "move")

#: A grid on which worlds of the built-in wildfire burn after this burn-in.
BURNING = {"height": 16, "width": 16, "n_moves": 8, "burn_in": 3000, "model": "wildfire"}

#: Seeds of `BURNING` worlds with fire.
BURNING_SEEDS = [1000, 1004, 1016]


def test_a_path_of_moves_is_a_step_of_the_other_environment() -> None:
    parts = ("frame", "robot", "age")
    moves, paths = make(MOVES, observation=PARTS, truth=True), make(observation=parts, truth=True)
    begun, expected = moves.reset(seed=6), paths.reset(seed=6)
    assert_same({part: begun[0][part] for part in parts}, expected[0])
    assert begun[1].pop("action_mask").tolist() == [0, 1, 0, 1]
    assert_same(begun[1], expected[1])
    for path in actions(paths, 30):
        got = [moves.step(move) for move in path]
        expected = paths.step(path)
        assert_same({part: got[-1][0][part] for part in parts}, expected[0])
        del got[-1][4]["action_mask"]
        assert_same(got[-1][1:], expected[1:])
        assert [transition[1] for transition in got[:-1]] == [0.0, 0.0, 0.0]


def test_the_world_moves_after_a_whole_path() -> None:
    env = make(MOVES)
    steps = [transition[-1]["step"] for transition in rollout(env, 9, seed=1)]
    assert steps == [0, 0, 0, 0, 1, 1, 1, 1, 2, 2]
    moves = [transition[0]["move"] for transition in rollout(env, 9, seed=1)]
    assert moves == [0, 1, 2, 3, 0, 1, 2, 3, 0, 1]
    assert {type(move) for move in moves} == {np.int64}


def test_between_moves_the_frame_is_the_last_paths() -> None:
    env = make(MOVES, observation=PARTS)
    transitions = rollout(env, 12, seed=1)
    for begin in (0, 4, 8):
        first = transitions[begin][0]
        for transition in transitions[begin : begin + 4]:
            assert_same(transition[0]["frame"], first["frame"])
            assert_same(transition[0]["age"], first["age"])


def test_visited_shows_the_cells_of_this_path() -> None:
    env = make(MOVES, start="2,3")
    observation = env.reset(seed=1)[0]
    assert not observation["visited"].any()
    visited = [env.step(move)[0]["visited"] for move in (0, 3, 3)]
    cells = [np.argwhere(mask[..., 0]).tolist() for mask in visited]
    assert cells == [[[1, 3]], [[1, 3], [1, 4]], [[1, 3], [1, 4]]]
    assert visited[0].dtype == np.uint8 and set(np.unique(visited[2])) == {0, 255}
    observation = env.step(1)[0]
    assert not observation["visited"].any()
    assert np.argwhere(observation["frame"][..., 0] != 255).tolist() == [[1, 3], [1, 4], [2, 4]]


@pytest.mark.parametrize(
    ("start", "move", "cell"),
    [("0,0", 0, [0, 0]), ("6,4", 1, [6, 4]), ("0,0", 2, [0, 0]), ("6,4", 3, [6, 4])],
    ids=["up", "down", "left", "right"],
)
def test_the_robot_stays_within_the_grid(start: str, move: int, cell: list[int]) -> None:
    env = make(MOVES, start=start)
    env.reset(seed=1)
    for _ in range(5):
        observation, _, _, _, info = env.step(move)
        assert observation["robot"].tolist() == cell
    assert info["n_visited"] == 1


@pytest.mark.parametrize("seed", BURNING_SEEDS)
def test_both_rewards_sum_to_the_same_over_each_path(seed: int) -> None:
    late, early = make(MOVES, **BURNING), make(MOVES, **BURNING, reward="move")
    infos = [env.reset(seed=seed)[1] for env in (late, early)]
    assert_same(infos[0], infos[1])
    n_early = 0
    total = 0.0
    for path in np.array(actions(late, 40 * 8)).reshape(40, 8):
        paid = [late.step(move)[1] for move in path]
        steps = [early.step(move) for move in path]
        rewards = [step[1] for step in steps]
        assert {type(reward) for reward in rewards} == {float}
        assert sum(rewards) == pytest.approx(sum(paid), abs=1e-9)
        assert "truth" not in steps[-1][4]
        n_early += any(rewards[:-1])
        total += sum(paid)
    assert total > 0 and n_early > 0


def test_a_cell_pays_once_a_path_what_it_was_before_the_world_moved() -> None:
    env = make(MOVES, reward="move", truth=True)
    truth = env.reset(seed=3)[1]["truth"]
    n_late = 0.0
    for path in np.array(actions(env, 200)).reshape(50, 4):
        visited: set[tuple[int, int]] = set()
        for move in path[:-1]:
            observation, reward, _, _, info = env.step(move)
            cell = tuple(observation["robot"].tolist())
            assert reward == (1.0 if truth[cell] == 2 and cell not in visited else 0.0)
            visited.add(cell)
            assert_same(info["truth"], truth)
        early = sum(float(truth[cell] == 2) for cell in visited)
        _, reward, _, _, info = env.step(path[-1])
        assert reward == pytest.approx(info["n_hits"] - early)
        n_late += abs(reward)
        truth = info["truth"]
    assert n_late > 0


def test_the_truth_is_revealed_only_when_asked_for() -> None:
    env = make(MOVES, reward="move", render_mode="rgb_array")
    plain = make(MOVES, render_mode="rgb_array")
    for one in (env, plain):
        assert "truth" not in one.reset(seed=3)[1]
    assert_same(env.render(), plain.render())


def test_episodes_are_truncated_after_max_episode_steps_moves() -> None:
    env = make(MOVES, max_episode_steps=6)
    transitions = rollout(env, 6, seed=1)
    assert [transition[3] for transition in transitions[1:]] == [False] * 5 + [True]
    # The path begun is forgotten.
    observation, info = env.reset(seed=1)
    assert_same((observation, info), transitions[0])
    env.close()
    assert gymnasium.spec(MOVES).max_episode_steps == 64_000


def test_what_was_returned_may_be_written_to() -> None:
    env, twin = make(MOVES, observation=PARTS), make(MOVES, observation=PARTS)
    assert_same(env.reset(seed=1), twin.reset(seed=1))
    for move in actions(twin, 20):
        observation = env.step(move)[0]
        assert_same(observation, twin.step(move)[0])
        for part in ("frame", "age", "visited", "robot"):
            observation[part][:] = 1


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (4, "expected one integer, 0 to 3, got 4"),
        (-1, "got -1"),
        (1.0, "got 1.0"),
        (True, "got True"),
        ([0, 1], r"got \[0, 1\]"),
        ([[0], [1, 2]], "got list: "),
        (None, "got None"),
        ("0", "got '0'"),
    ],
    ids=str,
)
def test_a_wrong_move_is_named_and_not_flown(action: object, message: str) -> None:
    env = make(MOVES).unwrapped
    env.reset(seed=1)
    with refuses(message):
        env.step(action)
    assert env.step(1)[0]["move"] == 1


@pytest.mark.parametrize("kind", [int, np.int64, np.uint8, np.array, lambda n: np.array([n])])
def test_moves_come_as_any_integer(kind: Any) -> None:
    env = make(MOVES)
    env.reset(seed=1)
    assert env.step(kind(1))[0]["robot"].tolist() == [1, 0]


def test_paying_moves_needs_a_server_that_tells_enough() -> None:
    with (
        serving() as instance,
        refuses("expected a server started with --publish-truth"),
    ):
        make(MOVES, instance=instance, reward="move")
    with (
        serving(publish_truth=True, reveal_model=False) as instance,
        refuses("expected a server that reveals its model"),
    ):
        make(MOVES, instance=instance, reward="move")
    with serving(publish_truth=True) as instance:
        env, alone = make(MOVES, instance=instance, reward="move"), make(MOVES, reward="move")
        assert_same(rollout(env, 20, seed=4), rollout(alone, 20, seed=4))
        with fails("busy"):
            make(MOVES, instance=instance).reset()


def test_resume_begins_a_new_path_where_the_world_stands() -> None:
    with serving() as instance:
        first = make(instance=instance)
        first.reset(seed=1)
        left = first.step([1, 1, 3, 3])
        first.close()
        env = make(MOVES, instance=instance, observation=PARTS)
        observation, info = env.reset(options={"resume": True})
        mask = info.pop("action_mask")
        assert mask.tolist() == env.unwrapped.action_masks().tolist()
        assert_same(info, left[4])
        for part in ("frame", "robot"):
            assert_same(observation[part], left[0][part])
        assert observation["move"] == 0 and not observation["visited"].any()
        last = [env.step(1) for _ in range(4)][-1]
        assert last[4]["step"] == 2 and last[0]["robot"].tolist() == [6, 2]


def test_gymnasiums_wrappers_and_workers_take_it() -> None:
    env = gymnasium.wrappers.FlattenObservation(make(MOVES))
    for transition in rollout(env, 5, seed=1):
        assert transition[0] in env.observation_space
    env.close()
    env = gymnasium.wrappers.RecordEpisodeStatistics(make(MOVES, max_episode_steps=8))
    transitions = rollout(env, 8, seed=1)
    rewards = sum(transition[1] for transition in transitions[1:])
    assert transitions[-1][4]["episode"]["r"] == pytest.approx(rewards)
    env.close()
    vector = AsyncVectorEnv([_make_small] * 2)
    try:
        vector.reset(seed=1)
        for _ in range(4):
            infos = vector.step(np.array([1, 3]))[4]
        assert infos["step"].tolist() == [1, 1]
    finally:
        vector.close()
    plain = gymnasium.make_vec(MOVES, num_envs=2, **SMALL)
    assert plain.reset(seed=1)[0]["frame"].shape == (2, 7, 5, 1)


def _make_small() -> gymnasium.Env[Any, Any]:
    return gymnasium.make(MOVES, **SMALL)
