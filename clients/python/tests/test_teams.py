"""Several robots of one world through the plain client: leases, paths, frames of the team."""

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from environments import SMALL, WILDFIRE
from failures import fails
from processes import PATIENCE, at_once, eventually, server

import emberwatch.benchmark
from emberwatch import errors
from emberwatch.benchmark import evaluate
from emberwatch.client.wire import StepAnswer


def paths(n_robots: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 4, (n_robots, 6))


def test_robots_are_numbered_through_all_worlds() -> None:
    started = server(worlds=3, robots=2)
    client = started.connect()
    assert (client.info.n_worlds, client.info.n_robots) == (3, 2)
    lease = client.acquire(2, 3)
    assert (lease.robots, lease.worlds) == (range(2, 5), range(1, 3))
    assert [(info.world, info.robots) for info in lease.start] == [
        (1, ((0, 0), (4, 6))),
        (2, ((0, 0), (4, 6))),
    ]
    answer = lease.step(paths(3))
    assert answer.world_of.tolist() == [0, 0, 1]
    assert answer.worlds["hovered"].tolist() == [0, 0b10]
    holders = [world.holder_pids for world in started.status().worlds]
    us = holders[1][0]
    assert us is not None and holders == [(None, None), (us, us), (us, None)]


def test_frames_of_a_team_are_what_its_robots_saw() -> None:
    lease = server(worlds=2, robots=3).connect().acquire(0, 6)
    answer = lease.step(paths(6))
    expected = answer.frames.reshape(2, 3, 5, 7).min(axis=1)
    assert (expected != 255).sum() > (answer.frames != 255).sum() / 6
    for team in (
        lease.observe(team=True),
        lease.client.observe(0, 6, team=True),
        lease.client.recall(1, 0, 6, team=True),
    ):
        assert (team.frames == expected).all() and (team.results == answer.results).all()
    seen = lease.client.observe(4, team=True)
    assert (seen.frames[0] == expected[1]).all() and len(seen.robots) == 1
    flown = lease.step(paths(6, seed=1), team=True)
    assert (flown.frames == lease.observe().frames.reshape(2, 3, 5, 7).min(axis=1)).all()


def test_a_step_waits_for_all_robots_that_are_held() -> None:
    started = server(robots=3)
    one, other = started.connect().acquire(0), started.connect().acquire(2)
    waits = threading.Event()

    def later() -> StepAnswer:
        waits.wait(PATIENCE)
        return other.step(paths(1, seed=2))

    def waiting() -> StepAnswer:
        return one.step(paths(1, seed=1), timeout=PATIENCE)

    def watch() -> None:
        assert eventually(lambda: started.status().worlds[0].n_paths == 1)
        assert started.status().worlds[0].step == 0
        waits.set()

    first, second, _ = at_once(waiting, later, watch)
    assert first.result().world == second.result().world
    assert (first.result().world.step, first.result().world.hovered) == (1, 0b010)


def test_a_request_names_all_robots_of_its_client() -> None:
    started = server(worlds=2, robots=2)
    lease = started.connect().acquire(0, 4)
    for robots, missing in ((range(0, 1), 1), (range(1, 3), 0), (range(0, 3), 3)):
        with fails("incomplete", match=f"robot {missing} is missing") as refused:
            lease.step(paths(len(robots)), robots=robots)
        assert refused.value.detail == missing
    assert lease.step(paths(2), robots=range(2, 4)).result().world.step == 1
    assert lease.observe().worlds["step"].tolist() == [0, 1]
    # Each world has a k of its own.
    assert lease.step(paths(4)).worlds["step"].tolist() == [1, 2]


def test_a_late_path_is_refused_and_observing_goes_on() -> None:
    started = server(robots=2, deadline_ms=30)
    quick, slow = started.connect().acquire(0), started.connect().acquire(1)
    for _ in range(3):
        assert quick.step(paths(1)).worlds["late"].tolist() == [0b10]
    with fails("late", match="the world is at step 3 already") as refused:
        slow.step(paths(1))
    assert refused.value.detail == 3
    with fails("late"):
        slow.step(paths(1))
    world, robot = slow.observe().result()
    assert (world.step, robot.n_moves, robot.start, robot.cell) == (3, 0, (4, 6), (4, 6))
    answers = at_once(lambda: slow.step(paths(1)), lambda: quick.step(paths(1)))
    assert [answer.result().world.late for answer in answers] == [0, 0]
    assert answers[0].result().robot.n_moves == 6


def test_a_robot_is_taken_over_and_its_world_goes_on() -> None:
    started = server(robots=2)
    lease = started.connect().acquire(0, 2)
    lease.step(paths(2))
    other = started.connect().acquire(1, takeover=True)
    assert other.start[0].step == 1
    with pytest.raises(errors.LeaseLostError) as lost:
        lease.step(paths(2))
    assert lost.value.detail > 0
    with fails("busy"):
        lease.reset([3])
    first, second = at_once(
        lambda: lease.step(paths(1), robots=range(1)), lambda: other.step(paths(1))
    )
    assert first.result().world == second.result().world
    assert first.result().world.step == 2


def test_beliefs_are_left_for_each_robot() -> None:
    client = server(robots=2).connect()
    lease = client.acquire(0, 2)
    results = lease.step(paths(2))
    for robot in range(2):
        lease.leave_belief(results.result(robot), "bytes", bytes([robot]) * 9, robot=robot)
    left = [client.belief(robot) for robot in range(2)]
    assert [one and one.data for one in left] == [bytes(9), b"\1" * 9]


def test_a_snapshot_has_all_robots(tmp_path: Path) -> None:
    client = server(robots=3).connect()
    lease = client.acquire(0, 3)
    lease.step(paths(3))
    (written,) = client.snapshot(tmp_path / "lab.snapshot")
    ahead = lease.step(paths(3, seed=1))
    assert lease.restore(tmp_path / "lab.snapshot") == (written,)
    again = lease.step(paths(3, seed=1))
    assert (again.frames == ahead.frames).all() and (again.results == ahead.results).all()


def test_observers_see_who_flew() -> None:
    started = server(robots=3, deadline_ms=30)
    lease = started.connect().acquire(0)
    late = started.connect().acquire(2)
    with emberwatch.observe(started.instance, timeout=PATIENCE) as observer:
        answer = lease.step(paths(1))
        frame = next(frame for frame in observer if frame.result.step == 1)
    assert frame.result == answer.result().world
    assert (frame.result.hovered, frame.result.late) == (0b010, 0b100)
    assert [robot.path.tolist() for robot in frame.robots] == [paths(1)[0].tolist(), [], []]
    assert (frame.frame == answer.frames[0]).all()
    late.release()


def test_a_team_is_evaluated_as_a_whole(tmp_path: Path) -> None:
    def fly(_: Any) -> np.ndarray:
        return np.tile(np.array([[1, 1, 1, 1], [1, 1, 3, 3]]), (len(_["robot"]) // 2, 1))

    keywords: Any = {**SMALL, "start": "centre", "env": WILDFIRE, "progress": None}
    keywords |= {"seeds": [1000, 1001], "steps": 5, "csv": tmp_path / "team.csv"}
    rows = evaluate(fly, name="both", robots=2, **keywords)
    assert [(row.robots, row.team) for row in rows] == [(2, "alone")] * 2
    shared = evaluate(fly, name="both", robots=2, observation=("robot", "team"), **keywords)
    assert [row.team for row in shared] == ["shared"] * 2
    assert [row.mean_reward for row in shared] == [row.mean_reward for row in rows]
    # The first step: two cells together, then two more each; later they press against the edge.
    assert all(0.0 < row.mean_repeated < 0.5 for row in rows)
    assert all(row.mean_distinct_cells < 8 for row in rows)
    assert len(emberwatch.benchmark.read(tmp_path / "team.csv")) == 4


def test_files_from_before_teams_and_figures_of_merit_are_read(tmp_path: Path) -> None:
    file = tmp_path / "old.csv"
    head = "policy,estimator,world_seed,steps,mean_reward,mean_distinct_cells,hit_rate,"
    head += "mean_fire_cells,mean_plan_millis,brier,moves"
    file.write_text(f"{head}\nmine,none,3,5,1.5,4.0,0.5,7.0,0.1,,8\n")
    (row,) = emberwatch.benchmark.read(file)
    assert (row.moves, row.robots, row.team, row.mean_repeated) == (8, 1, "alone", 0.0)
    file.write_text(
        f"{head},robots,team,mean_repeated\nmine,none,3,5,1.5,4.0,0.5,7.0,0.1,,8,2,both,0.5\n"
    )
    (row,) = emberwatch.benchmark.read(file)
    assert (row.robots, row.team, row.mean_repeated, row.recent_steps) == (2, "both", 0.5, None)
