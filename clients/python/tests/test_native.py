"""Arguments of the Rust module: refusals instead of panics, Ctrl-C, and concurrent threads."""

import signal
import threading
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from failures import fails, refuses
from processes import LONG, asleep, ctrl_c, eventually, script, server

from emberwatch import _native, errors
from emberwatch.belief import known, uniform_prior
from emberwatch.belief.prior import simulated_prior
from emberwatch.model import Model

WILDFIRE = Model.wildfire()

#: One world whose search takes minutes, with a Ctrl-C in the middle.
WIDE = """
import signal
import numpy as np
from emberwatch.planning import beam_search
values = np.random.default_rng(1).random((1, 9, 9))
signal.signal(signal.SIGALRM, signal.default_int_handler)
signal.setitimer(signal.ITIMER_REAL, 0.5)
beam_search(values, np.zeros((1, 2), int), 4096, rng=np.random.default_rng(1), width=65536)
"""


def test_ctrl_c_ends_the_search_in_one_world() -> None:
    code, _, error = script(WIDE).end()
    assert code in (1, 130, -signal.SIGINT) and "KeyboardInterrupt" in error


def test_ctrl_c_ends_a_close_that_waits_for_another_thread() -> None:
    started = server()
    client = started.connect()
    lease = client.acquire()
    started.stop()
    steps = threading.Thread(target=lambda: lease.step([3] * 6, timeout=LONG))
    steps.start()
    asleep(steps)
    with ctrl_c():
        client.close()
    started.wake_up()
    steps.join()
    assert client.status().pid == started.program.pid
    client.close()
    with fails("closed"):
        client.status()


def test_numbers_out_of_range_are_refused() -> None:
    for height, burn_in, words in (
        (10**30, 0, "height: expected an integer within 1 to 4096, got 10"),
        (2, -3, "burn_in: expected an integer within 0 to .*, got -3"),
    ):
        with refuses(words):
            simulated_prior(WILDFIRE, height=height, width=2, burn_in=burn_in)
    with refuses("grid: expected height and width within 1 to 4096, got 4097 x 3"):
        known(WILDFIRE, prior=uniform_prior(WILDFIRE, height=4097, width=3))


def test_other_threads_run_during_work_on_large_grids() -> None:
    prior = uniform_prior(WILDFIRE, height=200, width=200)
    kept = known(WILDFIRE, prior=prior, n_worlds=2)
    frames = np.zeros(kept.shape, np.uint8)
    for work in (kept.predict, partial(kept.correct, frames)):
        meets(work, errors.InvalidArgumentError, "belief that no other thread is using")


def meets(work: Callable[[], object], kind: type[Exception], words: str) -> None:
    """Runs the same work on two threads, until one is refused while the other works."""
    refused = threading.Event()

    def is_refused() -> bool:
        try:
            work()
        except kind as error:
            assert words in str(error)
            refused.set()
        return refused.is_set()

    thread = threading.Thread(target=lambda: eventually(is_refused))
    thread.start()
    assert eventually(is_refused)
    thread.join()


def test_flights_refuse_wrong_grids_and_states() -> None:
    for n_moves in (0, 4097):
        with refuses(f"n_moves: expected an integer within 1 to 4096, got {n_moves}"):
            _native.Flights(2, 3, 5, n_moves, [1.0])
    with refuses("grid: expected height and width"):
        _native.Flights(2, 0, 5, 4, None)
    flights, begun = _native.Flights(2, 3, 5, 4, [1.0]), np.ones(2, np.bool_)
    with refuses(r"states: expected shape \(2, 3, 5\), got"):
        flights.start_paths(begun, np.zeros((2, 2), np.int64), np.zeros((2, 3, 4), np.uint8))
    for robot in ((3, 0), (0, 5), (-1, 0)):
        with pytest.raises(ValueError, match="robots on the grid"):
            flights.start_paths(begun, np.array([(0, 0), robot]), None)
