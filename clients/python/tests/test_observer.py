"""Observers and truth readers: what is published, who gets it, and what they miss."""

import subprocess
from collections.abc import Callable

import document
import numpy as np
import pytest
from failures import fails, refuses
from processes import PATIENCE, eventually, find, server, services, unused_instance

from emberwatch.client.observer import (
    Frame,
    Observer,
    OutlookReader,
    Truth,
    TruthReader,
    observe,
)

LIMITS = document.limits()
FRAME_BUFFER = LIMITS["FRAME_BUFFER"]


def frames_until(observer: Observer, step: int, world: int = 0, seed: int = 0) -> list[Frame]:
    """Reads frames until that of a step has come; all of them, that one last."""
    frames = []
    while not frames or (frames[-1].world, frames[-1].result.step) != (world, step):
        frame = observer.receive(PATIENCE)
        assert frame is not None, f"no frame of world {world} at step {step}"
        # Of the episode that is meant: a new server's begins with another seed.
        if frame.world != world or frame.result.seed == seed + world:
            frames.append(frame)
    return frames


def truth_at(reader: TruthReader, step: int) -> Truth:
    """Reads hidden states until those of a step of world 0 have come."""
    while True:
        truth = reader.receive(PATIENCE)
        assert truth is not None, f"no hidden states at step {step}"
        if (truth.world, truth.step) == (0, step):
            return truth


def paths(k: int, n_worlds: int = 1) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 4, (n_worlds, 6))


def test_a_frame_is_the_answer_of_its_step_with_the_path_flown() -> None:
    started = server(worlds=2)
    lease = started.connect().acquire(1)
    with observe(started.instance) as observer:
        frames = frames_until(observer, 0, world=1, seed=0)
        start = (0, 0)
        for k in range(1, 21):
            answer = lease.step(paths(k))
            new = frames_until(observer, k, world=1)
            frame = new[-1]
            (robot,) = frame.robots
            assert (frame.result, robot.result) == answer.result()
            assert (robot.frame == answer.frames[0]).all() and robot.frame.dtype == np.uint8
            assert (frame.frame == robot.frame).all()
            assert (robot.path == paths(k)[0]).all()
            assert robot.result.start == start
            start = robot.result.cell
            frames += new
    assert sum(frame.n_lost for frame in frames) == 0


def test_a_reset_is_an_empty_frame_without_a_path() -> None:
    started = server()
    lease = started.connect().acquire()
    with observe(started.instance) as observer:
        lease.step(paths(1))
        frames_until(observer, 1)
        lease.reset([5])
        frame = frames_until(observer, 0, seed=5)[-1]
    (robot,) = frame.robots
    assert (frame.result.seed, frame.result.episode, robot.result.coverage) == (5, 1, 0)
    assert (frame.frame == 255).all() and robot.path.shape == (0,)


def test_a_late_observer_is_greeted_with_the_frame_of_every_world() -> None:
    started = server(worlds=3)
    answer = started.connect().acquire(0, 3).step(paths(0, 3))
    # The second and third come when another has just gone.
    for _ in range(3):
        with observe(started.instance) as observer:
            greeted = {frame.world: frame for frame in [observer.receive(PATIENCE)] if frame}
            while len(greeted) < 3:
                frame = observer.receive(PATIENCE)
                assert frame is not None
                greeted[frame.world] = frame
        for world, frame in greeted.items():
            assert (frame.result, frame.robots[0].result) == answer.result(world)
            assert (frame.frame == answer.frames[world]).all()


def test_only_the_world_asked_for_is_shown() -> None:
    started = server(worlds=3)
    lease = started.connect().acquire(0, 3)
    with observe(started.instance, world=1) as observer:
        lease.step(paths(0, 3))
        lease.step(paths(1, 3))
        frames = frames_until(observer, 2, world=1)
    assert {frame.world for frame in frames} == {1}
    assert sum(frame.n_lost for frame in frames) == 0


def test_what_a_slow_observer_misses_is_counted() -> None:
    started = server()
    lease = started.connect().acquire()
    with observe(started.instance) as slow, observe(started.instance) as quick:
        lease.step(paths(0))
        frames_until(slow, 1), frames_until(quick, 1)
        n_published = 0
        for k in range(2, 2 * FRAME_BUFFER + 1):
            lease.step(paths(k))
            n_published += len(frames_until(quick, k))
        frames = frames_until(slow, 2 * FRAME_BUFFER)
    assert len(frames) == FRAME_BUFFER, "the newest are kept"
    assert frames[0].n_lost == n_published - FRAME_BUFFER
    assert sum(frame.n_lost for frame in frames[1:]) == 0
    steps = [frame.result.step for frame in frames]
    assert steps == list(range(FRAME_BUFFER + 1, 2 * FRAME_BUFFER + 1))


def test_losses_among_other_worlds_are_counted() -> None:
    started = server(worlds=2)
    lease = started.connect().acquire(0, 2)
    with observe(started.instance, world=1) as observer, observe(started.instance) as other:
        frames_until(observer, 0, world=1)
        for k in range(FRAME_BUFFER):
            lease.step(paths(k, 2))
        frames_until(other, FRAME_BUFFER, world=1)  # Published after the answer.
        # World 0 is published first, so that the gap ends at a sample of the other world.
        frames = frames_until(observer, FRAME_BUFFER, world=1)
    # One observer may get the last sample a moment before the other.
    assert abs(len(frames) - FRAME_BUFFER // 2) <= 1
    assert frames[0].n_lost >= FRAME_BUFFER - 2
    assert sum(frame.n_lost for frame in frames[1:]) == 0


def test_an_observer_comes_before_the_server_and_stays_for_the_next() -> None:
    instance = unused_instance()
    with observe(instance) as observer:
        assert observer.receive(0.0) is None
        for seed in (11, 12):
            started = server(instance, seed=seed)
            assert frames_until(observer, 0, seed=seed)[-1].result.seed == seed
            started.connect().acquire().step(paths(0))
            frame = frames_until(observer, 1, seed=seed)[-1]
            assert frame.n_lost == 0
            started.kill()


def test_hidden_states_are_read_only_where_they_are_published() -> None:
    secret = server()
    with TruthReader(secret.instance) as reader:
        secret.connect().acquire().step(paths(0))
        assert reader.receive(0.1) is None


def test_hidden_states_agree_with_the_results() -> None:
    # Ten cells of this world burn after its first step; most seeds begin without a fire.
    started = server(height=12, width=9, burn_in=300, seed=28, publish_truth=True)
    lease = started.connect().acquire()
    n_burning = []
    with TruthReader(started.instance) as reader:
        for k in range(1, 11):
            n_burning.append(lease.step(paths(k)).result().world.n_target_cells)
            truth = truth_at(reader, k)
            assert (truth.episode, truth.seed, truth.n_lost) == (0, 28, 0)
            assert truth.states.shape == (12, 9) and truth.states.max() < 3
            assert np.count_nonzero(truth.states == 2) == n_burning[-1]
    assert n_burning[0] == 10


def test_a_frame_is_a_copy() -> None:
    started = server()
    lease = started.connect().acquire()
    with observe(started.instance) as observer:
        lease.step([3] * 6)
        (first,) = frames_until(observer, 1)[-1].robots
        kept = first.frame.copy(), first.path.copy()
        first_again = first.frame
        lease.step([1] * 6)
        frames_until(observer, 2)
        assert (first_again == kept[0]).all() and (first.path == kept[1]).all()
        first.frame[:] = 0
        first.path[:] = 0
    assert (first.frame == 0).all()


def test_iterating_ends_when_no_frame_comes_in_time() -> None:
    started = server()
    frames: list[Frame] = []
    with observe(started.instance, timeout=0.2) as observer:
        # A server may publish the first frames late.
        assert eventually(lambda: bool(frames.extend(observer) or frames))
    assert all(frame.result.step == 0 for frame in frames)
    assert list(observe(unused_instance(), timeout=0)) == []


@pytest.mark.parametrize("make", [observe, TruthReader])
def test_closing_again_is_fine_and_a_closed_observer_says_so(make: Callable[..., Observer]) -> None:
    observer = make(unused_instance())
    for _ in range(3):
        observer.close()
    with fails("closed", match="closed"):
        observer.receive(0)


def test_a_closed_observer_is_no_longer_counted() -> None:
    started = server()
    with observe(started.instance), observe(started.instance):
        assert eventually(lambda: started.status().n_observers == 2)
    assert eventually(lambda: started.status().n_observers == 0)


def test_an_agent_s_beliefs_are_read() -> None:
    started = server(height=16, width=24, moves=12, burn_in=500)
    command = [find("emberwatch-agent"), "run", "--instance", started.instance]
    with OutlookReader(started.instance) as reader:
        agent = subprocess.Popen(command)
        try:
            last = 0
            while last < 30:
                outlook = reader.receive(PATIENCE)
                assert outlook is not None and outlook.step >= last
                np.testing.assert_allclose(outlook.belief.sum(axis=0), np.ones((16, 24)), atol=1e-4)
                assert outlook.states == ("normal", "latent", "fire")
                assert outlook.policy == "beam_exploit"
                last = outlook.step
            assert (outlook.objective, outlook.pid) == ("fire", agent.pid)
            agent.terminate()
            assert agent.wait(PATIENCE) == 0
        finally:
            agent.kill()


@pytest.mark.parametrize(
    "make, limit",
    [
        (observe, LIMITS["MAX_OBSERVERS"]),
        (TruthReader, LIMITS["MAX_TRUTH_READERS"]),
        (OutlookReader, LIMITS["MAX_AGENT_READERS"]),
    ],
)
def test_one_too_many_is_told_the_limit_and_others_go_on(
    make: Callable[..., Observer], limit: int
) -> None:
    started = server(publish_truth=True)
    readers = [make(started.instance) for _ in range(limit)]
    with fails("channel", match=f"at most {limit} (readers|observers)"):
        make(started.instance)
    started.connect().acquire().step(paths(0))
    for reader in readers:
        assert make is OutlookReader or reader.receive(PATIENCE) is not None
        reader.close()
    make(started.instance).close()


@pytest.mark.parametrize("timeout", [-1, -0.001, float("nan")])
def test_an_impossible_timeout_is_refused(timeout: float) -> None:
    with refuses("timeout: expected seconds"):
        observe(timeout=timeout)


def test_a_bad_instance_name_is_refused() -> None:
    with refuses("instance"):
        observe("a/b")


def test_a_reader_whose_files_are_removed_says_so() -> None:
    with observe(unused_instance()) as observer:
        for path in services(observer.instance):
            path.unlink()
        with fails("channel", match="was removed while it was in use"):
            observer.receive(PATIENCE)
