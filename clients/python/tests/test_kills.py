"""Python clients killed at any moment of their lives: nothing is left, nobody else is disturbed.

`python test_kills.py 200` kills so many, and says how long others waited.
"""

import os
import random
import signal
import sys
import threading
import time

from processes import CHANNELS, at_the_end, eventually, script, server

from emberwatch.client.client import connect

#: Starts, steps and ends clients of a server, or environments on one of its worlds.
LIFE = """
import sys
import gymnasium, emberwatch

instance, what = sys.argv[1:]
print("begun", flush=True)
while what == "client":
    with emberwatch.connect(instance) as client, client.acquire(0) as lease:
        for _ in range(20):
            lease.step([3] * 6)
while True:
    env = gymnasium.make("emberwatch/Wildfire-v0", instance=instance)
    env.reset(seed=1)
    for _ in range(20):
        env.step([3] * 6)
    env.close()
"""

#: Moments of a life, seconds.
LONGEST = {"client": 0.03, "environment": 0.05}


class Bystander:
    """Flies another world all the while."""

    def __init__(self, instance: str) -> None:
        self._lease = connect(instance).acquire(1)
        self._is_over = False
        self.waits = list[float]()
        self._thread = threading.Thread(target=self._fly, daemon=True)
        self._thread.start()

    def _fly(self) -> None:
        while not self._is_over:
            start = time.perf_counter()
            step = self._lease.step([3] * 6).result().world.step
            self.waits.append(time.perf_counter() - start)
            assert step == len(self.waits)
            time.sleep(0.001)

    def end(self) -> None:
        """Checks that each step was made, and was the next."""
        is_flying = self._thread.is_alive()
        self._is_over = True
        self._thread.join()
        assert is_flying
        self._lease.client.close()


def _files() -> set[str]:
    return {f"{folder}/{name}" for folder, _, names in os.walk(CHANNELS) for name in names}


def kill(n: int) -> list[float]:
    """Kills so many clients; returns how long each step of another one took, seconds."""
    rng, started = random.Random(n), server(worlds=2)
    bystander = Bystander(started.instance)
    lives = [*LONGEST] * (n // len(LONGEST))
    before = _files()
    for what in lives:
        victim = script(LIFE, started.instance, what)
        assert victim.line() == "begun"
        time.sleep(rng.uniform(0.0, LONGEST[what]))
        victim.signal(signal.SIGKILL)
        victim.end()
        with connect(started.instance, timeout=20.0) as client, client.acquire(0) as lease:
            lease.step([3] * 6)
        victim.close()
    assert eventually(lambda: started.status().n_clients == 2)
    with connect(started.instance):  # Removes what the last one has left.
        pass
    left = _files() - before
    assert eventually(lambda: not _files() - before), left
    bystander.end()
    return bystander.waits


def test_killed_clients_leave_nothing_and_disturb_nobody() -> None:
    kill(8)


if __name__ == "__main__":
    waits = sorted(kill(int(sys.argv[1])))
    at_the_end.close()
    print(
        f"{sys.argv[1]} clients killed; of {len(waits)} steps of another one the median took "
        f"{waits[len(waits) // 2] * 1e3:.3f} ms, the longest {waits[-1] * 1e3:.1f} ms"
    )
