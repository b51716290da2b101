"""Calls that wait: timeouts, closing and Ctrl-C."""

import os
import signal
import threading
from functools import partial

import pytest
from failures import fails, refuses
from processes import LONG, PATIENCE, asleep, ctrl_c, eventually, server

from emberwatch import errors
from emberwatch.client.client import connect

US = os.getpid()


def test_every_call_has_a_timeout() -> None:
    started = server()
    client = started.connect()
    lease = client.acquire()
    requests = lease.observe, client.status, lease.reset, lease.renew, client.acquire
    started.stop()
    for call in (partial(lease.step, [3] * 6), *requests, lease.release):
        with pytest.raises(errors.RequestTimeoutError, match=rf"{started.instance}.* 0\.05 s"):
            call(timeout=0.05)
    # Longer, because connecting also waits for other tests that hold the lock of all channels.
    with pytest.raises(errors.RequestTimeoutError, match=rf"{started.instance}.* within 3\.0 s"):
        connect(started.instance, timeout=3)
    with pytest.raises(errors.RequestTimeoutError):
        client.observe(timeout=0)
    started.wake_up()
    for timeout in (-1, float("nan"), -float("inf")):
        for call in requests:
            with refuses("timeout: expected seconds of at least 0"):
                call(timeout=timeout)
    assert client.observe(timeout=float("inf")).result().world.step == 0


def test_a_handled_signal_does_not_end_a_step() -> None:
    started = server()
    lease = started.connect().acquire()
    caught: list[int] = []
    before = signal.signal(signal.SIGUSR1, lambda number, _: caught.append(number))

    def disturb() -> None:
        for _ in range(5):
            n_caught = len(caught)
            os.kill(US, signal.SIGUSR1)
            eventually(lambda: len(caught) > n_caught)  # noqa: B023
            asleep()
        started.wake_up()

    started.stop()
    thread = threading.Thread(target=disturb)
    thread.start()
    try:
        assert lease.step([3] * 6, timeout=PATIENCE).result().world.step == 1
    finally:
        thread.join()
        signal.signal(signal.SIGUSR1, before)
    assert len(caught) == 5


def test_a_signal_handler_cannot_use_the_object_that_it_interrupted() -> None:
    started = server()
    client = started.connect()
    lease = client.acquire()
    codes: list[str] = []

    def handle(*_: object) -> None:
        for call in (client.close, client.status, lease.release):
            with pytest.raises(errors.EmberwatchError) as raised:
                call()
            codes.append(raised.value.code)

    before = signal.signal(signal.SIGUSR1, handle)
    started.stop()
    threading.Timer(0.3, os.kill, (US, signal.SIGUSR1)).start()
    try:
        with pytest.raises(errors.RequestTimeoutError):
            lease.step([3] * 6, timeout=1)
    finally:
        signal.signal(signal.SIGUSR1, before)
        started.wake_up()
    assert codes == ["in_use"] * 3


def test_closing_twice_is_allowed_and_closed_clients_refuse() -> None:
    client = server().connect()
    lease = client.acquire()
    for _ in range(3):
        client.close()
    calls = client.status, client.observe, client.acquire, lambda: lease.step([3] * 6)
    for call in (*calls, lease.observe, lease.reset, lease.renew, lease.release):
        with fails("closed", match="closed"):
            call()


def test_ctrl_c_ends_a_blocked_step_but_not_the_client() -> None:
    started = server()
    client = started.connect()
    lease = client.acquire()
    started.stop()
    with ctrl_c() as raised:
        lease.step([3] * 6, timeout=LONG)
    started.wake_up()
    # `raised` keeps the traceback alive, as an exception does inside an `except` block.
    before = client.observe().result().world.step
    assert raised is not None
    assert lease.step([3] * 6).result().world.step == before + 1
