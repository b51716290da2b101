"""A client and a running server: handshake, leases, and arguments of steps."""

import gc
import os
import subprocess
import tracemalloc
from collections.abc import Callable
from functools import partial
from typing import Any

import document
import numpy as np
import pytest
from failures import fails, refuses
from numpy.typing import NDArray
from processes import find, server

import emberwatch
from emberwatch.client.client import Client, connect

US = os.getpid()


def paths(n_worlds: int, seed: int = 0) -> NDArray[np.int64]:
    return np.random.default_rng(seed).integers(0, 4, (n_worlds, 6))


def test_a_handshake_describes_the_server() -> None:
    started = server(worlds=3, lease_millis=1234)
    info = connect(started.instance).info
    assert f"The version is {info.protocol}." in document.PROTOCOL
    assert (info.pid, info.n_worlds, info.lease_millis) == (started.program.pid, 3, 1234)
    assert info.observations == ("normal", "latent", "fire")


def test_paths_may_be_integers_of_any_type() -> None:
    lease = server(worlds=2).connect().acquire(0, 2)
    given = [paths(2).astype(kind) for kind in ("i1", "u1", "i2", "u4", "i8", "u8")]
    for k, moves in enumerate([*given, paths(2).tolist(), tuple(map(tuple, paths(2)))], start=1):
        assert lease.step(moves).result(1).world.step == k


def test_a_lease_names_its_robots_and_worlds() -> None:
    with emberwatch.embed(height=4, width=6, moves=4, burn_in=0, worlds=3, robots=2) as client:
        lease = client.acquire(2, 4)
        assert (lease.robots, lease.worlds) == (range(2, 6), range(1, 3))
        assert [world.step for world in lease.start] == [0, 0]


def test_an_answer_leaves_no_memory_behind() -> None:
    with emberwatch.embed(height=16, width=20, moves=4, burn_in=0) as client:
        lease = client.acquire()
        lease.observe()
        tracemalloc.start()
        for _ in range(2000):
            lease.observe()
        kept, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert kept < 20_000


def test_a_released_world_is_free() -> None:
    started = server()
    lease = started.connect().acquire()
    assert started.status().worlds[0].holder_pids[0] == US
    for _ in range(2):
        lease.release()
    with fails("lease_lost"):
        lease.step(paths(1))
    with started.connect().acquire() as lease:
        first = lease.step(paths(1)).frames
        kept = first.copy()
        lease.step(paths(1, seed=1))
        assert (first == kept).all()  # a copy
        first[:] = 0
        assert (lease.observe().frames != 0).any()
    assert started.status().worlds[0].holder_pids[0] is None


def test_leaving_a_with_block_keeps_the_first_error() -> None:
    started = server()
    with pytest.raises(ZeroDivisionError), started.connect() as client, client.acquire():
        client.close()
        raise ZeroDivisionError


def test_the_version_matches_the_programs() -> None:
    said = subprocess.run([find("emberwatch-server"), "--version"], capture_output=True, text=True)
    assert said.stdout.split() == ["emberwatch-server", emberwatch.__version__]


#: Wrong steps of one robot, each with words of its error.
WRONG_ACTIONS = [
    *((action, "shape") for action in ([1] * 5, [], 3, None, "123456", np.zeros((2, 6), int))),
    ([[1, 2], [3]], "array"),
    *((np.zeros(6, kind), f"integers, got {kind}") for kind in ("float64", "bool", "object")),
    (["up"] * 6, "integers, got <U2"),
    ([2**70] * 6, "integers, got object"),
    ([0, 1, 2, 3, 4, 0], r"0 to 3, got 4 at \(4,\)"),
    ([[0, 1, 2, 3, 0, -1]], r"0 to 3, got -1 at \(0, 5\)"),
    (np.full(6, 2**64 - 1, np.uint64), f"got {2**64 - 1}"),
]

#: Wrong actions for a lease on two robots.
WRONG_PAIRS = [
    (np.zeros(6, int), r"expected shape \(2, 6\), got \(6,\)"),
    (np.zeros((3, 6), int), r"expected shape \(2, 6\), got \(3, 6\)"),
    ([[0] * 6, [0, 0, 7, 0, 0, 0]], r"got 7 at \(1, 2\)"),
]


def test_wrong_calls_of_a_lease_are_refused_and_not_sent() -> None:
    started = server(worlds=4)
    one, two = started.connect().acquire(0), started.connect().acquire(1, 2)
    rows: list[tuple[Callable[..., Any], Any, str]] = []
    rows += [(one.step, action, words) for action, words in WRONG_ACTIONS]
    rows += [(two.step, action, words) for action, words in WRONG_PAIRS]
    flies = partial(two.step, [[3] * 6] * 2)
    for robots in (range(1, 4, 2), range(0), range(-1, 2), range(2, 4), [1, 2]):
        rows.append(
            (lambda it: flies(robots=it), robots, "robots: expected a range of consecutive")
        )
    rows += [(one.reset, [seed], "seed: expected an integer") for seed in (1.5, -1, 2**64, "7")]
    rows += [(one.reset, it, "seeds: expected one for each world, got") for it in (5, np.array(5))]
    rows += [(two.reset, [1, 2, 3], "expected 2, got 3"), (one.client.recall, -1, "step: expected")]
    for call, given, words in rows:
        with refuses(words):
            call(given)
    status = started.status()
    assert (status.n_steps, status.n_refused) == (0, 0)
    assert one.step([3] * 6).result().world.step == 1
    assert [world.seed for world in two.reset(np.array([5, 6]))] == [5, 6]


def test_a_garbage_collected_client_leaks_no_descriptor() -> None:
    started = server()

    def n_open() -> int:
        gc.collect()
        return len(os.listdir("/proc/self/fd"))

    Client(started.instance)
    before = n_open()
    for _ in range(5):
        Client(started.instance)
    assert n_open() == before
