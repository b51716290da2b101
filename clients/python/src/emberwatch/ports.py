"""Requests and answers: one at a time, each with a deadline. Nothing returned is shared memory.

The wait is PROTOCOL.md section 8's: spin for 100 us where that pays, then sleep on the listener
that the server notifies.
"""

import ctypes
import os
import select
import time
import weakref
from traceback import clear_frames
from typing import Any, Final, Generic, TypeVar

from emberwatch import wire
from emberwatch.channels import Node, channel_errors, iox2
from emberwatch.errors import EmberwatchError, NoServerError, RequestTimeoutError, ServerGoneError
from emberwatch.resources import check_room
from emberwatch.spinning import Spinning

Reply = TypeVar("Reply", bound=wire.Header)

#: Default timeout of a step, seconds.
STEP_TIMEOUT: Final = 5.0

#: Default timeout of what may wait for a burn-in, seconds.
RESET_TIMEOUT: Final = 120.0

#: Longest sleep: bounds what a lost notification or a dead server can cost.
_SLEEP: Final = iox2.Duration.from_millis(50)

#: How often to clean up after dead processes while the server's pid is not known, seconds.
_CLEAN_UP_INTERVAL: Final = 0.2

#: How long a server may take to release a request that was given up, seconds.
_RELEASE_TIMEOUT: Final = 0.5


class Peer:
    """The process that answers: notified of requests, waited for, and watched."""

    def __init__(self, node: Node, wake: str = "wake-server", who: str = "server") -> None:
        """`wake` is the event service that it listens on, `who` its name in errors."""
        self.node: Final = node
        self._who = who
        with channel_errors("open the wake services"):
            notifier = node.open_wake(wake).notifier_builder().create()
            listener = node.open_wake("wake-client").listener_builder().create()
        self.notify: Any = node.keep(notifier).notify
        self._listener: Any = node.keep(listener)
        identity = int(listener.id.value)
        self.listener_low: Final = identity & (2**64 - 1)
        self.listener_high: Final = identity >> 64
        self._process: int | None = None
        self._close_process: weakref.finalize[[int], Any] | None = None
        self._poll = select.poll()
        self._spinning = Spinning()
        self._next_clean_up = 0.0

    def watch(self, pid: int) -> None:
        """From now on the end of this process is noticed while waiting."""
        try:
            self._process = os.pidfd_open(pid)
        except ProcessLookupError:
            raise self.gone() from None
        self._close_process = weakref.finalize(self, os.close, self._process)
        self._poll.register(self._process, select.POLLIN)

    def close(self) -> None:
        if self._close_process is not None:
            self._close_process()
        self._process = self._close_process = None
        self.notify = self._listener = None

    def has_ended(self) -> bool:
        """Whether the process that is watched has ended."""
        return self._process is not None and bool(self._poll.poll(0))

    def gone(self) -> ServerGoneError:
        """The error of a process that has ended; removes what it left."""
        self.node.clean_up()
        return ServerGoneError(f"the {self._who} on instance {self.node.instance!r} is gone")

    def wait(self, pending: Any, what: str, timeout: float) -> Any:
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
                # Notifications of earlier answers end the first sleep at once.
                notified = self._listener.timed_wait(longest)
            except iox2.ListenerWaitError as error:
                if "Interrupt" not in str(error):
                    raise EmberwatchError(f"wait for the server: {error}", "channel") from None
                notified = False
            is_gone = not notified and self._is_gone(pending)

    def _is_gone(self, pending: Any) -> bool:
        if self._process is not None:
            return self.has_ended() or not pending.is_connected
        if time.perf_counter() >= self._next_clean_up:
            self.node.clean_up()
            self._next_clean_up = time.perf_counter() + _CLEAN_UP_INTERVAL
        return not pending.is_connected


class RequestPort(Generic[Reply]):
    """One request-response channel of a server: its service is opened, then its port made."""

    def __init__(
        self,
        peer: Peer,
        service: str,
        headers: tuple[type[wire.Header], type[Reply]],
    ) -> None:
        """Opens the service below the instance."""
        self._peer, self._service = peer, service
        self._request, self._reply = headers
        self._request_bytes = ctypes.sizeof(self._request)
        self._reply_bytes = ctypes.sizeof(self._reply)
        self._factory: Any = peer.node.open_request_response(service, *headers)
        if self._factory is None or self._factory.dynamic_config.number_of_servers == 0:
            raise no_server(peer.node, service)
        self._client: Any = None
        self._slice_len = 0

    def create(self, *, slice_len: int, grows: bool) -> None:
        """Makes the port.

        `slice_len` is the longest payload of a request, bytes; with `grows`, to begin with.
        """
        growth = iox2.AllocationStrategy.PowerOfTwo if grows else iox2.AllocationStrategy.Static
        builder = self._factory.client_builder().initial_max_slice_len(max(slice_len, 1))
        with channel_errors(f"create a {self._service} client", "16 clients"):
            self._client = self._peer.node.keep(builder.allocation_strategy(growth).create())
        self._slice_len = slice_len

    def close(self) -> None:
        """Drops the port; closing the node closes it."""
        self._client = self._factory = None

    def exchange(
        self, header: bytes, payload: bytes, what: str, timeout: float
    ) -> tuple[Reply, bytearray]:
        """Sends one request and returns the header and payload of its answer, copied."""
        self._peer.node.check()
        if self._peer.has_ended():
            # A new server on the instance would take the request, but knows nothing of it.
            raise self._peer.gone()
        pending = response = None
        try:
            pending = self._send(header, payload)
            if pending.number_of_server_connections == 0:
                raise self._peer.gone()
            self._peer.notify()
            response = self._peer.wait(pending, what, timeout)
            reply = self._reply.from_buffer_copy(
                ctypes.string_at(response.user_header_ptr, self._reply_bytes)
            )
            length = response.payload().len()
            return reply, bytearray(_array(length).from_address(response.payload_ptr))
        except BaseException as error:
            # Its traceback, which a notebook keeps, keeps what is lent alive, too.
            clear_frames(error.__traceback__)
            raise
        finally:
            response = None
            if pending is not None:
                pending.delete()  # the next request needs its place

    def _send(self, header: bytes, payload: bytes) -> Any:
        if len(payload) > self._slice_len:
            check_room(len(payload))  # It will be in a new file.
        deadline = time.perf_counter() + _RELEASE_TIMEOUT
        while True:
            try:
                request = self._client.loan_slice_uninit(len(payload))
                ctypes.memmove(request.user_header_ptr, header, self._request_bytes)
                ctypes.memmove(request.payload_ptr, payload, len(payload))
                return request.assume_init().send()
            except iox2.RequestSendError as error:
                # The server still holds a request that was given up, for a moment.
                if time.perf_counter() > deadline:
                    raise EmberwatchError(f"send a request: {error}", "channel") from None
                time.sleep(0.005)
            except iox2.LoanError as error:
                problem = f"send a request of {len(payload)} bytes: {error}"
                raise EmberwatchError(problem, "channel") from None


def no_server(node: Node, service: str) -> EmberwatchError:
    """The error of an instance that nobody serves, or only in another protocol version."""
    version = node.other_version(service)
    if version is not None:
        return EmberwatchError(
            f"protocol version mismatch: the client speaks {wire.VERSION}, the server {version}; "
            "use a client and a server of one release",
            "version_mismatch",
            version,
        )
    return NoServerError(
        f"no server on instance {node.instance!r}: start one with "
        f"`emberwatch-server --instance {node.instance}`"
    )


_ARRAYS: dict[int, Any] = {}


def _array(length: int) -> Any:
    """The ctypes array type of this length; making the type each time would cost 5 us a message."""
    if length not in _ARRAYS:
        if len(_ARRAYS) > 256:
            _ARRAYS.clear()
        _ARRAYS[length] = ctypes.c_uint8 * length
    return _ARRAYS[length]
