"""A connection to a server: handshake, leases, steps.

`connect` gives a `Client`, its `acquire` a `Lease`, and that one's `step` a `StepAnswer`.
Every call has a timeout in seconds; everything returned is a copy.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from base64 import b64decode
from collections.abc import Callable, Mapping
from typing import Any, Final, TypeVar

from emberwatch import wire
from emberwatch.channels import Closing, Node
from emberwatch.errors import (
    GarbledAnswerError,
    NoServerError,
    NotKeptError,
    SettingError,
    refusal,
)
from emberwatch.lease import Lease
from emberwatch.ports import RESET_TIMEOUT, STEP_TIMEOUT, Bell, RequestPort
from emberwatch.release import VERSION
from emberwatch.replies import (
    Grant,
    LeftBelief,
    LeftBeliefInfo,
    ServerInfo,
    ServerStatus,
    WorldInfo,
    WorldStatus,
    ask,
    record,
    records,
)
from emberwatch.wire import StepAnswer

_Connection = TypeVar("_Connection")

_log: Final = logging.getLogger("emberwatch")

#: How long to sleep between two looks for a server, seconds.
_RETRY: Final = 0.2


class Client(Closing):
    """A connection to one server. Make it with `connect`; close it, or use it in a `with`.

    Threads may share it: they take turns.
    """

    def __init__(self, instance: str = "default", *, timeout: float = STEP_TIMEOUT) -> None:
        """Connects and shakes hands; see `connect`."""
        self._node = Node(instance)
        self._sequence = 0
        self._turn = threading.Lock()
        try:
            self._bell = Bell(self._node)
            self._control = RequestPort(
                self._bell,
                "control",
                (wire.ControlRequest, wire.ControlReply),
                slice_len=4096,
                grows=True,
            )
            self.info: Final = self._shake_hands(timeout)
            self._bell.watch(self.info.pid)
            self._step = RequestPort(
                self._bell,
                "step",
                (wire.StepRequest, wire.StepReply),
                slice_len=self.info.n_worlds * self.info.n_moves,
                grows=False,
            )
        except BaseException:
            self.close()
            raise

    @property
    def instance(self) -> str:
        """The instance's name."""
        return self._node.instance

    def acquire(
        self,
        first_world: int = 0,
        n_worlds: int = 1,
        *,
        takeover: bool = False,
        ttl: float | None = None,
        timeout: float = RESET_TIMEOUT,
    ) -> Lease:
        """Gets the right to act on consecutive worlds, once they are out of their burn-in.

        To resume what another agent left, go on from `lease.observe()`: it has k, the robot's
        cell and the last frame. To start anew, `lease.reset()`.

        Args:
            first_world: The first world.
            n_worlds: How many.
            takeover: Take them from whoever holds them.
            ttl: The lease ends this long after its last use, seconds; None: the server's default.
            timeout: How long to wait for the answer, seconds.

        Raises:
            BusyError: If somebody else holds one of them.
            NoSuchWorldError: If the server has no such worlds.
        """
        request = {
            "op": "acquire",
            "first_world": first_world,
            "n_worlds": n_worlds,
            "takeover": takeover,
            "ttl_millis": None if ttl is None else round(ttl * 1000),
        }
        reply = self.control(request, timeout=timeout)
        worlds = range(first_world, first_world + n_worlds)
        return Lease(self, record(Grant, reply), records(WorldInfo, reply), worlds)

    def observe(
        self, first_world: int = 0, n_worlds: int = 1, *, timeout: float = STEP_TIMEOUT
    ) -> StepAnswer:
        """The last results and frames again. Needs no lease and changes nothing."""
        return self.exchange(wire.OBSERVE, 0, first_world, n_worlds, 0, b"", timeout=timeout)

    def recall(
        self,
        step: int,
        first_world: int = 0,
        n_worlds: int = 1,
        *,
        timeout: float = STEP_TIMEOUT,
    ) -> StepAnswer:
        """The results and frames of an earlier step k of the episode. Needs no lease.

        Raises:
            NotKeptError: If the server does not keep it; `detail` is the nearest step kept.
        """
        if not 0 <= step < 2**64:
            raise SettingError(f"step: expected an integer within 0 to 2**64 - 1, got {step!r}")
        return self.exchange(
            wire.RECALL, 0, first_world, n_worlds, 0, b"", step=step, timeout=timeout
        )

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
            first_world: The first world.
            n_worlds: How many; None: all from the first.
            timeout: How long to wait for the answer, seconds.

        Returns:
            The worlds in the file, as they were.

        Raises:
            BadFileError: If it cannot be written.
        """
        request = {
            "op": "snapshot",
            "first_world": first_world,
            "n_worlds": self.info.n_worlds - first_world if n_worlds is None else n_worlds,
            "path": os.path.abspath(path),
        }
        return records(WorldInfo, self.control(request, timeout=timeout))

    def belief(self, world: int = 0, *, timeout: float = STEP_TIMEOUT) -> LeftBelief | None:
        """What belief was left about a world as it stands; None if there is none."""
        data, first = b"", None
        while True:
            request = {"op": "belief", "world": world, "offset": len(data)}
            try:
                reply = self.control(request, timeout=timeout)
            except NotKeptError:
                return None
            info = record(LeftBeliefInfo, reply)
            try:
                part = b64decode(info.data, validate=True)
            except ValueError as error:
                raise GarbledAnswerError(
                    f"answer to 'belief': expected base64, got {error}"
                ) from None
            whole = (info.kind, info.episode, info.step, info.length)
            first = first or whole
            if whole != first:
                data, first = b"", None  # another one was left meanwhile
                continue
            data += part
            if len(data) == info.length:
                return LeftBelief(info.kind, info.episode, info.step, data)
            if not part or len(data) > info.length:
                raise GarbledAnswerError(
                    f"answer to 'belief': expected {info.length} bytes, got {len(data)}"
                )

    def status(self, *, timeout: float = STEP_TIMEOUT) -> ServerStatus:
        """What is going on."""
        reply = self.control({"op": "status"}, timeout=timeout)
        worlds = records(WorldStatus, reply)
        return record(ServerStatus, {**reply, "worlds": worlds})

    def shutdown(self, *, timeout: float = STEP_TIMEOUT) -> None:
        """Stops the server, for everybody."""
        self.control({"op": "shutdown"}, timeout=timeout)

    def close(self) -> None:
        """Closes the connection; its leases end. Again is fine."""
        for name in ("_step", "_control", "_bell"):
            part = getattr(self, name, None)
            if part is not None:
                part.close()
        self._node.close()

    def control(self, request: Mapping[str, Any], *, timeout: float) -> dict[str, Any]:
        """Asks on `control` (PROTOCOL.md section 6) and returns the reply's keys.

        Raises:
            RefusedError: One of its subclasses, if the server refuses.
            RequestTimeoutError, ServerGoneError, GarbledAnswerError: If there is no good answer.
        """
        self._node.check()
        with self._turn:
            self._sequence += 1
            return ask(self._control, self._bell, self._sequence, request, timeout)

    def exchange(
        self,
        operation: int,
        lease: int,
        first_world: int,
        n_worlds: int,
        flags: int,
        paths: bytes,
        *,
        step: int = 0,
        timeout: float,
    ) -> StepAnswer:
        """Sends one request on `step` as it is; `Lease.step` and `observe` are easier.

        Raises:
            RefusedError: One of its subclasses, if the server refuses.
            RequestTimeoutError, ServerGoneError, GarbledAnswerError: If there is no good answer.
        """
        self._node.check()
        with self._turn:
            self._sequence = sequence = self._sequence + 1
            header = wire.STEP_REQUEST.pack(
                wire.VERSION,
                operation,
                lease,
                sequence,
                first_world,
                n_worlds,
                self.info.n_moves if operation == wire.STEP else 0,
                flags,
                self._bell.listener_low,
                self._bell.listener_high,
                step,
            )
            reply, payload = self._step.exchange(header, paths, "a step", timeout)
        if reply.status != 0:
            raise refusal(reply.status, reply.detail)
        wire.check_answer("answer to step", reply, sequence)
        wire.check_worlds(reply, (first_world, n_worlds, self.info.height, self.info.width))
        return StepAnswer(reply, payload, self.info.n_observations)

    def _shake_hands(self, timeout: float) -> ServerInfo:
        hello = {
            "op": "hello",
            "protocol": wire.VERSION,
            "client": f"emberwatch-python {VERSION}",
        }
        reply = self.control(hello, timeout=timeout)
        return record(ServerInfo, reply)


def connect(
    instance: str = "default", *, timeout: float = STEP_TIMEOUT, wait: float = 0.0
) -> Client:
    """Connects to a running server, or with `wait` to one that is just starting.

    Args:
        instance: The server's instance name.
        timeout: How long to wait for the server's answer, seconds.
        wait: How long to wait until there is a server, seconds; 0: fail at once.

    Raises:
        NoServerError: If nobody serves the instance by then.
        VersionMismatchError: If the server speaks another protocol version.
        RequestTimeoutError: If it does not answer.
        ChannelError: If the channels cannot be opened, also when there are too many clients.
    """
    return when_served(wait, lambda: Client(instance, timeout=timeout))


def when_served(wait: float, connect: Callable[[], _Connection]) -> _Connection:
    """Connects as soon as somebody answers there, and says so once if that is not at once.

    Raises:
        NoServerError: If nobody does within `wait` seconds.
    """
    deadline, waits = time.monotonic() + wait, False
    while True:
        try:
            return connect()
        except NoServerError as error:
            left = deadline - time.monotonic()
            # Not "<=": "not a number" would never end.
            if not left > 0:
                raise
            if not waits:
                _log.warning("%s; waiting up to %g s for it", error, wait)
            waits = True
            time.sleep(min(_RETRY, left))
