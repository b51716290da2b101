"""A client and a running server: handshake, leases, steps, and refusals."""

import gc
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import document
import gymnasium
import numpy as np
import pytest
from failures import fails, refuses
from numpy.typing import NDArray
from processes import PATIENCE, eventually, find, is_running, script, server

import emberwatch
from emberwatch import errors
from emberwatch.client.client import Client, connect

US = os.getpid()


def paths(n_worlds: int, seed: int = 0) -> NDArray[np.int64]:
    return np.random.default_rng(seed).integers(0, 4, (n_worlds, 6))


def refused(call: Callable[[], object], code: str, detail: int) -> str:
    """Checks the refusal; returns its sentence."""
    with fails(code) as raised:
        call()
    assert raised.value.detail == detail
    assert " " in str(raised.value)
    return str(raised.value)


def test_a_handshake_tells_what_the_server_is() -> None:
    settings = {"worlds": 3, "max_steps": 9, "coverage": "client", "lease_millis": 1234}
    started = server(**settings, publish_truth=True)
    info = connect(started.instance).info
    assert info.pid == started.program.pid
    assert f"The version is {info.protocol}." in document.PROTOCOL
    assert (info.height, info.width, info.n_moves, info.n_worlds) == (5, 7, 6, 3)
    assert (info.burn_in, info.max_steps, info.lease_millis) == (20, 9, 1234)
    assert (info.coverage, info.publish_truth, info.max_clients) == ("client", True, 16)
    assert info.observations == ("normal", "latent", "fire")
    assert info.model is not None and "kernel" in info.model


def test_a_hidden_model_is_none() -> None:
    assert server(reveal_model=False).connect().info.model is None


def test_a_step_moves_the_robot_and_the_world() -> None:
    lease = server(seed=11).connect().acquire()
    (start,) = lease.start
    assert (start.step, start.seed, start.robots) == (0, 11, ((0, 0),))
    # up (off the grid), down, down, right, right, left
    answer = lease.step([0, 1, 1, 3, 3, 2])
    world, robot = answer.result()
    assert (world.step, world.seed, robot.start, robot.cell) == (1, 11, (0, 0), (2, 1))
    assert (answer.first_robot, answer.frames.shape) == (0, (1, 5, 7))
    visited = {(0, 0), (1, 0), (2, 0), (2, 1), (2, 2)}
    seen = {(int(row), int(col)) for row, col in np.argwhere(answer.frames[0] != 255)}
    assert seen == visited and world.n_visited == robot.n_visited == 5
    assert (robot.coverage, robot.n_moves) == (1, 6)
    assert (world.hovered, world.late, world.terminated, world.truncated) == (0, 0, 0, 0)
    assert world.reward == robot.reward == robot.marginal
    assert answer.simulation_nanos > 0


def test_paths_may_be_integers_of_any_type() -> None:
    lease = server(worlds=2).connect().acquire(0, 2)
    given = [paths(2).astype(kind) for kind in ("i1", "u1", "i2", "u4", "i8", "u8")]
    for k, moves in enumerate([*given, paths(2).tolist(), tuple(map(tuple, paths(2)))], start=1):
        assert lease.step(moves).result(1).world.step == k


def test_a_batch_equals_single_steps() -> None:
    together = server(worlds=3, seed=5).connect().acquire(0, 3)
    alone = server(worlds=3, seed=5).connect().acquire(0, 3)
    for k in range(10):
        moves = paths(3, seed=k)
        batch = together.step(moves)
        for world in range(3):
            single = alone.step(moves[world], robots=range(world, world + 1))
            assert single.first_robot == world
            assert single.result() == batch.result(world)
            assert (single.frames[0] == batch.frames[world]).all()
    results = [(tuple(record["world"]), tuple(record["robot"])) for record in batch.results]
    assert results == [batch.result(i) for i in range(3)]


def test_observing_repeats_the_last_answer() -> None:
    started = server(worlds=3)
    lease = started.connect().acquire(1, 2)
    answer = lease.step(paths(2))
    for again in (lease.observe(), started.connect().observe(1, 2)):
        assert (again.results == answer.results).all()
        assert (again.frames == answer.frames).all()
    before = started.connect().observe(0)
    assert before.result().world.step == 0 and (before.frames == 255).all()


def test_an_answer_is_a_copy() -> None:
    lease = server().connect().acquire()
    first = lease.step([1] * 6)
    kept = first.frames.copy()
    lease.step([3] * 6)
    assert (first.frames == kept).all()
    first.frames[:] = 0
    assert (lease.observe().frames != 0).any()


def test_a_full_frame_is_seen_when_asked_for() -> None:
    lease = server(coverage="client").connect().acquire()
    assert (lease.step(paths(1)).frames == 255).any()
    full = lease.step(paths(1), full=True)
    assert (full.frames != 255).all() and full.result().robot.coverage == 2


def test_a_reset_begins_the_episode_of_its_seed() -> None:
    lease = server(worlds=3).connect().acquire(0, 3)
    lease.step(paths(3))
    worlds = lease.reset([7, 2**64 - 1, None])
    assert [(w.world, w.step, w.episode, w.robots) for w in worlds] == [
        (i, 0, 1, ((0, 0),)) for i in range(3)
    ]
    assert [w.seed for w in worlds][:2] == [7, 2**64 - 1] and worlds[2].seed < 2**53
    first = lease.step(paths(3))
    again = lease.reset([7], worlds=[0])
    assert [w.world for w in again] == [0]
    assert (lease.step(paths(3)[0], robots=range(1)).frames[0] == first.frames[0]).all()
    with refuses("expected 3, got 2"):
        lease.reset([1, 2])


def test_the_next_client_goes_on_where_the_last_stopped() -> None:
    started = server(worlds=2)
    with started.connect() as client, client.acquire(1) as lease:
        for k in range(3):
            last = lease.step(paths(1, seed=k))
    with started.connect().acquire(1) as lease:
        (start,) = lease.start
        result = last.result()
        assert (start.step, start.robots) == (3, (result.robot.cell,))
        resumed = lease.observe()
        assert resumed.result() == result and (resumed.frames == last.frames).all()
        assert lease.step(paths(1)).result().world.step == 4


def test_a_takeover_ends_the_lease_of_the_former_holder() -> None:
    started = server()
    lease = started.connect().acquire()
    last = lease.step(paths(1))
    other = script(
        "import sys; from emberwatch import connect\n"
        "lease = connect(sys.argv[1]).acquire(takeover=True)\n"
        "print(lease.start[0].step, flush=True); input()",
        started.instance,
    )
    assert other.line() == "1"
    assert started.status().worlds[0].holder_pids[0] == other.pid
    for call in (lambda: lease.step(paths(1)), lambda: lease.reset(), lease.renew):
        assert f"pid {other.pid}" in refused(call, "lease_lost", other.pid)
    assert lease.observe().result() == last.result()
    with fails("busy") as busy:
        started.connect().acquire()
    assert busy.value.detail == other.pid


def test_a_released_world_is_free() -> None:
    started = server()
    client = started.connect()
    lease = client.acquire()
    assert started.status().worlds[0].holder_pids[0] == US
    lease.release()
    lease.release()
    assert started.status().worlds[0].holder_pids[0] is None
    refused(lambda: lease.step(paths(1)), "lease_lost", 0)
    with started.connect().acquire() as lease:
        lease.step(paths(1))
    assert started.status().worlds[0].holder_pids[0] is None


def test_leaving_a_with_keeps_the_first_error() -> None:
    started = server()
    with pytest.raises(ZeroDivisionError), started.connect() as client, client.acquire():
        client.close()
        raise ZeroDivisionError


def test_closing_a_client_frees_its_worlds() -> None:
    started = server()
    client = started.connect()
    client.acquire()
    client.close()
    assert eventually(lambda: started.status().worlds[0].holder_pids[0] is None)


def test_an_unused_lease_expires_and_a_longer_one_does_not() -> None:
    started = server(worlds=2)
    long, short = started.connect().acquire(0, ttl=3600), started.connect().acquire(1, ttl=0.1)
    assert (long.ttl, short.ttl) == (3600, 0.1)
    assert eventually(lambda: started.status().worlds[1].holder_pids[0] is None)
    sentence = refused(lambda: short.step(paths(1)), "lease_lost", 0)
    assert "expired" in sentence
    long.renew()
    assert started.status().worlds[0].holder_pids[0] == US


def test_status_counts() -> None:
    started = server(worlds=2)
    lease = started.connect().acquire(1)
    lease.step(paths(1))
    refused(lambda: started.connect().acquire(1), "busy", US)
    status = started.status()
    assert status.pid == started.program.pid and status.uptime_millis > 0
    assert (status.n_steps, status.n_refused, status.n_clients) == (1, 1, 3)
    assert [(w.step, w.holder_pids, w.n_paths, w.resetting) for w in status.worlds] == [
        (0, (None,), 0, False),
        (1, (US,), 0, False),
    ]


def test_the_version_is_that_of_the_programs() -> None:
    said = subprocess.run([find("emberwatch-server"), "--version"], capture_output=True, text=True)
    assert said.stdout.split() == ["emberwatch-server", emberwatch.__version__]


def test_shutdown_ends_the_server() -> None:
    started = server()
    client = started.connect()
    client.shutdown()
    assert eventually(lambda: not is_running(started.program.pid))
    with pytest.raises(errors.ServerGoneError, match=started.instance):
        client.status()
    with pytest.raises(errors.NoServerError):
        connect(started.instance)


def test_a_client_of_an_ended_server_does_not_ask_the_next() -> None:
    first = server()
    client = first.connect()
    lease = client.acquire()
    first.kill()
    second = server(first.instance, height=3, seed=9)
    for call in (client.observe, client.status, lambda: lease.step(paths(1)), lease.renew):
        with pytest.raises(errors.ServerGoneError):
            call()
    assert second.status().n_refused == 0
    assert connect(first.instance).info.height == 3


class Table:
    """A server of three worlds, truncated after two steps; world 2 is another client's."""

    def __init__(self) -> None:
        self.server = server(worlds=3, max_steps=2)
        self.client = self.server.connect()
        self.lease = self.client.acquire(0, 2)
        self.theirs = self.server.connect().acquire(2)

    def exchange(self, **changes: int) -> None:
        """Sends a step of robot 0, right but for the changes."""
        fields = {"operation": 1, "lease": self.lease.number, "first_robot": 0, "n_robots": 1}
        fields |= {"flags": 0} | changes
        body = fields.pop("step", 0).to_bytes(8, sys.byteorder)
        body += bytes([1] * fields.pop("bytes", 6))
        self.client.exchange(**fields, body=body, timeout=PATIENCE)

    def control(self, **request: object) -> None:
        self.client.control(request, timeout=PATIENCE)


def test_each_refusal_of_a_step_has_its_exception() -> None:
    table = Table()
    step = table.exchange
    refused(lambda: step(operation=7), "unknown_operation", 7)
    refused(lambda: step(first_robot=3), "no_such_robot", 3)
    refused(lambda: step(n_robots=0), "no_such_robot", 3)
    refused(lambda: step(n_robots=2), "wrong_length", 28)
    refused(lambda: step(bytes=5), "wrong_length", 14)
    refused(lambda: step(flags=4), "unknown_flags", 4)
    refused(lambda: step(flags=1), "not_permitted", 0)
    refused(lambda: step(lease=99), "no_lease", 0)
    refused(lambda: step(first_robot=2), "no_lease", 2)
    refused(lambda: step(step=1), "early", 0)
    sentence = refused(lambda: step(lease=0), "no_lease", 0)
    assert sentence == "no lease on robot 0: acquire it first"
    body = bytes(8) + bytes([9] * 6)
    place = table.lease.number, 0, 1, 0
    refused(lambda: table.client.exchange(1, *place, body, timeout=PATIENCE), "bad_move", 8)
    table.lease.step(paths(2))
    refused(lambda: step(), "late", 1)
    table.lease.step(paths(2))
    refused(lambda: table.lease.step(paths(2)), "episode_over", 0)
    status = table.server.status()
    assert (status.n_refused, status.n_steps) == (14, 4)


def test_a_world_in_its_burn_in_is_refused_and_waited_for() -> None:
    started = server(ready=False, worlds=2, burn_in=10**12)
    client = started.connect()
    refused(lambda: client.observe(1), "resetting", 1)
    assert [world.resetting for world in started.status().worlds] == [True, True]
    with pytest.raises(errors.RequestTimeoutError):
        client.acquire(timeout=0.05)
    assert client.status().n_refused == 1


def test_each_refusal_on_control_has_its_exception() -> None:
    table = Table()
    ask, number = table.control, table.lease.number
    refused(lambda: ask(op="dance"), "malformed", 0)
    refused(lambda: ask(op="renew", lease=-1), "malformed", 0)
    refused(lambda: ask(op="hello", protocol=1, client=""), "version_mismatch", 2)
    refused(lambda: table.client.acquire(0, 4), "no_such_robot", 3)
    refused(lambda: table.client.acquire(2), "busy", US)
    refused(lambda: ask(op="renew", lease=5), "no_lease", 0)
    refused(lambda: ask(op="release", lease=table.theirs.number), "no_lease", 2)
    refused(lambda: table.lease.reset([1], worlds=[2]), "no_lease", 2)
    ended = table.client.acquire(0, 2)
    refused(lambda: ask(op="renew", lease=number), "lease_lost", US)
    ended.release()
    refused(lambda: ask(op="renew", lease=ended.number), "lease_lost", 0)
    assert table.server.status().n_refused == 10


def test_more_worlds_than_there_are_are_refused_with_the_setting_for_more() -> None:
    table = Table()
    more = "for more, set worlds"
    robots = f"no such robot: there are robots 0 to 2; {more} or robots (--worlds N or --robots N"
    for ask in (
        lambda: table.client.acquire(0, 8),
        lambda: table.exchange(first_robot=2, n_robots=2, step=1, bytes=12),
    ):
        assert refused(ask, "no_such_robot", 3).startswith(robots)
    with refuses("world: .*got 0 to 7; start the server with --worlds N for more"):
        gymnasium.make_vec("emberwatch/Wildfire-v0", num_envs=8, instance=table.server.instance)
    worlds = f"no such world: there are worlds 0 to 2; {more} (--worlds N of a server)"
    assert refused(lambda: table.lease.reset([1], worlds=[9]), "no_such_world", 3) == worlds


def test_a_refusal_says_the_same_on_both_channels() -> None:
    table = Table()
    for kind, detail, step, control in (
        ("no_such_robot", 3, {"first_robot": 9}, {"op": "acquire", "first_robot": 9}),
        ("no_lease", 0, {"lease": 99}, {"op": "renew", "lease": 99}),
    ):
        if control["op"] == "acquire":
            control["n_robots"] = 1
        words = refused(lambda step=step: table.exchange(**step), kind, detail)
        assert refused(lambda control=control: table.control(**control), kind, detail) == words


def test_a_refused_client_goes_on() -> None:
    table = Table()
    for _ in range(20):
        refused(lambda: table.exchange(operation=9), "unknown_operation", 9)
    assert table.lease.step(paths(2)).result().world.step == 1


WRONG_ACTIONS = [
    ([1] * 5, "shape"),
    ([1] * 7, "shape"),
    ([], "shape"),
    (3, "shape"),
    (None, "shape"),
    ("123456", "shape"),
    (np.zeros((1, 6, 1), int), "shape"),
    (np.zeros((2, 6), int), "shape"),
    ([[1, 2], [3]], "array"),
    (np.zeros(6), "integers, got float64"),
    (np.zeros(6, bool), "integers, got bool"),
    (np.zeros(6, object), "integers, got object"),
    ([1, 1, 1, 1, 1, 1j], "integers, got complex"),
    (["up"] * 6, "integers, got <U2"),
    ([0, 1, 2, 3, 4, 0], r"0 to 3, got 4 at \(4,\)"),
    ([[0, 1, 2, 3, 0, -1]], r"0 to 3, got -1 at \(0, 5\)"),
    (np.full(6, 255, np.uint8), "got 255"),
    (np.full(6, 2**64 - 1, np.uint64), f"got {2**64 - 1}"),
    ([2**70] * 6, "integers, got object"),
]


def test_a_wrong_action_is_named_and_never_sent() -> None:
    started = server()
    lease = started.connect().acquire()
    for action, words in WRONG_ACTIONS:
        with refuses(words):
            lease.step(action)
    status = started.status()
    assert (status.n_steps, status.n_refused) == (0, 0)
    assert lease.step([3] * 6).result().world.step == 1


def test_wrong_actions_of_many_worlds_are_named() -> None:
    started = server(worlds=2)
    lease = started.connect().acquire(0, 2)
    for action, words in (
        (np.zeros(6, int), r"expected shape \(2, 6\), got \(6,\)"),
        (np.zeros((3, 6), int), r"expected shape \(2, 6\), got \(3, 6\)"),
        ([[0] * 6, [0, 0, 7, 0, 0, 0]], r"got 7 at \(1, 2\)"),
    ):
        with refuses(words):
            lease.step(action)
    assert started.status().n_steps == 0


@pytest.mark.parametrize(
    "robots", [range(0, 3, 2), range(0), range(-1, 1), range(2, 4), [0, 2]], ids=str
)
def test_robots_to_step_are_consecutive_and_of_the_lease(robots: Any) -> None:
    client = server(worlds=4).connect()
    lease = client.acquire(0, 3)
    with refuses("robots: expected a range of consecutive"):
        lease.step([[3] * 6] * 2, robots=robots)
    assert client.observe(0, 4).results["world"]["step"].tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("seed", [1.5, -1, 2**64, "7"])
def test_seeds_are_integers_that_fit(seed: Any) -> None:
    lease = server().connect().acquire()
    with refuses("seed: expected an integer"):
        lease.reset([seed])


def test_threads_take_turns() -> None:
    lease = server().connect().acquire()
    steps: list[int] = []

    def fly() -> None:
        for _ in range(200):
            steps.append(lease.step([3] * 6).result().world.step)

    threads = [threading.Thread(target=fly) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(steps) == list(range(1, 601))


def test_a_forgotten_client_leaves_no_descriptor() -> None:
    started = server()

    def n_open() -> int:
        gc.collect()
        return len(os.listdir("/proc/self/fd"))

    Client(started.instance)
    before = n_open()
    for _ in range(5):
        Client(started.instance)
    assert n_open() == before


def test_a_world_that_is_written_down_goes_on_bit_for_bit(tmp_path: Path) -> None:
    client = server(worlds=3, seed=4).connect()
    lease = client.acquire(0, 2)
    first = lease.step(paths(2, seed=1))
    second = lease.step(paths(2, seed=2))
    written = client.snapshot(tmp_path / "lab.snapshot", 0, 2)
    assert [world.step for world in written] == [2, 2]
    ahead = lease.step(paths(2, seed=3))
    assert [world.step for world in lease.restore(tmp_path / "lab.snapshot")] == [2, 2]
    for step, seen in ((1, first), (2, second)):
        kept = client.recall(step, 0, 2)
        assert (kept.frames == seen.frames).all() and (kept.results == seen.results).all()
    assert (lease.step(paths(2, seed=3)).frames == ahead.frames).all()
    other = client.acquire(2, 1)
    (copy,) = other.fork(1, 2)
    assert (copy.world, copy.step) == (2, 3)
    both = lease.step(paths(2, seed=5))
    alone = other.step(paths(2, seed=5)[1])
    assert (alone.frames[0] == both.frames[1]).all()
    refused(lambda: other.restore(tmp_path / "none"), "bad_file", 0)
    assert "nearest step that is kept is 4" in refused(lambda: client.recall(9), "not_kept", 4)
    with refuses("step: expected"):
        client.recall(-1)


def test_a_belief_that_is_left_is_found_at_its_step_alone() -> None:
    client = server().connect()
    lease = client.acquire()
    assert client.belief() is None
    data = bytes(range(256)) * 8
    lease.leave_belief(lease.observe().result(), "numbers", data)
    left = client.belief()
    assert left is not None
    assert (left.kind, left.step, left.data) == ("numbers", 0, data)
    past = lease.observe().result()
    result = lease.step(paths(1)).result()
    assert client.belief() is None
    for at, size in ((past, 1), (result, 35 * 76 + 32_768 + 1)):
        refused(lambda: lease.leave_belief(at, "numbers", bytes(size)), "malformed", 0)  # noqa: B023
