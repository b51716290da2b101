"""A connection to a process that answers: handshake, JSON requests, steps."""

import json
import threading
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any, Final, TypeVar, cast

from emberwatch import wire
from emberwatch.channels import Closable, Node, in_turn
from emberwatch.errors import EmberwatchError, RequestTimeoutError, bad_answer, refusal
from emberwatch.ports import STEP_TIMEOUT, Peer, RequestPort
from emberwatch.release import VERSION
from emberwatch.replies import ServerInfo, record
from emberwatch.turn import pid_namespace
from emberwatch.wire import StepAnswer

_Record = TypeVar("_Record")
_Header = TypeVar("_Header", bound=wire.Header)


class Connection(Closable):
    """A channel of JSON messages. Threads may share it: they take turns."""

    def __init__(self, instance: str, service: str, wake: str, who: str, limit: float) -> None:
        """Opens it within `limit` seconds, all services in one turn."""
        self._limit, self._began = limit, time.monotonic()
        self._lock = threading.Lock()
        self._sequence = 0
        self._parts: list[Peer | RequestPort[Any]] = []
        with in_turn(limit):
            self._node = Node(instance)
            with self._closed_on_error():
                self._peer = Peer(self._node, wake, who)
                self._parts.append(self._peer)
                self._control = self._open(service, wire.ControlRequest, wire.ControlReply)
                self._control.create(slice_len=4096, grows=True)
                self._open_others()
                self._node.remember_files()
                self._node.fill_ports()

    def _open_others(self) -> None:
        """Opens further services, in the same turn."""

    def _open(
        self, service: str, request: type[wire.Header], reply: type[_Header]
    ) -> RequestPort[_Header]:
        port = RequestPort(self._peer, service, (request, reply))
        self._parts.insert(0, port)
        return port

    @property
    def instance(self) -> str:
        return self._node.instance

    def close(self) -> None:
        """Closes the connection; its leases end. May be called again."""
        for part in self._parts:
            part.close()
        self._node.close()

    def control(self, request: Mapping[str, Any], *, timeout: float) -> dict[str, Any]:
        """Sends one JSON request (PROTOCOL.md section 6) and returns the reply's keys."""
        self._node.check()
        with self._lock:
            self._sequence = sequence = self._sequence + 1
            header = wire.CONTROL_REQUEST.pack(
                wire.VERSION, 0, sequence, self._peer.listener_low, self._peer.listener_high
            )
            what = f"{request['op']!r}"
            payload = json.dumps(request).encode()
            head, answer = self._control.exchange(header, payload, what, timeout)
        reply = _decoded(what, answer)
        if head.status != 0:
            detail, message = reply.get("detail"), reply.get("message")
            raise refusal(
                head.status,
                detail if isinstance(detail, int) else 0,
                message if isinstance(message, str) else None,
            )
        wire.check_answer(f"answer to {what}", head, sequence)
        return reply

    def _shake_hands(self, kind: type[_Record]) -> _Record:
        """The process's description of itself; from now on its end is noticed."""
        client = f"emberwatch-python {VERSION}"
        hello = {"op": "hello", "protocol": wire.VERSION, "client": client}
        try:
            reply = self.control(hello, timeout=self._left())
        except RequestTimeoutError:
            problem = f"no answer to 'hello' from instance {self.instance!r} within {self._limit} s"
            raise RequestTimeoutError(problem) from None
        info = record(kind, reply)
        # A process of the same number may be another one here.
        if reply.get("pid_namespace", pid_namespace()) != pid_namespace():
            raise EmberwatchError(
                f"instance {self.instance!r} is served from another PID namespace: run both "
                "programs in one (docker: --pid=container:NAME; Kubernetes: "
                "shareProcessNamespace: true), or give each container a /dev/shm of its own "
                "(docker: --ipc=private)",
                "pid_namespace",
            )
        self._peer.watch(reply["pid"])
        return info

    def _left(self) -> float:
        """What is left of the time to open it, seconds."""
        return self._limit - (time.monotonic() - self._began)

    @contextmanager
    def _closed_on_error(self) -> Generator[None]:
        try:
            yield
        except BaseException:
            self.close()
            raise


class ServerConnection(Connection):
    """A connection to a server, which also steps worlds."""

    def __init__(self, instance: str = "default", *, timeout: float = STEP_TIMEOUT) -> None:
        super().__init__(instance, "control", "wake-server", "server", timeout)
        with self._closed_on_error():
            info = self._shake_hands(ServerInfo)
            self.info: Final = info
            self.shape: Final = info.shape
            with in_turn(self._left()):
                longest = info.n_worlds * (8 + info.n_robots * info.n_moves)
                self._step.create(slice_len=longest, grows=False)
                self._node.fill_ports()

    def _open_others(self) -> None:
        self._step = self._open("step", wire.StepRequest, wire.StepReply)

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
        self._node.check()
        info = self.info
        with self._lock:
            self._sequence = sequence = self._sequence + 1
            header = wire.STEP_REQUEST.pack(
                wire.VERSION,
                operation,
                lease,
                sequence,
                first_robot,
                n_robots,
                info.n_moves if operation == wire.STEP else 0,
                flags,
                self._peer.listener_low,
                self._peer.listener_high,
            )
            reply, payload = self._step.exchange(header, body, "a step", timeout)
        if reply.status != 0:
            raise refusal(reply.status, reply.detail)
        wire.check_answer("answer to step", reply, sequence)
        wire.check_asked(reply, (first_robot, n_robots, flags, info.height, info.width))
        return StepAnswer(reply, payload, self.shape)


def _decoded(what: str, answer: bytearray) -> dict[str, Any]:
    try:
        reply = json.loads(answer)
    except (ValueError, RecursionError) as error:
        raise bad_answer(f"answer to {what}", "JSON", error) from None
    if not isinstance(reply, dict):
        raise bad_answer(f"answer to {what}", "an object", repr(reply))
    return cast("dict[str, Any]", reply)
