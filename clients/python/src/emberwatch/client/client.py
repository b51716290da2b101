"""A connection to a server: robots to fly, worlds to observe and to store.

`connect` gives a `Client`, its `acquire` a `Lease`, and that one's `step` a `StepAnswer`.
Every call waits `timeout` seconds for its answer; everything returned is a copy.
"""

import json
import logging
import os
import sys
import time
from base64 import b64decode
from collections.abc import Callable, Mapping
from typing import Any, Final, TypeVar

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
from emberwatch.common.arguments import as_setting
from emberwatch.common.paths import utf8
from emberwatch.errors import EmberwatchError, NoServerError, bad_answer, invalid

_Connection = TypeVar("_Connection")

_log: Final = logging.getLogger("emberwatch")

#: Milliseconds without use after which leases of worlds in this process end.
_EMBEDDED_LEASE: Final = 86_400_000

#: How long to sleep between two attempts to connect, at first and at most, seconds.
_FIRST_RETRY: Final = 0.005
_RETRY: Final = 0.2


class Client(ServerConnection):
    """A connection to one server, made with `connect`, or to worlds in this process, with `embed`.

    Close it, or use it in a `with`.
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
        """Gets the right to fly consecutive robots, once their worlds are out of their burn-in.

        Robot r of world w has number w R + r, with R = `info.n_robots`. To resume what another
        agent left, continue from `lease.observe()`: it has k, the robot's cell and the last frame.
        To start again, `lease.reset()`.

        Args:
            takeover: Take them from their holders.
            ttl: The lease ends this long after its last use, seconds; None: the server's default.

        Raises:
            EmberwatchError: With code `"busy"` if somebody else holds one of them, or
                `"no_such_robot"`.
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
        """The results and frames of an earlier step k of the episode, as `observe` has them.

        If the server no longer keeps it, the error's `code` is `"not_kept"`, and its `detail` the
        nearest step that it keeps.
        """
        if not 0 <= step < 2**64:
            raise invalid("step", "an integer within 0 to 2**64 - 1", repr(step))
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
        """Writes worlds to a file on the server's host; `Lease.restore` reads it. Needs no lease.

        Args:
            path: The file; a relative path is one from this process's folder.
            n_worlds: How many; None: all from the first.

        Returns:
            The worlds in the file, as they were.
        """
        n_worlds = self.info.n_worlds - first_world if n_worlds is None else n_worlds
        place = {"first_world": first_world, "n_worlds": n_worlds}
        request = {"op": "snapshot", **place, "path": utf8("path", os.path.abspath(path))}
        return records(WorldInfo, self.control(request, timeout=timeout))

    def belief(self, robot: int = 0, *, timeout: float = STEP_TIMEOUT) -> LeftBelief | None:
        """The belief that a robot's agent left about the present step; None if there is none."""
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
                data, first = b"", None  # another one was left meanwhile
                continue
            data += part
            if len(data) == info.length:
                return LeftBelief(info.kind, info.episode, info.step, data)
            if not part or len(data) > info.length:
                raise bad_answer("answer to 'belief'", f"{info.length} bytes", len(data))

    def status(self, *, timeout: float = STEP_TIMEOUT) -> ServerStatus:
        reply = self.control({"op": "status"}, timeout=timeout)
        worlds = records(WorldStatus, reply)
        return record(ServerStatus, {**reply, "worlds": worlds})

    def shutdown(self, *, timeout: float = STEP_TIMEOUT) -> None:
        """Stops the server for all its clients."""
        self.control({"op": "shutdown"}, timeout=timeout)


def connect(
    instance: str = "default", *, timeout: float = STEP_TIMEOUT, wait: float = 0.0
) -> Client:
    """Connects to a running server, or with `wait` to one that is just starting.

    Args:
        wait: How long to wait until there is a server, seconds; 0: fail at once.

    Raises:
        NoServerError: If nobody serves the instance by then.
        RequestTimeoutError: If the server does not answer.
        EmberwatchError: With code `"version_mismatch"` if it speaks another protocol version, or
            `"channel"`, also when there are too many clients.
    """
    return connect_with_retry(wait, lambda: Client(instance, timeout=timeout))


def embed(**settings: str | float | bool | os.PathLike[str] | None) -> Client:
    """Worlds inside this process, with all that a `Client` can do, and without a server.

    Nobody else can watch them or fly in them, and they end with the client. Wherever a server's
    results would depend on seeds and actions alone, theirs are the same bytes. Leases end a day
    after their last use. Ctrl-C ends the wait for a reset or a file, and comes after a step.

    Args:
        settings: Those of `config/server.toml`, such as `worlds=4`, `task="small"`, `seed=7`; None:
            the default. Not `instance`, nor the server's own snapshots.

    Raises:
        InvalidArgumentError: If a setting is unknown or wrong.
        NotEnoughMemoryError: If they would take more than the machine, a cgroup or a `ulimit` has.
        EmberwatchError: With code `"threads"` if the system starts none.
    """
    return embed_settings(settings, warns=True)


def embed_settings(settings: Mapping[str, Any], *, warns: bool) -> Client:
    """Like `embed`; `warns`: of starts that no-fly cells close in, unless a check has done so."""
    # Nobody else waits for its robots.
    chosen: dict[str, object] = {"lease_millis": _EMBEDDED_LEASE}
    for name, given in settings.items():
        if given is not None:
            chosen[name] = as_setting(name, given)
    return Client("(embedded)", embedded=_native.Server.embedded(json.dumps(chosen), warns))


def connect_with_retry(wait: float, connect: Callable[[], _Connection]) -> _Connection:
    """Connects as soon as somebody answers, within `wait` seconds; logs once that it waits."""
    deadline, waits, pause = time.monotonic() + wait, False, _FIRST_RETRY
    while True:
        try:
            return connect()
        except NoServerError as error:
            left = deadline - time.monotonic()
            # Not "<=": "not a number" would never end.
            if not left > 0:
                raise
            if not waits:
                _log.warning(f"{error}; waiting up to {wait:g} s for it")
            waits = True
            time.sleep(min(pause, left))
            pause = min(2 * pause, _RETRY)
