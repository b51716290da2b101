"""Connections to a server, or to worlds in this process: JSON requests and steps."""

import json
from collections.abc import Mapping
from typing import Any, Final, Self, cast

import emberwatch._native as _native
from emberwatch._native import VERSION
from emberwatch.client import wire
from emberwatch.client.replies import ServerInfo, record
from emberwatch.client.wire import StepAnswer
from emberwatch.errors import bad_answer, repr_of

#: Default timeout of a step, seconds.
STEP_TIMEOUT: Final = 5.0

#: Default timeout of requests that may wait for a burn-in, seconds.
RESET_TIMEOUT: Final = 600.0

#: Name of this program in the server's log.
CLIENT: Final = f"emberwatch-python {VERSION}"


class Closable:
    """An object with a `close` method, which the end of a `with` block calls."""

    def close(self) -> None:
        """Closes the object. May be called again."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Connection(Closable):
    """A channel of JSON messages. Threads may share it; requests run one at a time."""

    def __init__(self, instance: str, native: _native.Connection) -> None:
        self.instance: Final = instance
        self._native: Any = native

    def close(self) -> None:
        """Closes the connection, which ends its leases. May be called again."""
        self._native.close()

    def control(self, request: Mapping[str, Any], *, timeout: float) -> dict[str, Any]:
        """Sends a JSON request (PROTOCOL.md section 6), and returns the reply's keys and values."""
        what = f"{request['op']!r}"
        answer = self._native.control(json.dumps(request).encode(), what, timeout)
        return decoded(f"answer to {what}", answer)


class ServerConnection(Connection):
    """A connection that also steps worlds."""

    def __init__(
        self,
        instance: str = "default",
        *,
        timeout: float = STEP_TIMEOUT,
        embedded: _native.Connection | None = None,
    ) -> None:
        """Connects to a server, or to `embedded` worlds in this process."""
        super().__init__(instance, embedded or _native.Connection(instance, CLIENT, timeout))
        self.info: Final = record(ServerInfo, decoded("answer to 'hello'", self._native.info))
        self.shape: Final = self.info.shape

    def observe(
        self,
        first_robot: int = 0,
        n_robots: int = 1,
        *,
        team: bool = False,
        timeout: float = STEP_TIMEOUT,
    ) -> StepAnswer:
        """Returns results and frames of the last step again. Needs no lease and changes nothing.

        Args:
            first_robot: The number of the first robot.
            n_robots: Number of robots.
            team: Whether to return one frame for each world's team instead of one for each robot.
            timeout: Seconds to wait for the answer.
        """
        flags = wire.TEAM_FRAMES if team else 0
        return self.exchange(wire.OBSERVE, 0, first_robot, n_robots, flags, b"", timeout=timeout)

    def exchange(
        self,
        operation: int,
        lease: int,
        first_robot: int,
        n_robots: int,
        flags: int,
        body: bytes,
        *,
        timeout: float,
    ) -> StepAnswer:
        """Sends a raw request to the service `step`. Prefer `Lease.step` and `observe`."""
        n_moves = self.info.n_moves if operation == wire.STEP else 0
        place = first_robot, n_robots
        answer = self._native.step(operation, lease, *place, n_moves, flags, body, timeout)
        return StepAnswer(answer)

    def truths(self, worlds: range) -> list[dict[str, Any]]:
        """Returns the hidden states of worlds in this process, as the fields of `Truth`."""
        return self._native.truths(worlds.start, len(worlds))

    def clone_state(self) -> bytes:
        """Returns the state of all worlds in this process, as bytes of a snapshot.

        Raises:
            InvalidArgumentError: If the worlds are on a server; see `snapshot`.
        """
        return self._native.snapshot()

    def restore_state(self, worlds: bytes) -> None:
        """Replaces all worlds in this process with the worlds that `clone_state` returned.

        Then call `Lease.observe`: the next paths start from the steps that it returns.

        Raises:
            InvalidArgumentError: If the bytes are damaged or of other worlds, or the worlds are on
                a server. No world has changed then.
        """
        self._native.restore(worlds)

    def lease(self, number: int, robots: range) -> _native.Lease:
        """Returns the native object that steps robots under the lease `number`."""
        return _native.Lease(self._native, number, robots.start, len(robots))


def decoded(what: str, text: str) -> dict[str, Any]:
    """Parses a JSON object; `what` names it in errors."""
    try:
        reply = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise bad_answer(what, "JSON", error) from None
    if not isinstance(reply, dict):
        raise bad_answer(what, "an object", repr_of(reply))
    return cast("dict[str, Any]", reply)
