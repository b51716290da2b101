"""Faults: processes killed and stopped at the worst moment."""

import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import (
    CHANNELS,
    LONG,
    PATIENCE,
    Script,
    Server,
    asleep,
    connects,
    eventually,
    is_running,
    script,
    server,
    services,
)

from emberwatch import errors
from emberwatch.client import connect
from emberwatch.env import WildfireEnv

SMALL = {"height": 5, "width": 7, "n_moves": 6, "burn_in": 20}

#: A learner with a private server: prints the server's pid and its instance.
EMBEDDED = """
import os, sys, time
from emberwatch.env import WildfireEnv
env = WildfireEnv(height=5, width=7, n_moves=6, burn_in=20)
env.reset(seed=1)
env.step([3] * 6)
session = env._session
print(session._client.info.pid, session.instance, flush=True)

def fly():
    while True:
        env.step([3] * 6)
"""

#: How it may end by itself, and the exit code.
ENDS = {
    "": 0,
    "env.close()": 0,
    "sys.exit(3)": 3,
    "raise ValueError('unhandled')": 1,
    "os._exit(4)": 4,
    "os.abort()": -signal.SIGABRT,
    "import threading; threading.Thread(target=lambda: time.sleep(0.1)).start()": 0,
    "env.itself = env": 0,
    "import atexit; atexit.register(lambda: env.step([3] * 6))": 0,
    "import threading; threading.Thread(target=fly, daemon=True).start(); time.sleep(0.1)": 0,
}

ABRUPT = ("os._exit(4)", "os.abort()")

#: How it may be ended while it steps.
SIGNALS = {
    signal.SIGKILL: -signal.SIGKILL,
    signal.SIGTERM: -signal.SIGTERM,
    signal.SIGHUP: -signal.SIGHUP,
    signal.SIGINT: -signal.SIGINT,
}


def check_kill(started: Server, call: Callable[[], object]) -> None:
    """Kills the server while a call waits for it, which says so."""
    started.stop()

    def kill() -> None:
        asleep()
        started.kill()

    killer = threading.Thread(target=kill)
    killer.start()
    with pytest.raises(errors.ServerGoneError, match=started.instance):
        call()
    killer.join()


@pytest.mark.parametrize("what", ["step", "control"])
def test_a_server_killed_during_a_request_is_gone(what: str) -> None:
    started = server()
    client = started.connect()
    lease = client.acquire()
    calls = {"step": lambda: lease.step([3] * 6, timeout=LONG)}
    calls |= {"control": lambda: client.status(timeout=LONG)}
    check_kill(started, calls[what])
    with pytest.raises(errors.ServerGoneError):
        client.observe()


def test_a_server_killed_during_the_handshake_is_gone() -> None:
    started = server()
    check_kill(started, lambda: connect(started.instance, timeout=LONG))


def test_a_server_killed_between_steps_is_gone_at_the_next() -> None:
    started = server()
    client = started.connect()
    lease = client.acquire()
    lease.step([3] * 6)
    started.kill()
    for call in (lambda: lease.step([3] * 6), client.status, lease.observe, lease.release):
        with pytest.raises(errors.ServerGoneError, match=started.instance):
            call()
    with pytest.raises(errors.NoServerError):
        connect(started.instance)


def test_a_stopped_server_is_a_timeout_and_observing_tells_what_happened() -> None:
    started = server()
    lease = started.connect().acquire()
    for k in range(5):
        before = lease.observe().result().world.step
        assert before == lease.observe().result().world.step
        started.stop()
        with pytest.raises(errors.RequestTimeoutError, match=r"within 0\.3 s"):
            lease.step([k % 4] * 6, timeout=0.3)
        started.wake_up()
        seen = lease.observe()
        # The step was made or not; it is never made later.
        assert seen.result().world.step in (before, before + 1)
        assert lease.observe().result() == seen.result()
        assert lease.step([1] * 6).result().world.step == seen.result().world.step + 1


def test_an_answer_that_comes_in_time_after_a_pause_is_the_steps() -> None:
    started = server()
    lease = started.connect().acquire()
    started.stop()
    threading.Timer(0.1, started.wake_up).start()
    assert lease.step([3] * 6, timeout=PATIENCE).result().world.step == 1


class Remains:
    """What two processes have in shared memory, and whether it is gone."""

    def __init__(self, *pids: int) -> None:
        maps = "".join(Path(f"/proc/{pid}/maps").read_text() for pid in pids)
        words = [line.split(maxsplit=5)[-1] for line in maps.splitlines()]
        self._files = {Path(word) for word in words if word.startswith("/dev/shm/emberwatch")}
        self._pids = pids
        assert len(self._files) > 5

    def left(self) -> list[str]:
        """What is left. iceoryx2 keeps one file of 16 bytes for all processes."""
        found = [path for path in self._files if path.exists() and path.stat().st_size > 16]
        nodes = (path for path in (CHANNELS / "nodes").iterdir() if path.name.isdecimal())
        pids = (int(path.name) >> 64 & 0xFFFFFFFF for path in nodes)
        return [*map(str, found), *(str(pid) for pid in pids if pid in self._pids)]


def embedded(end: str) -> tuple[Script, int, str]:
    """A learner with a private server: its process, the server's pid and instance."""
    learner = script(EMBEDDED + end)
    pid, instance = learner.line().split()
    return learner, int(pid), instance


@pytest.mark.parametrize("end", ENDS, ids=lambda end: end.partition(";")[0] or "normal")
def test_a_private_server_ends_however_python_ends(end: str) -> None:
    learner, pid, instance = embedded("input()\n" + end)
    assert is_running(pid)
    remains = Remains(learner.pid, pid)
    learner.say()
    code, _, _ = learner.end()
    assert code == ENDS[end]
    # A server that Python stops ends before it; else the server notices.
    limit = PATIENCE if end in ABRUPT else 0.0
    assert eventually(lambda: not is_running(pid), limit)
    next_start(instance)
    assert (remains.left(), services(instance)) == ([], [])


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_a_private_server_ends_with_a_signalled_python(number: int) -> None:
    learner, pid, instance = embedded("while True: env.step([1] * 6)")
    remains = Remains(learner.pid, pid)
    learner.signal(number)
    code, _, _ = learner.end()
    assert code == SIGNALS[number]
    assert eventually(lambda: not is_running(pid))
    next_start(instance)
    assert (remains.left(), services(instance)) == ([], [])


def test_nothing_is_left_when_learner_and_private_server_are_killed() -> None:
    learner, pid, instance = embedded("while True: env.step([1] * 6)")
    remains = Remains(learner.pid, pid)
    for process in (pid, learner.pid):
        os.kill(process, signal.SIGKILL)
    learner.end()
    assert eventually(lambda: not is_running(pid))
    next_start(instance)
    assert (remains.left(), services(instance)) == ([], [])


def next_start(instance: str) -> None:
    """What any next start does first; nobody serves the instance of the last one."""
    with pytest.raises(errors.NoServerError):
        connect(instance)
    env = WildfireEnv(**SMALL)
    env.reset(seed=1)
    env.close()


def test_a_killed_client_frees_its_worlds_at_once() -> None:
    started = server()
    code = (
        "import sys; from emberwatch import connect\n"
        "lease = connect(sys.argv[1]).acquire(ttl=3600)\n"
        "lease.step([3] * 6)\n"
        "print('held', flush=True)\n"
        "while True: lease.step([3] * 6)"
    )
    holder = script(code, started.instance)
    assert holder.line() == "held"
    next_client = started.connect()
    holder.signal(signal.SIGKILL)
    holder.end()
    assert next_client.acquire().step([3] * 6).result().world.step > 1


def test_killed_clients_use_up_no_limit() -> None:
    started = server()
    code = (
        "import sys; from emberwatch import connect\n"
        "clients = [connect(sys.argv[1]) for _ in range(8)]\n"
        "print('connected', flush=True); input()"
    )
    for _ in range(3):
        clients = script(code, started.instance)
        assert clients.line() == "connected"
        clients.signal(signal.SIGKILL)
        clients.end()
    assert eventually(lambda: started.status().n_clients == 1)
    assert all(eventually(lambda: connects(started)) for _ in range(15))
