"""Faults: processes that are killed or stopped at the worst moment."""

import signal
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import CHANNELS, LONG, asleep, eventually, script, server, services

from emberwatch import errors
from emberwatch.client.client import connect

#: A learner on worlds in its process, or on the server that its argument names.
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

#: Ways to end the learner, by itself or by a signal while it steps, and its exit code.
ENDS: dict[str | signal.Signals, int] = {
    "": 0,
    "raise ValueError('unhandled')": 1,
    "os._exit(4)": 4,
    "import atexit; env.itself = env; atexit.register(lambda: env.step([3] * 6))": 0,
    "import threading; threading.Thread(target=fly, daemon=True).start(); env.step([3] * 6)": 0,
    signal.SIGKILL: -signal.SIGKILL,
    signal.SIGINT: -signal.SIGINT,
}


@pytest.mark.parametrize("what", ["step", "status", "handshake"])
def test_killing_the_server_raises_server_gone(what: str) -> None:
    started = server()
    client = started.connect()
    lease = client.acquire()
    calls: dict[str, Callable[[], object]] = {
        "step": lambda: lease.step([3] * 6, timeout=LONG),
        "status": lambda: client.status(timeout=LONG),
        "handshake": lambda: connect(started.instance, timeout=LONG),
    }
    started.stop()
    killer = threading.Thread(target=lambda: (asleep(), started.kill()))
    killer.start()
    with pytest.raises(errors.ServerGoneError, match=started.instance):
        calls[what]()
    killer.join()


class Remains:
    def __init__(self, *pids: int) -> None:
        maps = "".join(Path(f"/proc/{pid}/maps").read_text() for pid in pids)
        words = [line.split(maxsplit=5)[-1] for line in maps.splitlines()]
        self._files = {Path(word) for word in words if word.startswith("/dev/shm/emberwatch")}
        self._pids = pids
        assert len(self._files) > 5

    def left(self) -> list[str]:
        """Returns leftover files. iceoryx2 itself keeps one file of 16 bytes for all processes."""
        found = [path for path in self._files if path.exists() and path.stat().st_size > 16]
        nodes = (path for path in (CHANNELS / "nodes").iterdir() if path.name.isdecimal())
        pids = (int(path.name) >> 64 & 0xFFFFFFFF for path in nodes)
        return [*map(str, found), *(str(pid) for pid in pids if pid in self._pids)]


@pytest.mark.parametrize("end", ENDS, ids=lambda it: str(it).partition(";")[0] or "normal")
def test_a_learner_leaves_nothing_however_it_ends(end: str | signal.Signals) -> None:
    started, by_itself = server(), isinstance(end, str)
    for instance in ([], [started.instance]):
        rest = f"input()\n{end}" if by_itself else "while True: env.step([1] * 6)"
        learner = script(LEARNER + rest, *instance)
        assert learner.line() == "flies"
        remains = Remains(learner.pid) if instance else None
        learner.say() if by_itself else learner.signal(end)
        assert learner.end()[0] == ENDS[end]
    # The server's world is free. Once the server has ended, the next one removes leftovers.
    assert eventually(lambda: started.status().n_clients == 1)
    started.connect().acquire()
    started.close()
    server()
    assert (remains.left(), services(started.instance)) == ([], [])
