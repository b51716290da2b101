"""Where a client connects: limits, instance names, and the directory of the channels."""

import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from failures import fails, refuses
from processes import CHANNELS, PATIENCE, connects, eventually, server, unused_instance

from emberwatch import errors
from emberwatch.client.client import connect

US = os.getpid()


def test_a_seventeenth_client_is_told_the_limit_and_others_go_on() -> None:
    started = server()
    clients = [started.connect() for _ in range(15)]
    with fails("channel", match="expected at most 16 clients at a time, got one more"):
        started.connect()
    assert clients[-1].acquire().step([3] * 6).result().world.step == 1
    clients[0].close()
    assert eventually(lambda: connects(started))


def test_without_a_server_the_instance_and_the_remedy_are_named() -> None:
    with pytest.raises(errors.NoServerError) as raised:
        connect("nobody-here")
    assert "'nobody-here'" in str(raised.value)
    assert "emberwatch-server --instance nobody-here" in str(raised.value)


def test_a_server_that_is_started_later_is_waited_for(caplog: pytest.LogCaptureFixture) -> None:
    instance = unused_instance()
    with ThreadPoolExecutor() as threads:
        waiting = threads.submit(connect, instance, wait=PATIENCE)
        assert eventually(lambda: "waiting up to 20 s" in caplog.text)
        started = server(instance)
        with waiting.result(2 * PATIENCE) as client:
            assert client.info.pid == started.program.pid
    assert caplog.text.count("waiting up to 20 s") == 2  # this test and `server`
    assert f"no server on instance {instance!r}" in caplog.text


@pytest.mark.parametrize("name", ["", "a/b", "a b", ".", "ä", "x" * 65, "a\n", "a\0"])
def test_a_bad_instance_name_is_refused(name: str) -> None:
    with refuses("instance: expected 1 to 64 characters"):
        connect(name)


def test_the_longest_instance_name_is_served() -> None:
    name = f"python-{US}-".ljust(64, "x")
    assert server(name).connect().instance == name


def _segment(name: str) -> Path:
    uid = os.getuid()
    return Path(f"/dev/shm/emberwatch-{uid}_{'0123456789abcdef' * 2}{US:08x}_{name}")


def _identity(pid: int, seconds: float) -> int:
    return pid << 64 | int(seconds)


def test_what_dead_processes_left_half_made_is_removed_and_the_young_of_others_stays() -> None:
    nobody = 1 << 30
    dead = [_segment(f"{_identity(nobody, time.monotonic())}.dynamic")]
    dead += [_segment(f"{_identity(US, max(time.monotonic() - 60, 0))}.data")]
    dead += [_segment(f"{_identity(nobody, 0)}_{_identity(nobody, 1)}.connection")]
    young = _segment(f"{_identity(US, time.monotonic() + 60)}.dynamic")
    for path in dead:
        path.touch(0o200)
    young.write_text("finished")
    node = CHANNELS / "nodes" / str(_identity(nobody, time.monotonic()))
    node.mkdir()
    (node / "emberwatch-0_node.details").touch(0o600)
    try:
        with pytest.raises(errors.NoServerError):
            connect("nobody-here")
        assert [path for path in (*dead, node) if path.exists()] == []
        assert young.exists()
    finally:
        young.unlink()


def test_what_a_living_process_does_not_finish_is_not_waited_for_without_end() -> None:
    young = _segment(f"{_identity(US, time.monotonic() + 60)}.dynamic")
    young.touch(0o200)
    try:
        with fails("channel", match=young.name):
            connect("nobody-here")
    finally:
        young.unlink()


def test_a_wait_for_the_lock_ends_with_its_limit_or_ctrl_c() -> None:
    started = server()
    with (CHANNELS / "lock").open("rb+") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with fails("channel", match=f"the lock within .*, got it held by pid {US}"):
            connect(started.instance, timeout=0.01)
        threading.Timer(0.2, lambda: os.kill(US, signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            connect(started.instance)
    started.connect().status()


def test_a_stopped_process_in_its_turn_keeps_nobody_waiting() -> None:
    code = (
        "import fcntl, os, signal, sys; lock = open(sys.argv[1], 'r+'); "
        "fcntl.flock(lock, fcntl.LOCK_EX); print(flush=True); os.kill(os.getpid(), signal.SIGSTOP)"
    )
    command = [sys.executable, "-c", code, str(CHANNELS / "lock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as holder:
        try:
            assert holder.stdout is not None
            holder.stdout.readline()
            with pytest.raises(errors.NoServerError):
                connect("nobody-here")
            assert holder.poll() is None
        finally:
            holder.kill()
