"""Measures how soon Ctrl-C and the death of a server end a waiting step.

For comparison: Ctrl-C in `time.sleep`, and a pidfd that reports the end of the same server.
"""

from __future__ import annotations

import os
import select
import signal
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial

from race import server, spread

import emberwatch
from emberwatch.errors import ServerGoneError

N_ROUNDS = 20

#: Seconds after which a step is certainly waiting for its answer.
PAUSE = 0.05

TIMEOUT = 20.0


@contextmanager
def stopped() -> Iterator[tuple[Callable[[], object], int]]:
    """Yields a step that waits for a paused server, and the server's process ID."""
    with (
        server("--height=5", "--width=7", "--moves=6", "--burn-in=20") as (instance, pid),
        emberwatch.connect(instance) as client,
    ):
        lease = client.acquire()
        os.kill(pid, signal.SIGSTOP)
        yield lambda: lease.step([3] * 6, timeout=TIMEOUT), pid


def millis(call: Callable[[], object], end: Callable[[], None]) -> float:
    """Returns the milliseconds from `end`, on another thread, to the end of a call."""
    sent: list[float] = []

    def later() -> None:
        time.sleep(PAUSE)
        sent.append(time.perf_counter())
        end()

    thread = threading.Thread(target=later)
    with suppress(KeyboardInterrupt, ServerGoneError):
        thread.start()
        call()
    seconds = time.perf_counter() - sent[0]
    thread.join()
    return 1e3 * seconds


def interrupt() -> None:
    """Sends Ctrl-C to this process."""
    os.kill(os.getpid(), signal.SIGINT)


def main() -> None:
    """Prints all rows."""
    found = defaultdict[str, list[float]](list)
    for _ in range(N_ROUNDS):
        with stopped() as (step, _pid):
            found["Ctrl-C ends a waiting step"].append(millis(step, interrupt))
        found["Ctrl-C ends time.sleep"].append(millis(partial(time.sleep, TIMEOUT), interrupt))
        with stopped() as (step, pid):
            kill = partial(os.kill, pid, signal.SIGKILL)
            found["a killed server ends a step"].append(millis(step, kill))
        with stopped() as (_step, pid):
            process, kill = os.pidfd_open(pid), partial(os.kill, pid, signal.SIGKILL)
            wait = partial(select.select, [process], [], [])
            found["a killed server ends a pidfd"].append(millis(wait, kill))
            os.close(process)
    for name, times in found.items():
        print(f"{name:32} {spread(times)} ms")


if __name__ == "__main__":
    main()
