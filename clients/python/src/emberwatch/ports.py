"""Requests and answers: one at a time, each with a deadline. Nothing returned is shared memory.

The wait is PROTOCOL.md section 8's: look for 100 us where that pays, then sleep on the listener
that the server wakes.
"""

from __future__ import annotations

import ctypes
import os
import select
import time
import weakref
from typing import Any, Final, Generic, TypeVar

from emberwatch import wire
from emberwatch.channels import Node, guard, in_turn, iox2
from emberwatch.errors import (
    ChannelError,
    NoServerError,
    RequestTimeoutError,
    ServerGoneError,
    VersionMismatchError,
)
from emberwatch.spinning import Spinning

Reply = TypeVar("Reply", bound=wire.Header)

#: Default timeout of a step, seconds.
STEP_TIMEOUT: Final = 5.0

#: Default timeout of what may wait for a burn-in, seconds.
RESET_TIMEOUT: Final = 120.0

#: Longest sleep between two looks: bounds what a lost wake-up or a dead server can cost.
_SLEEP: Final = iox2.Duration.from_millis(50)

#: How often to look for dead processes while the server's pid is not known, seconds.
_CLEAN_UP: Final = 0.2

#: How long a server may take to let go of a request that was given up, seconds.
_LET_GO: Final = 0.5


class Bell:
    """Waking, both ways, and the life of the process that answers."""

    def __init__(self, node: Node, wake: str = "wake-server", who: str = "server") -> None:
        """Opens the wake services: `wake` is that of the process that answers, `who` it is.

        Raises:
            ChannelError: If iceoryx2 fails.
        """
        self.node: Final = node
        self._who = who
        with in_turn(), guard("open the wake services (are there more than 64 processes?)"):
            notifier = node.open_wake(wake).notifier_builder().create()
            listener = node.open_wake("wake-client").listener_builder().create()
        self.ring: Any = node.keep(notifier).notify
        self._listener: Any = node.keep(listener)
        identity = int(listener.id.value)
        self.listener_low: Final = identity & (2**64 - 1)
        self.listener_high: Final = identity >> 64
        self._process: int | None = None
        self._forget: weakref.finalize[[int], Any] | None = None
        self._poll = select.poll()
        self._spinning = Spinning()
        self._next_clean_up = 0.0

    def watch(self, pid: int) -> None:
        """From now on the end of this process is noticed while waiting.

        Raises:
            ServerGoneError: If it has ended already.
        """
        try:
            self._process = os.pidfd_open(pid)
        except ProcessLookupError:
            raise self.gone() from None
        self._forget = weakref.finalize(self, os.close, self._process)
        self._poll.register(self._process, select.POLLIN)

    def close(self) -> None:
        """Stops watching and waking."""
        if self._forget is not None:
            self._forget()
        self._process = self._forget = None
        self.ring = self._listener = None

    def has_ended(self) -> bool:
        """Whether the process that is watched has ended."""
        return self._process is not None and bool(self._poll.poll(0))

    def gone(self) -> ServerGoneError:
        """The error of a process that has ended; clears away what it left."""
        self.node.clean_up()
        return ServerGoneError(f"the {self._who} on instance {self.node.instance!r} is gone")

    def wait(self, pending: Any, what: str, timeout: float) -> Any:
        """The answer to a request.

        Raises:
            RequestTimeoutError: If none comes in time.
            ServerGoneError: If none can come any more.
        """
        receive, spinning = pending.receive, self._spinning
        start = now = time.perf_counter()
        spinning.begin(start)
        while spinning.goes_on(now):
            response = receive()
            if response is not None:
                spinning.arrived()
                return response
            now = time.perf_counter()
        return self._sleep(pending, what, timeout, start)

    def _sleep(self, pending: Any, what: str, timeout: float, start: float) -> Any:
        is_gone = False
        while True:
            # In this order: an answer may have come just before the end.
            response = pending.receive()
            if response is not None:
                return response
            if is_gone:
                raise self.gone()
            remaining = start + timeout - time.perf_counter()
            # Not "<=": "not a number" would end the process inside iceoryx2.
            if not remaining > 0:
                raise RequestTimeoutError(
                    f"no answer to {what} from instance {self.node.instance!r} within {timeout} s"
                )
            longest = _SLEEP if remaining > 0.05 else iox2.Duration.from_secs_f64(remaining)
            try:
                # What is left from earlier answers ends the first sleep at once.
                woken = self._listener.timed_wait(longest)
            except iox2.ListenerWaitError as error:
                if "Interrupt" not in str(error):
                    raise ChannelError(f"wait for the server: {error}") from None
                woken = False
            is_gone = not woken and self._is_gone(pending)

    def _is_gone(self, pending: Any) -> bool:
        if self._process is not None:
            return self.has_ended() or not pending.is_connected
        if time.perf_counter() >= self._next_clean_up:
            self.node.clean_up()
            self._next_clean_up = time.perf_counter() + _CLEAN_UP
        return not pending.is_connected


class RequestPort(Generic[Reply]):
    """One request-response channel of a server."""

    def __init__(
        self,
        bell: Bell,
        service: str,
        headers: tuple[type[wire.Header], type[Reply]],
        *,
        slice_len: int,
        grows: bool,
    ) -> None:
        """Opens a client port.

        Args:
            bell: How to wake the server and be woken.
            service: The service's name below the instance.
            headers: Types of the headers of requests and replies.
            slice_len: Longest payload of a request, bytes; with `grows`, to begin with.
            grows: Whether longer ones get more memory.

        Raises:
            NoServerError: If nobody serves it.
            VersionMismatchError: If somebody does, but in another protocol version.
            ChannelError: If iceoryx2 fails, also when there are too many clients.
        """
        self._bell = bell
        self._request, self._reply = headers
        self._request_bytes = ctypes.sizeof(self._request)
        self._reply_bytes = ctypes.sizeof(self._reply)
        node = bell.node
        growth = iox2.AllocationStrategy.PowerOfTwo if grows else iox2.AllocationStrategy.Static
        with in_turn():
            factory = node.open_request_response(service, *headers)
            if factory is None or factory.dynamic_config.number_of_servers == 0:
                raise no_server(node, service)
            builder = factory.client_builder().initial_max_slice_len(max(slice_len, 1))
            with guard(f"create a {service} client (are there more than 16 clients?)"):
                self._client: Any = node.keep(builder.allocation_strategy(growth).create())

    def close(self) -> None:
        """Lets go of the port; closing the node closes it."""
        self._client = None

    def exchange(
        self, header: bytes, payload: bytes, what: str, timeout: float
    ) -> tuple[Reply, bytearray]:
        """Sends one request and returns the header and payload of its answer, copied.

        Raises:
            RequestTimeoutError: If no answer comes in time.
            ServerGoneError: If the server has ended.
            ForkedError, ClosedError: If the connection may not be used here.
            ChannelError: If iceoryx2 fails.
        """
        self._bell.node.check()
        if self._bell.has_ended():
            # A new server on the instance would take the request, but knows nothing of it.
            raise self._bell.gone()
        pending = self._send(header, payload)
        try:
            if pending.number_of_server_connections == 0:
                raise self._bell.gone()
            self._bell.ring()
            response = self._bell.wait(pending, what, timeout)
            reply = self._reply.from_buffer_copy(
                ctypes.string_at(response.user_header_ptr, self._reply_bytes)
            )
            length = response.payload().len()
            return reply, bytearray(_array(length).from_address(response.payload_ptr))
        finally:
            # The traceback of an error keeps `pending` alive, but the next request needs its place.
            pending.delete()

    def _send(self, header: bytes, payload: bytes) -> Any:
        give_up = time.perf_counter() + _LET_GO
        while True:
            try:
                request = self._client.loan_slice_uninit(len(payload))
                ctypes.memmove(request.user_header_ptr, header, self._request_bytes)
                ctypes.memmove(request.payload_ptr, payload, len(payload))
                return request.assume_init().send()
            except iox2.RequestSendError as error:
                # A request that was given up is in the server's hands for a moment still.
                if time.perf_counter() > give_up:
                    raise ChannelError(f"send a request: {error}") from None
                time.sleep(0.005)
            except iox2.LoanError as error:
                raise ChannelError(f"send a request of {len(payload)} bytes: {error}") from None


def no_server(node: Node, service: str) -> NoServerError | VersionMismatchError:
    """The error of an instance that nobody serves, or only in another protocol version."""
    version = node.other_version(service)
    if version is not None:
        return VersionMismatchError(
            f"protocol version mismatch: the client speaks {wire.VERSION}, the server {version}; "
            "use a client and a server of one release",
            version,
        )
    return NoServerError(
        f"no server on instance {node.instance!r}: start one with "
        f"`emberwatch-server --instance {node.instance}`"
    )


_ARRAYS: dict[int, Any] = {}


def _array(length: int) -> Any:
    """The ctypes array of so many bytes; making the type anew would cost 5 us a message."""
    if length not in _ARRAYS:
        if len(_ARRAYS) > 256:
            _ARRAYS.clear()
        _ARRAYS[length] = ctypes.c_uint8 * length
    return _ARRAYS[length]
