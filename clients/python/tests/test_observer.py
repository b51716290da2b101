"""Observers and truth readers: published samples, their readers, and lost samples."""

import subprocess

import document
import numpy as np
from failures import fails, refuses
from processes import PATIENCE, eventually, find, server, unused_instance

from emberwatch.client.observer import Frame, Observer, OutlookReader, TruthReader, observe

LIMITS = document.limits()
FRAME_BUFFER = LIMITS["FRAME_BUFFER"]


def frames_until(observer: Observer, step: int, world: int = 0, seed: int = 0) -> list[Frame]:
    """Reads frames up to the frame of a step. Returns all of them."""
    frames = []
    while not frames or (frames[-1].world, frames[-1].result.step) != (world, step):
        frame = observer.receive(PATIENCE)
        assert frame is not None, f"no frame of world {world} at step {step}"
        # The frame must be of this episode: a new server begins with another seed.
        if frame.world != world or frame.result.seed == seed + world:
            frames.append(frame)
    return frames


def paths(k: int, n_worlds: int = 1) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 4, (n_worlds, 6))


def test_a_published_frame_equals_the_steps_answer() -> None:
    started = server(worlds=2)
    lease = started.connect().acquire(1)
    with observe(started.instance) as observer:
        frames, start = frames_until(observer, 0, world=1), (0, 0)
        for k in range(1, 5):
            answer = lease.step(paths(k))
            frames += frames_until(observer, k, world=1)
            (robot,) = frames[-1].robots
            assert (frames[-1].result, robot.result) == answer.result()
            assert robot.frame.tobytes() == frames[-1].frame.tobytes() == answer.frames.tobytes()
            assert (robot.path == paths(k)[0]).all()
            assert robot.result.start == start
            start = robot.result.cell
            robot.frame[:] = 0  # the reader may write to it
    assert sum(frame.n_lost for frame in frames) == 0


def test_lost_samples_of_other_worlds_are_counted() -> None:
    started = server(worlds=2)
    lease = started.connect().acquire(0, 2)
    with observe(started.instance, world=1) as observer, observe(started.instance) as other:
        frames_until(observer, 0, world=1)
        for k in range(FRAME_BUFFER):
            lease.step(paths(k, 2))
        frames_until(other, FRAME_BUFFER, world=1)  # Published after the answer.
        # World 0 is published first, so the gap ends at a sample of the other world.
        frames = frames_until(observer, FRAME_BUFFER, world=1)
    assert {frame.world for frame in frames} == {1}
    # One observer may get the last sample a moment before the other.
    assert abs(len(frames) - FRAME_BUFFER // 2) <= 1
    assert frames[0].n_lost >= FRAME_BUFFER - 2
    assert sum(frame.n_lost for frame in frames[1:]) == 0


def test_iteration_ends_when_no_frame_arrives_in_time() -> None:
    started = server()
    frames: list[Frame] = []
    with observe(started.instance, timeout=0.2) as observer:
        # A server may publish the first frames late.
        assert eventually(lambda: bool(frames.extend(observer) or frames))
    assert all(frame.result.step == 0 for frame in frames)
    assert list(observe(unused_instance(), timeout=0)) == []


def test_a_closed_reader_refuses_and_may_be_closed_again() -> None:
    for make in (observe, TruthReader):
        reader = make(unused_instance())
        for _ in range(3):
            reader.close()
        with fails("closed", match="closed"):
            reader.receive(0)


def test_an_agents_beliefs_can_be_read() -> None:
    started = server(height=16, width=24, moves=12, burn_in=500)
    command = [find("emberwatch-agent"), "run", "--instance", started.instance]
    with OutlookReader(started.instance) as reader, subprocess.Popen(command) as agent:
        for _ in range(9):
            outlook = reader.receive(PATIENCE)
            assert outlook is not None
            np.testing.assert_allclose(outlook.belief.sum(axis=0), np.ones((16, 24)), atol=1e-4)
        agent.terminate()
    assert outlook.step > 0 and outlook.states == ("normal", "latent", "fire")
    assert (outlook.policy, outlook.objective, outlook.pid) == ("beam", "fire", agent.pid)
    assert (outlook.world, outlook.robots) == (0, range(1))


def test_too_many_or_invalid_readers_are_refused() -> None:
    kinds = observe, TruthReader, OutlookReader
    names = "MAX_OBSERVERS", "MAX_TRUTH_READERS", "MAX_AGENT_READERS"
    started = server(publish_truth=True)
    for make, limit in zip(kinds, map(LIMITS.__getitem__, names), strict=True):
        readers = [make(started.instance) for _ in range(limit)]
        with fails("channel", match=f"at most {limit} (readers|observers)"):
            make(started.instance)
        for reader in readers:
            assert make is OutlookReader or reader.receive(PATIENCE) is not None
            reader.close()
    for timeout in (-0.001, float("nan")):
        with refuses("timeout: expected seconds"):
            observe(timeout=timeout)
    with refuses("instance"):
        observe("a/b")
