"""Clients: connections that fly robots, observe worlds and store worlds in files.

`connect` returns a `Client`, `Client.acquire` a `Lease`, and `Lease.step` a `StepAnswer`. Every
call waits at most `timeout` seconds for its answer. All returned arrays are copies.
"""

import logging
import os
import sys
import time
from base64 import b64decode
from collections.abc import Callable
from typing import Final, TypeVar

import emberwatch._native as _native
from emberwatch.client import wire
from emberwatch.client.connection import RESET_TIMEOUT, STEP_TIMEOUT, ServerConnection
from emberwatch.client.lease import Lease
from emberwatch.client.replies import (
    Grant,
    LeftBelief,
    LeftBeliefInfo,
    ServerStatus,
    WorldInfo,
    WorldStatus,
    record,
    records,
)
from emberwatch.client.wire import StepAnswer
from emberwatch.common.arguments import read_settings
from emberwatch.common.paths import utf8
from emberwatch.errors import EmberwatchError, NoServerError, bad_answer, invalid, repr_of
from emberwatch.model import Model

_Connection = TypeVar("_Connection")

_log: Final = logging.getLogger("emberwatch")

#: Seconds to sleep after the first attempt to connect, and maximum sleep between later attempts.
_FIRST_RETRY: Final = 0.005
_RETRY: Final = 0.2


class Client(ServerConnection):
    """A connection to a server (see `connect`) or to worlds in this process (see `embed`).

    Close it after use, or use it as a context manager.
    """

    def acquire(
        self,
        first_robot: int = 0,
        n_robots: int = 1,
        *,
        takeover: bool = False,
        ttl: float | None = None,
        timeout: float = RESET_TIMEOUT,
    ) -> Lease:
        """Acquires the right to fly consecutive robots. Waits for the end of their worlds' burn-in.

        Robot r of world w has number w R + r, with R = `info.n_robots`. To resume an episode that
        another agent left, continue from `lease.observe()`, which returns k, the robot's cell and
        the last frame. To begin a new episode, call `lease.reset()`.

        Args:
            first_robot: The number of the first robot.
            n_robots: Number of robots.
            takeover: Whether to take robots away from the clients that hold them.
            ttl: Seconds without use after which the lease expires; None: the server's
                default.
            timeout: Seconds to wait for the answer.

        Raises:
            EmberwatchError: With code `"busy"` if another client holds one of the robots, or
                `"no_such_robot"` if one does not exist.
        """
        request = {
            "op": "acquire",
            "first_robot": first_robot,
            "n_robots": n_robots,
            "takeover": takeover,
            "ttl_millis": None if ttl is None else round(ttl * 1000),
        }
        reply = self.control(request, timeout=timeout)
        robots = range(first_robot, first_robot + n_robots)
        return Lease(self, record(Grant, reply), records(WorldInfo, reply), robots)

    def recall(
        self,
        step: int,
        first_robot: int = 0,
        n_robots: int = 1,
        *,
        team: bool = False,
        timeout: float = STEP_TIMEOUT,
    ) -> StepAnswer:
        """Returns the results and frames of an earlier step k of the episode.

        Args:
            step: The step k.
            first_robot: The number of the first robot.
            n_robots: Number of robots.
            team: Whether to return one frame for each world's team instead of one for each robot.
            timeout: Seconds to wait for the answer.

        Raises:
            EmberwatchError: With code `"not_kept"` if the server has discarded the step; `detail`
                is the nearest step that it keeps.
        """
        if not 0 <= step < 2**64:
            raise invalid("step", "an integer within 0 to 2**64 - 1", repr_of(step))
        flags = wire.TEAM_FRAMES if team else 0
        body = step.to_bytes(8, sys.byteorder) * self.shape.n_worlds(first_robot, n_robots)
        return self.exchange(wire.RECALL, 0, first_robot, n_robots, flags, body, timeout=timeout)

    def snapshot(
        self,
        path: str | os.PathLike[str],
        first_world: int = 0,
        n_worlds: int | None = None,
        *,
        timeout: float = RESET_TIMEOUT,
    ) -> tuple[WorldInfo, ...]:
        """Writes worlds to a file on the server's host, for `Lease.restore`. Needs no lease.

        Args:
            path: The file. A relative path starts at this process's working directory.
            first_world: The first world to write.
            n_worlds: Number of worlds; None: all worlds from `first_world` on.
            timeout: Seconds to wait for the answer.

        Returns:
            The state of each world in the file.
        """
        n_worlds = self.info.n_worlds - first_world if n_worlds is None else n_worlds
        place = {"first_world": first_world, "n_worlds": n_worlds}
        request = {"op": "snapshot", **place, "path": utf8("path", os.path.abspath(path))}
        return records(WorldInfo, self.control(request, timeout=timeout))

    def belief(self, robot: int = 0, *, timeout: float = STEP_TIMEOUT) -> LeftBelief | None:
        """Returns the belief about the current step that a robot's last agent left, or None.

        Another agent can resume with this belief; see `Lease.leave_belief`.
        """
        data, first = b"", None
        while True:
            request = {"op": "belief", "robot": robot, "offset": len(data)}
            try:
                reply = self.control(request, timeout=timeout)
            except EmberwatchError as error:
                if error.code == "not_kept":
                    return None
                raise
            info = record(LeftBeliefInfo, reply)
            try:
                part = b64decode(info.data, validate=True)
            except ValueError as error:
                raise bad_answer("answer to 'belief'", "base64", error) from None
            whole = (info.kind, info.episode, info.step, info.length)
            first = first or whole
            if whole != first:
                data, first = b"", None  # another belief was left meanwhile: read from the start
                continue
            data += part
            if len(data) == info.length:
                return LeftBelief(info.kind, info.episode, info.step, data)
            if not part or len(data) > info.length:
                raise bad_answer("answer to 'belief'", f"{info.length} bytes", len(data))

    def status(self, *, timeout: float = STEP_TIMEOUT) -> ServerStatus:
        """Returns the server's load, and the state of each world."""
        reply = self.control({"op": "status"}, timeout=timeout)
        worlds = records(WorldStatus, reply)
        return record(ServerStatus, {**reply, "worlds": worlds})

    def shutdown(self, *, timeout: float = STEP_TIMEOUT) -> None:
        """Stops the server for all its clients."""
        self.control({"op": "shutdown"}, timeout=timeout)


def connect(
    instance: str = "default", *, timeout: float = STEP_TIMEOUT, wait: float = 0.0
) -> Client:
    """Connects to a running server.

    Args:
        instance: The server's instance name.
        timeout: Seconds to wait for the server's answer.
        wait: Seconds to wait for a server that is still starting; 0: fail at once.

    Raises:
        NoServerError: If no server runs under this name within `wait` seconds.
        RequestTimeoutError: If the server does not answer.
        EmberwatchError: With code `"version_mismatch"` if the server has another protocol version,
            or `"channel"` if the channels cannot be opened or the server has too many clients.
    """
    return connect_with_retry(wait, lambda: Client(instance, timeout=timeout))


def embed(**settings: str | float | bool | os.PathLike[str] | Model | None) -> Client:
    """Creates worlds inside this process, without a server, and returns a `Client` of them.

    No other process can observe these worlds or fly in them, and closing the client ends them.
    Results that depend only on seeds and actions are byte for byte the same as from a server.
    Leases expire a day after their last use. Ctrl-C interrupts the wait for a reset or a file;
    during a step it takes effect after the step.

    Args:
        settings: Settings of `config/server.toml`, such as `worlds=4`, `task="small"`, `seed=7`;
            None: the default. `model` may also be a `Model`. The setting `instance` and the
            settings for a server's own snapshots do not apply here.

    Raises:
        InvalidArgumentError: If a setting is unknown or invalid.
        NotEnoughMemoryError: If the worlds need more memory than the machine, a cgroup or a
            `ulimit` allows.
        EmberwatchError: With code `"threads"` if the system cannot start threads.
    """
    return embed_settings(read_settings(settings))


def embed_settings(settings: _native.CheckedSettings, seed: int | None = None) -> Client:
    """Does what `embed` does. `seed` is the first world's; None: the seed in the settings."""
    return Client("(embedded)", embedded=_native.Connection.embedded(settings, seed))


def connect_with_retry(wait: float, connect: Callable[[], _Connection]) -> _Connection:
    """Tries to connect for up to `wait` seconds, at least once; logs once that it waits."""
    deadline, waits, pause = time.monotonic() + wait, False, _FIRST_RETRY
    while True:
        try:
            return connect()
        except NoServerError as error:
            left = deadline - time.monotonic()
            # Not `left <= 0`, which is false for NaN: the loop would never end.
            if not left > 0:
                raise
            if not waits:
                _log.warning(f"{error}; waiting up to {wait:g} s for a server")
            waits = True
            time.sleep(min(pause, left))
            pause = min(2 * pause, _RETRY)
