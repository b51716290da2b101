"""Measures how soon Ctrl-C and the death of a server end a waiting step.

For comparison: Ctrl-C in `time.sleep`, and a pidfd that reports the end of the same server.
"""

from __future__ import annotations

import os
import select
import signal
import statistics
import subprocess
import threading
import time
import uuid
from collections.abc import Callable
from contextlib import suppress

import emberwatch
from emberwatch.errors import ServerGoneError

N_ROUNDS = 20

#: Seconds after which a step is certainly waiting for its answer.
PAUSE = 0.05

TIMEOUT = 20.0

Times = tuple[float, float]


class Stopped:
    """A paused server, and a lease on its robot."""

    def __init__(self) -> None:
        instance = f"endings-{uuid.uuid4().hex}"
        flags = [f"--instance={instance}", "--height=5", "--width=7", "--moves=6", "--burn-in=20"]
        self.program = subprocess.Popen(["emberwatch-server", *flags])
        self.client = emberwatch.connect(instance, wait=20)
        self.lease = self.client.acquire()
        os.kill(self.program.pid, signal.SIGSTOP)

    def step(self) -> None:
        """Waits for an answer that never comes."""
        self.lease.step([3] * 6, timeout=TIMEOUT)

    def close(self) -> None:
        """Ends the server."""
        self.program.kill()
        self.program.wait()
        self.client.close()


def interrupted(call: Callable[[], object]) -> float:
    """Returns the seconds from Ctrl-C to the end of a call."""
    sent: list[float] = []

    def interrupt() -> None:
        time.sleep(PAUSE)
        sent.append(time.perf_counter())
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    with suppress(KeyboardInterrupt):
        thread.start()
        call()
    seconds = time.perf_counter() - sent[0]
    thread.join()
    return seconds


def interruption() -> Times:
    """Measures the interruption of a step, and of `time.sleep`."""
    server = Stopped()
    times = interrupted(server.step), interrupted(lambda: time.sleep(TIMEOUT))
    server.close()
    return times


def death() -> Times:
    """Measures how soon a step and a pidfd notice a server's death."""
    server = Stopped()
    process = os.pidfd_open(server.program.pid)
    seen: list[float] = []

    def kill() -> None:
        time.sleep(PAUSE)
        seen.append(time.perf_counter())
        os.kill(server.program.pid, signal.SIGKILL)
        select.select([process], [], [])
        seen.append(time.perf_counter())

    thread = threading.Thread(target=kill)
    thread.start()
    with suppress(ServerGoneError):
        server.step()
    end = time.perf_counter()
    thread.join()
    os.close(process)
    server.close()
    return end - seen[0], seen[1] - seen[0]


def report(what: str, measure: Callable[[], Times], peer: str) -> None:
    """Prints the medians, the maximum, and the ratio of the medians."""
    ours, theirs = zip(*(measure() for _ in range(N_ROUNDS)), strict=True)
    median, other = statistics.median(ours), statistics.median(theirs)
    print(
        f"{what:32} p50 {median * 1e3:7.2f} max {max(ours) * 1e3:7.2f} ms, "
        f"{median / other:.1f} times {peer}'s {other * 1e3:.2f} ms",
        flush=True,
    )


def main() -> None:
    """Prints all rows."""
    report("Ctrl-C ends a waiting step", interruption, "time.sleep")
    report("a killed server ends a step", death, "a pidfd")


if __name__ == "__main__":
    main()
