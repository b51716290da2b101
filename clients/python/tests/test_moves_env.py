"""`emberwatch/WildfireMoves-v0`, compared with `Wildfire-v0` flown by the same moves."""

import gymnasium
import numpy as np
from environments import MOVES, assert_same, make, rollout, serving
from failures import fails, refuses


def test_the_world_moves_after_a_whole_path() -> None:
    env = make(MOVES)
    transitions = rollout(env, 9, seed=1)
    steps = [transition[-1]["step"] for transition in transitions]
    assert steps == [0, 0, 0, 0, 1, 1, 1, 1, 2, 2]
    for begin in (0, 4):
        for transition in transitions[begin : begin + 4]:
            assert_same(transition[0]["frame"], transitions[begin][0]["frame"])
    moves = [transition[0]["move"] for transition in transitions]
    assert moves == [0, 1, 2, 3, 0, 1, 2, 3, 0, 1]
    assert {type(move) for move in moves} == {np.int64}


def test_the_truth_is_revealed_only_on_request() -> None:
    env = make(MOVES, reward="move", render_mode="rgb_array")
    plain = make(MOVES, render_mode="rgb_array")
    for one in (env, plain):
        assert "truth" not in one.reset(seed=3)[1]
    assert_same(env.render(), plain.render())


def test_max_episode_steps_counts_moves() -> None:
    env = make(MOVES, max_episode_steps=6)
    transitions = rollout(env, 6, seed=1)
    assert [transition[3] for transition in transitions[1:]] == [False] * 5 + [True]
    # The unfinished path is forgotten.
    observation, info = env.reset(seed=1)
    assert_same((observation, info), transitions[0])
    env.close()
    assert gymnasium.spec(MOVES).max_episode_steps == 64_000


def test_move_rewards_need_published_truth_and_a_model() -> None:
    with serving() as instance, refuses("expected a server started with --publish-truth"):
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


def test_resume_begins_a_new_path_at_the_robots_cell() -> None:
    with serving() as instance:
        first = make(instance=instance)
        first.reset(seed=1)
        left = first.step([1, 1, 3, 3])
        first.close()
        env = make(MOVES, instance=instance, observation=("frame", "robot", "visited", "move"))
        observation, info = env.reset(options={"resume": True})
        mask = info.pop("action_mask")
        assert mask.tolist() == env.unwrapped.action_masks().tolist()
        assert_same(info, left[4])
        for part in ("frame", "robot"):
            assert_same(observation[part], left[0][part])
        assert observation["move"] == 0 and not observation["visited"].any()
        last = [env.step(1) for _ in range(4)][-1]
        assert last[4]["step"] == 2 and last[0]["robot"].tolist() == [6, 2]
