"""Worlds inside this process: `backend="embedded"` and `emberwatch.embed`."""

import copy
import os
import pickle
import signal
import threading
from collections.abc import Iterator
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import (
    LIVELY,
    MOVES,
    SMALL,
    WILDFIRE,
    actions,
    assert_same,
    make,
    make_vec,
    rollout,
)
from failures import fails
from gymnasium.vector import AsyncVectorEnv
from processes import eventually, script, server

import emberwatch
from emberwatch import programs
from emberwatch.errors import EmberwatchError, LeaseLostError, ServerGoneError

#: Settings of a small world, as a server names them.
FLAGS: dict[str, Any] = {"height": 7, "width": 5, "moves": 4, "burn_in": 50, "model": LIVELY}


def embedded(name: str = WILDFIRE, **keywords: Any) -> Any:
    return make(name, backend="embedded", **keywords)


@pytest.fixture
def client() -> Iterator[emberwatch.Client]:
    """Two small worlds."""
    with emberwatch.embed(worlds=2, seed=None, **FLAGS) as client:
        yield client


def test_no_program_is_started(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(name: str) -> Path:
        raise AssertionError(f"{name} was looked for")

    monkeypatch.setattr(programs, "find", refused)
    rollout(embedded(truth=True), 3, seed=1)
    rollout(make_vec(3, MOVES, backend="embedded", reward="move"), 9, seed=1)


def test_snapshots_and_forks_are_those_of_a_server(
    client: emberwatch.Client, tmp_path: Path
) -> None:
    other = server(worlds=2, **FLAGS).connect()
    path, seen = tmp_path / "worlds", list[Any]()
    for at in (client, other):
        lease = at.acquire(0, 2)
        lease.step([[3] * 4] * 2)
        at.snapshot(path)
        told = [lease.step([[1] * 4] * 2).results]
        told += [lease.restore(path), lease.step([[1] * 4] * 2).results]
        told += [lease.fork(0, 1), lease.step([[3] * 4] * 2).results]
        told += [at.recall(2, 0, 2).frames, at.belief(), at.info.model]
        seen.append(told)
        assert_same(told[0], told[2])
    assert_same(seen[0], seen[1])


def test_a_file_goes_from_one_backend_to_the_other(
    client: emberwatch.Client, tmp_path: Path
) -> None:
    lease = client.acquire(0, 2)
    lease.step([[3] * 4] * 2)
    client.snapshot(tmp_path / "worlds")
    guest = server(worlds=2, **FLAGS).connect().acquire(0, 2)
    guest.restore(tmp_path / "worlds")
    paths = [[1, 1, 3, 3]] * 2
    first, second = lease.step(paths), guest.step(paths)
    assert_same(first.frames, second.frames)
    names = [name for name in first.worlds.dtype.names or () if name != "episode"]
    assert_same(first.worlds[names], second.worlds[names])


def test_an_environment_goes_on_from_its_own_snapshot(tmp_path: Path) -> None:
    env = embedded(observation=("frame", "robot", "age", "belief"))
    rollout(env, 4, seed=3)
    lease = env.unwrapped.lease
    lease.client.snapshot(tmp_path / "world")
    once = list(map(env.step, actions(env, 5)))
    lease.restore(tmp_path / "world")
    _, info = env.reset(options={"resume": True})
    again = list(map(env.step, actions(env, 5)))
    assert info["step"] == 4
    assert [step[1] for step in once] == [step[1] for step in again]
    assert_same([step[0]["frame"] for step in once], [step[0]["frame"] for step in again])


def test_errors_have_the_codes_of_a_server(client: emberwatch.Client) -> None:
    lease, other = client.acquire(0), client.acquire(1)
    with fails("no_such_robot"):
        client.acquire(7)
    with fails("no_such_world"):
        client.snapshot("worlds", 5, 1)
    other.release()
    with pytest.raises(LeaseLostError):
        other.step([3] * 4)
    with fails("bad_file"):
        lease.restore("nowhere")
    assert client.status().worlds[0].holder_pids == (os.getpid(),)
    client.shutdown()
    with pytest.raises(ServerGoneError):
        lease.step([3] * 4)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"snapshot_keep": 9}, "snapshot_keep: expected to be left out, .* got 9"),
        ({"deadline_millis": 7}, "deadline_millis: expected to be left out, .* got 7"),
        ({"model": "\ud800"}, "model: expected UTF-8"),
        ({"wrolds": 2}, "^wrolds: expected the name of a setting \\(burn_in, .*\\), got 2$"),
        ({"worlds": 0}, "worlds: expected 1 to 1024, got 0"),
        ({"height": "x"}, "^height: expected 1 to 4096, got x$"),
        ({"height": -1}, "^height: expected 1 to 4096, got -1$"),
        ({"height": 7.0}, "^height: expected an integer, True or False, text or a path, got 7.0$"),
        ({"publish_truth": 1}, "^publish_truth: expected true or false, got 1$"),
        ({"instance": "lab"}, "instance: expected to be left out, .* got lab"),
        ({"snapshot_every": 5, "snapshot_dir": "."}, "snapshot_every: expected to be left out"),
        ({"restore": "file"}, "restore: expected to be left out"),
        ({"model": "nothing"}, "nothing"),
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, Any], words: str) -> None:
    with fails("invalid_argument", match=words):
        emberwatch.embed(**settings)


@pytest.mark.parametrize(
    ("name", "keywords", "words"),
    [
        (WILDFIRE, {"backend": "cloud"}, "expected 'server' or 'embedded', got 'cloud'"),
        (WILDFIRE, {"backend": 3}, "backend"),
        (WILDFIRE, {"instance": "lab"}, "expected 'server' with instance"),
        (WILDFIRE, {"takeover": True}, "expected instance=..."),
    ],
)
def test_wrong_backends_are_refused(name: str, keywords: dict[str, Any], words: str) -> None:
    with fails("invalid_argument", match=words):
        make(name, **{"backend": "embedded", **keywords})


def test_there_is_no_instance_to_attach_to() -> None:
    env = embedded()
    env.reset(seed=1)
    with fails("invalid_argument", match="expected backend='server'"):
        _ = env.unwrapped.instance


def test_forked_and_spawned_workers_have_worlds_of_their_own() -> None:
    expected = rollout(make(), 5, seed=9)
    path = actions(make(), 1)[0]
    for context in ("fork", "spawn"):
        makers = [lambda: gymnasium.make(f"emberwatch:{WILDFIRE}", backend="embedded", **SMALL)]
        env = AsyncVectorEnv(makers, context=context)
        env.reset(seed=9)
        seen, reward, *_ = env.step(path[np.newaxis])
        assert_same(seen["frame"][0], expected[1][0]["frame"])
        assert reward[0] == expected[1][1]
        env.close()


def test_a_forked_child_is_refused_by_name_and_harms_nothing() -> None:
    env, other = embedded(), embedded()
    expected = rollout(other, 6, seed=4)
    seen = rollout(env, 3, seed=4)
    path = actions(env, 6)[3]

    def child(sender: Any) -> None:
        try:
            env.step(path)
        except EmberwatchError as error:
            sender.send(error.code)
        fresh = gymnasium.make(WILDFIRE, backend="embedded", **SMALL)
        fresh.reset(seed=4)
        sender.send(fresh.step(actions(fresh, 1)[0])[1])
        fresh.close()
        env.close()

    context = get_context("fork")
    receiver, sender = context.Pipe()
    process = context.Process(target=child, args=(sender,))
    process.start()
    sender.close()
    assert (receiver.recv(), receiver.recv()) == ("forked", expected[1][1])
    process.join()
    assert process.exitcode == 0
    assert_same([*seen, env.step(path)], expected[:5])


def test_threads_take_turns(client: emberwatch.Client) -> None:
    leases = [client.acquire(world) for world in range(2)]
    rewards = [list[float]() for _ in leases]

    def fly(world: int) -> None:
        for _ in range(200):
            rewards[world].append(leases[world].step([3, 1, 2, 0]).result().world.reward)

    threads = [threading.Thread(target=fly, args=(world,)) for world in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with emberwatch.embed(worlds=2, **FLAGS) as again:
        for world, got in enumerate(rewards):
            lease = again.acquire(world)
            assert got == [lease.step([3, 1, 2, 0]).result().world.reward for _ in range(200)]


def test_a_closed_environment_is_copied_and_an_open_one_refused() -> None:
    env = embedded()
    expected = rollout(env, 3, seed=2)
    with pytest.raises(TypeError, match="expected a closed environment"):
        pickle.dumps(env.unwrapped)
    env.close()
    again = pickle.loads(pickle.dumps(copy.deepcopy(env)))
    assert_same(rollout(again, 3, seed=2), expected)
    again.close()


def test_a_lease_that_nobody_knows_ends() -> None:
    with emberwatch.embed(robots=2, **FLAGS) as client:
        client.acquire(1, ttl=0.1)
        lease = client.acquire(0)
        assert eventually(lambda: client.status().worlds[0].holder_pids[1] is None)
        assert lease.step([3] * 4).result().world.hovered == 2


def test_settings_of_a_pipe_are_not_waited_for_without_end(tmp_path: Path) -> None:
    os.mkfifo(fifo := tmp_path / "model.toml")
    started = script(
        f"import emberwatch; print(1, flush=True); emberwatch.embed(model={str(fifo)!r})"
    )
    assert started.line() == "1"
    threading.Event().wait(0.3)
    started.signal(signal.SIGINT)
    _, _, err = started.end()
    assert "KeyboardInterrupt" in err


def test_truths_are_those_of_embedded_worlds_that_publish_them(client: emberwatch.Client) -> None:
    for at in (client, server(worlds=2, **FLAGS).connect()):
        with fails("invalid_argument", match="embedded worlds with publish_truth"):
            at.truths(range(1))


def test_a_step_does_not_wait_for_the_burn_ins_of_others() -> None:
    large = {"height": 512, "width": 512, "burn_in": 4000, "worlds": 3, "threads": 1}
    with emberwatch.embed(**large, moves=4) as client:
        client.acquire(0).step([3] * 4)
        assert client.status().worlds[2].resetting


#: A burn-in of hours, which Ctrl-C ends; then short ones.
INTERRUPTED = """
import gymnasium, emberwatch, time
env = gymnasium.make("emberwatch/Wildfire-v0", backend="embedded", burn_in=10**9)
print("ready", flush=True)
try:
    env.reset(seed=1)
except KeyboardInterrupt:
    print("interrupted", flush=True)
try:
    env.step(env.action_space.sample())
except emberwatch.EmberwatchError as error:
    print(error.code, flush=True)
env.close()
time.sleep(0.1)
before = time.process_time()
time.sleep(0.2)
assert time.process_time() - before < 0.1
env = gymnasium.make("emberwatch/Wildfire-v0", backend="embedded", burn_in=10)
env.reset(seed=1)
env.step(env.action_space.sample())
print("closed", flush=True)
"""


def test_ctrl_c_ends_a_burn_in() -> None:
    started = script(INTERRUPTED)
    assert started.line() == "ready"
    threading.Event().wait(0.3)
    started.signal(signal.SIGINT)
    code, out, err = started.end()
    assert (code, out.split()) == (0, ["interrupted", "closed", "closed"]), err


def test_truth_is_that_of_the_answer() -> None:
    env, other = embedded(truth=True), make(truth=True)
    for mine, servers in zip(rollout(env, 5, seed=8), rollout(other, 5, seed=8), strict=True):
        assert_same(mine, servers)


def test_many_worlds_may_reveal_the_truth() -> None:
    env = make_vec(130, backend="embedded", truth=True)
    _, infos = env.reset(seed=1)
    assert infos["truth"].shape == (130, 7, 5)
    assert np.unique(infos["truth"].reshape(130, -1), axis=0).shape[0] > 100
