"""A connection to a server: handshake, leases, steps.

`connect` gives a `Client`, its `acquire` a `Lease`, and that one's `step` a `StepAnswer`.
Every call has a timeout in seconds; everything returned is a copy.
"""

from __future__ import annotations

import os
import threading
from base64 import b64decode, b64encode
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from types import TracebackType
from typing import Any, Final, Self, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emberwatch import wire
from emberwatch.channels import Closing, Node
from emberwatch.errors import (
    GarbledAnswerError,
    InvalidActionError,
    NotKeptError,
    SettingError,
    refusal,
)
from emberwatch.ports import Bell, RequestPort
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
from emberwatch.wire import StepAnswer, StepResult

#: Default timeout of a step, seconds.
STEP_TIMEOUT: Final = 5.0

#: Default timeout of what may wait for a burn-in, seconds.
RESET_TIMEOUT: Final = 120.0


#: Most bytes of a belief in one message.
_BELIEF_PART: Final = 1 << 19


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
            self._node.clean_up()
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
            NotKeptError: If the server does not keep it any more; `detail` is the oldest step kept.
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
            "client": f"emberwatch-python {_release()}",
        }
        reply = self.control(hello, timeout=timeout)
        return record(ServerInfo, reply)


class Lease:
    """The right to act on consecutive worlds. Ends by `release`, or leaving its `with`."""

    def __init__(
        self, client: Client, grant: Grant, start: tuple[WorldInfo, ...], worlds: range
    ) -> None:
        """Made by `Client.acquire`."""
        self.client: Final = client
        #: The server's number for it.
        self.number: Final = grant.lease
        #: It ends so many seconds after its last use.
        self.ttl: Final = grant.ttl_millis / 1000
        #: The worlds it covers.
        self.worlds: Final = worlds
        #: Where they stood when it was given.
        self.start: Final = start
        self._is_over = False

    def step(
        self,
        paths: ArrayLike,
        *,
        worlds: range | None = None,
        full: bool = False,
        timeout: float = STEP_TIMEOUT,
    ) -> StepAnswer:
        """Flies one path in each world and moves the worlds from k to k + 1.

        Args:
            paths: Moves, integers: 0 up, 1 down, 2 left, 3 right; `(n_worlds, T)`, or `(T,)` for
                one world.
            worlds: Only these, consecutive; None: all of the lease.
            full: Observe every cell; needs a server with coverage "client" or "full".
            timeout: How long to wait for the answer, seconds.

        Raises:
            InvalidActionError: If the paths are not of that shape, type and range; nothing is sent.
            LeaseLostError: If the lease ended or a world was taken over.
            EpisodeOverError: If a world's episode was truncated: reset it.
        """
        chosen = self.worlds if worlds is None else self._part(worlds)
        moves = as_moves(paths, len(chosen), self.client.info.n_moves)
        return self.step_moves(moves, chosen, full=full, timeout=timeout)

    def step_moves(
        self, moves: NDArray[np.uint8], worlds: range, *, full: bool, timeout: float
    ) -> StepAnswer:
        """The same for moves that `as_moves` has checked."""
        return self.client.exchange(
            wire.STEP,
            self.number,
            worlds.start,
            len(worlds),
            wire.FULL_COVERAGE if full else 0,
            moves.tobytes(),
            timeout=timeout,
        )

    def observe(self, *, timeout: float = STEP_TIMEOUT) -> StepAnswer:
        """The last results and frames of its worlds again."""
        return self.client.observe(self.worlds.start, len(self.worlds), timeout=timeout)

    def reset(
        self,
        seeds: Iterable[int | None] | None = None,
        *,
        worlds: Sequence[int] | None = None,
        timeout: float = RESET_TIMEOUT,
    ) -> tuple[WorldInfo, ...]:
        """Begins new episodes: burn-in, k = 0, the robot at its start, empty frames.

        Args:
            seeds: One per world; None: the server derives the next from the world's last.
            worlds: Only these worlds; None: all of the lease.
            timeout: How long to wait for the burn-ins, seconds.

        Returns:
            Where the worlds stand, in the order asked.

        Raises:
            LeaseLostError: If the lease ended or a world was taken over.
        """
        chosen = list(self.worlds if worlds is None else worlds)
        given = [None] * len(chosen) if seeds is None else list(seeds)
        if len(given) != len(chosen):
            raise InvalidActionError(f"seeds: expected {len(chosen)}, got {len(given)}")
        pairs = [
            {"world": world, "seed": None if seed is None else as_seed(seed)}
            for world, seed in zip(chosen, given, strict=True)
        ]
        request = {"op": "reset", "lease": self.number, "worlds": pairs}
        return records(WorldInfo, self.client.control(request, timeout=timeout))

    def restore(
        self,
        path: str | os.PathLike[str],
        *,
        worlds: range | None = None,
        first: int = 0,
        timeout: float = RESET_TIMEOUT,
    ) -> tuple[WorldInfo, ...]:
        """Puts the worlds of a snapshot file in the place of its own: they go on bit for bit.

        Args:
            path: The file, written by `Client.snapshot` or `emberwatch-server snapshot`.
            worlds: Only these worlds, consecutive; None: all of the lease.
            first: The first of the file's worlds that is read.
            timeout: How long to wait for the answer, seconds.

        Raises:
            BadFileError: If the file is damaged, too short, or of a server with other settings.
        """
        chosen = self.worlds if worlds is None else self._part(worlds)
        request = {
            "op": "restore",
            "lease": self.number,
            "first_world": chosen.start,
            "n_worlds": len(chosen),
            "from": first,
            "path": os.path.abspath(path),
        }
        return records(WorldInfo, self.client.control(request, timeout=timeout))

    def fork(
        self, source: int, target: int, *, timeout: float = STEP_TIMEOUT
    ) -> tuple[WorldInfo, ...]:
        """Puts a copy of any world in the place of one of its own: both have the same future."""
        request = {"op": "fork", "lease": self.number, "from": source, "to": target}
        return records(WorldInfo, self.client.control(request, timeout=timeout))

    def leave_belief(
        self,
        result: StepResult,
        kind: str,
        data: bytes,
        *,
        world: int | None = None,
        timeout: float = STEP_TIMEOUT,
    ) -> None:
        """Leaves bytes about a world as it stands to whoever acts on it next (`Client.belief`).

        Args:
            result: The world's last result; another step is refused.
            kind: Says to other agents what the bytes are, in at most 256 bytes.
            data: At most 64 bytes per cell.
            world: Which world; None: the first of the lease.
            timeout: How long to wait for each answer, seconds.
        """
        for offset in range(0, max(len(data), 1), _BELIEF_PART):
            part = data[offset : offset + _BELIEF_PART]
            request = {
                "op": "leave_belief",
                "lease": self.number,
                "world": self.worlds.start if world is None else world,
                "episode": result.episode,
                "step": result.step,
                "kind": kind,
                "offset": offset,
                "length": len(data),
                "data": b64encode(part).decode(),
            }
            self.client.control(request, timeout=timeout)

    def _part(self, worlds: range) -> range:
        """Checks worlds to step: consecutive, of this lease."""
        is_part = isinstance(worlds, range) and worlds.step == 1 and len(worlds) > 0  # pyright: ignore[reportUnnecessaryIsInstance]
        if not is_part or worlds.start < self.worlds.start or worlds.stop > self.worlds.stop:
            raise SettingError(
                f"worlds: expected a range of consecutive worlds within {self.worlds}, got {worlds}"
            )
        return worlds

    def renew(self, *, timeout: float = RESET_TIMEOUT) -> None:
        """Starts the lease's clock again without acting."""
        self.client.control({"op": "renew", "lease": self.number}, timeout=timeout)

    def release(self, *, timeout: float = STEP_TIMEOUT) -> None:
        """Gives the worlds back. Again is fine."""
        if not self._is_over:
            self._is_over = True
            self.client.control({"op": "release", "lease": self.number}, timeout=timeout)

    def __enter__(self) -> Self:
        """Returns itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Releases it; after an error, without a second one."""
        if kind is None:
            self.release()
            return
        try:
            self.release()
        except Exception:
            pass  # the first error says more


def connect(instance: str = "default", *, timeout: float = STEP_TIMEOUT) -> Client:
    """Connects to a running server.

    Args:
        instance: The server's instance name.
        timeout: How long the handshake may take, seconds.

    Raises:
        NoServerError: If nobody serves the instance.
        VersionMismatchError: If the server speaks another protocol version.
        RequestTimeoutError: If it does not answer.
        ChannelError: If the channels cannot be opened, also when there are too many clients.
    """
    return Client(instance, timeout=timeout)


def as_seed(seed: object) -> int:
    """Checks a world's seed.

    Raises:
        SettingError: If it is not an integer that fits into the wire's 64 bits.
    """
    if isinstance(seed, int | np.integer):
        number = int(cast("int", seed))
        if 0 <= number < 2**64:
            return number
    raise SettingError(f"seed: expected an integer within 0 to 2**64 - 1, got {seed!r}")


def as_choice(action: object, n_choices: int) -> int:
    """Checks an action that is one integer below `n_choices`.

    Raises:
        InvalidActionError: Naming what was expected and what was got.
    """
    try:
        given = np.asarray(action)
    except (ValueError, OverflowError):
        given = np.empty(0)
    if given.size == 1 and given.dtype.kind in "iu" and 0 <= int(given.item()) < n_choices:
        return int(given.item())
    raise InvalidActionError(f"action: expected one integer, 0 to {n_choices - 1}, got {action!r}")


def as_moves(paths: ArrayLike, n_worlds: int, n_moves: int) -> NDArray[np.uint8]:
    """Checks paths, `(n_worlds, T)` or for one world `(T,)`, and makes them bytes.

    Raises:
        InvalidActionError: Naming what was expected and what was got.
    """
    try:
        given = np.asarray(paths)
    except (ValueError, OverflowError) as error:
        raise InvalidActionError(f"action: expected an array of moves, got {error}") from None
    if given.shape != (n_worlds, n_moves) and (n_worlds != 1 or given.shape != (n_moves,)):
        one = f" or ({n_moves},)" if n_worlds == 1 else ""
        raise InvalidActionError(
            f"action: expected shape ({n_worlds}, {n_moves}){one}, got {given.shape}"
        )
    if given.dtype.kind not in "iu":
        raise InvalidActionError(f"action: expected integers, got {given.dtype}")
    # One shift leaves something of each value below 0 or above 3.
    if (given >> 2).any():
        where = tuple(int(i) for i in np.argwhere((given < 0) | (given >= wire.N_MOVES))[0])
        raise InvalidActionError(
            f"action: expected moves 0 to {wire.N_MOVES - 1}, got {given[where]} at {where}"
        )
    return given.astype(np.uint8)


def _release() -> str:
    try:
        return version("emberwatch")
    except PackageNotFoundError:
        return "(not installed)"
