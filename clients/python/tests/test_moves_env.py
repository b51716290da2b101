"""`emberwatch/WildfireMoves-v0`, compared with `Wildfire-v0` flown by the same moves."""

from environments import MOVES, assert_same, make, serving
from failures import refuses


def test_the_truth_is_revealed_only_on_request() -> None:
    env = make(MOVES, reward="move", render_mode="rgb_array")
    plain = make(MOVES, render_mode="rgb_array")
    for one in (env, plain):
        assert "truth" not in one.reset(seed=3)[1]
    assert_same(env.render(), plain.render())


def test_move_rewards_need_published_truth_and_a_model() -> None:
    with serving() as instance, refuses("expected a server started with --publish-truth"):
        make(MOVES, instance=instance, reward="move")
    with (
        serving(publish_truth=True, reveal_model=False) as instance,
        refuses("expected a server that reveals its model"),
    ):
        make(MOVES, instance=instance, reward="move")


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
