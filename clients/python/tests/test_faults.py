"""Faults: processes killed and stopped at the worst moment."""

import signal
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import (
    CHANNELS,
    LONG,
    PATIENCE,
    Server,
    asleep,
    connects,
    eventually,
    script,
    server,
    services,
)

from emberwatch import errors
from emberwatch.client.client import connect

#: A learner on worlds in its process, or at a server that its argument names.
LEARNER = """
import os, sys, time
from emberwatch.envs.path_env import WildfireEnv
instance = {"instance": sys.argv[1]} if len(sys.argv) > 1 else {}
env = WildfireEnv(height=5, width=7, n_moves=6, burn_in=20, **instance)
env.reset(seed=1)
env.step([3] * 6)
print("flies", flush=True)

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
    """What processes have in shared memory, and whether it is gone."""

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


@pytest.mark.parametrize("end", ENDS, ids=lambda end: end.partition(";")[0] or "normal")
def test_a_learner_ends_as_it_wants_and_leaves_nothing(end: str) -> None:
    started = server()
    for instance in ([], [started.instance]):
        learner = script(LEARNER + "input()\n" + end, *instance)
        assert learner.line() == "flies"
        remains = Remains(learner.pid) if instance else None
        learner.say()
        assert learner.end()[0] == ENDS[end]
    check_left(started, remains)


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_a_learner_ends_by_a_signal_and_leaves_nothing(number: int) -> None:
    started = server()
    for instance in ([], [started.instance]):
        learner = script(LEARNER + "while True: env.step([1] * 6)", *instance)
        assert learner.line() == "flies"
        remains = Remains(learner.pid) if instance else None
        learner.signal(number)
        assert learner.end()[0] == SIGNALS[number]
    check_left(started, remains)


def check_left(started: Server, remains: Remains) -> None:
    """The server's world is free; once the server has ended, the next one finds nothing left."""
    assert eventually(lambda: started.status().n_clients == 1)
    started.connect().acquire()
    started.close()
    check_removed(started.instance, remains)


def check_removed(instance: str, remains: Remains) -> None:
    """The next server on this machine removes everything that the last one has left."""
    with pytest.raises(errors.NoServerError):
        connect(instance)
    server()
    assert (remains.left(), services(instance)) == ([], [])


def test_nothing_is_left_when_learner_and_server_are_killed() -> None:
    started = server()
    learner = script(LEARNER + "while True: env.step([1] * 6)", started.instance)
    assert learner.line() == "flies"
    remains = Remains(learner.pid, started.program.pid)
    started.kill()
    learner.signal(signal.SIGKILL)
    learner.end()
    started.close()
    check_removed(started.instance, remains)


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
