"""A connection to a process that answers: JSON requests, and steps of a server."""

import json
from collections.abc import Mapping
from typing import Any, Final, Self, cast

import emberwatch._native as _native
from emberwatch._native import VERSION
from emberwatch.client import wire
from emberwatch.client.replies import ServerInfo, record
from emberwatch.client.wire import StepAnswer
from emberwatch.errors import bad_answer

#: Default timeout of a step, seconds.
STEP_TIMEOUT: Final = 5.0

#: Default timeout of what may wait for a burn-in, seconds.
RESET_TIMEOUT: Final = 600.0

#: How this program names itself in logs.
CLIENT: Final = f"emberwatch-python {VERSION}"


class Closable:
    """What `with` closes."""

    def close(self) -> None:
        """Closes it; may be called again."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Connection(Closable):
    """A channel of JSON messages. Threads may share it: they take turns."""

    def __init__(self, instance: str, native: _native.Server) -> None:
        self.instance: Final = instance
        self._native: Any = native

    def close(self) -> None:
        """Closes the connection; its leases end. May be called again."""
        self._native.close()

    def control(self, request: Mapping[str, Any], *, timeout: float) -> dict[str, Any]:
        """Sends one JSON request (PROTOCOL.md section 6) and returns the reply's keys."""
        what = f"{request['op']!r}"
        answer = self._native.control(json.dumps(request).encode(), what, timeout)
        return decoded(f"answer to {what}", answer)


class ServerConnection(Connection):
    """A connection to a server, which also steps worlds."""

    def __init__(
        self,
        instance: str = "default",
        *,
        timeout: float = STEP_TIMEOUT,
        embedded: _native.Server | None = None,
    ) -> None:
        """Connects to a server, or to `embedded`, which are worlds in this process."""
        super().__init__(instance, embedded or _native.Server(instance, CLIENT, timeout))
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
        """The last results and frames again, or with `team` the frame of each world's team.

        Needs no lease and changes nothing.
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
        """Sends one request on `step` as it is; `Lease.step` and `observe` are easier."""
        n_moves = self.info.n_moves if operation == wire.STEP else 0
        place = first_robot, n_robots
        answer = self._native.step(operation, lease, *place, n_moves, flags, body, timeout)
        return StepAnswer(answer)

    def truths(self, worlds: range) -> list[dict[str, Any]]:
        """The hidden states of worlds in this process, as the fields of `Truth`."""
        return self._native.truths(worlds.start, len(worlds))

    def lease(self, number: int, robots: range) -> _native.Lease:
        """Steps robots under a lease of this number."""
        return _native.Lease(self._native, number, robots.start, len(robots))


def decoded(what: str, text: str) -> dict[str, Any]:
    """The keys of a JSON object."""
    try:
        reply = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise bad_answer(what, "JSON", error) from None
    if not isinstance(reply, dict):
        raise bad_answer(what, "an object", repr(reply))
    return cast("dict[str, Any]", reply)
