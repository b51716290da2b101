"""Threads beside a client: forks meanwhile, other work during waits, refused copies."""

import copy
import pickle
import threading

import pytest
from processes import script, server

#: Forks while a thread opens connections, or steps with one; each child flies a robot of its own.
FORKS = """
import os, sys, threading, time
from emberwatch.client import connect
from emberwatch.errors import EmberwatchError

instance, what = sys.argv[1:]
held = connect(instance)
lease, is_over, errors = held.acquire(0), threading.Event(), []

def opens():
    with connect(instance) as client:
        client.acquire(1).release()

def steps():
    lease.step([3] * 6)

def loop():
    try:
        while not is_over.is_set():
            {"opens": opens, "steps": steps}[what]()
    except Exception as error:
        errors.append(error)

def child():
    try:
        lease.step([3] * 6)
    except EmberwatchError as error:
        assert error.code == "forked"
    with connect(instance) as client:
        client.acquire(2).step([3] * 6)

lease.step([3] * 6)  # Imports what it needs before any fork.
thread = threading.Thread(target=loop)
thread.start()
codes = set()
for _ in range(40):
    pid = os.fork()
    if pid == 0:
        try:
            child()
            os._exit(0)
        finally:
            os._exit(7)
    codes.add(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
is_over.set()
thread.join()
lease.step([3] * 6)
print(codes, errors)
"""


@pytest.mark.parametrize("what", ["opens", "steps"])
def test_children_of_a_busy_process_open_their_own(what: str) -> None:
    started = server(worlds=3)
    ended, out, err = script(FORKS, started.instance, what).end()
    assert (ended, out) == (0, "{0} []\n"), err


def test_a_wait_leaves_the_interpreter_to_other_threads() -> None:
    started = server(robots=2)
    lease, mate = started.connect().acquire(0), started.connect().acquire(1)
    waits = threading.Thread(target=lambda: lease.step([3] * 6))
    waits.start()
    mate.step([3] * 6)  # What the other waits for is done here.
    waits.join()


def test_what_is_open_is_not_copied() -> None:
    client = server().connect()
    for make in (pickle.dumps, copy.deepcopy):
        with pytest.raises(TypeError, match="cannot pickle"):
            make(client)
