"""A lease: the right to act on some worlds, and what may be done with it."""

from __future__ import annotations

import os
from base64 import b64encode
from collections.abc import Iterable, Sequence
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emberwatch import wire
from emberwatch.arguments import as_moves, as_seeds
from emberwatch.connection import ServerConnection
from emberwatch.errors import InvalidArgumentError
from emberwatch.ports import RESET_TIMEOUT, STEP_TIMEOUT
from emberwatch.replies import Grant, WorldInfo, records
from emberwatch.wire import StepAnswer, StepResult

#: Most bytes of a belief in one message.
_BELIEF_PART: Final = 1 << 19


class Lease:
    """The right to act on consecutive worlds. Ends by `release`, or leaving its `with`."""

    def __init__(
        self, client: ServerConnection, grant: Grant, start: tuple[WorldInfo, ...], worlds: range
    ) -> None:
        self.client: Final = client
        #: The server's number for it.
        self.number: Final = grant.lease
        #: It ends this many seconds after its last use.
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

        Raises:
            InvalidArgumentError: If the paths are not of that shape, type and range.
            LeaseLostError: If the lease ended or a world was taken over.
            RequestTimeoutError: If no answer comes; `observe` tells whether the step was made.
            ServerGoneError: If the server ended.
            EmberwatchError: With code `"episode_over"`: reset that world.
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

        Returns:
            Where the worlds stand, in the order asked.
        """
        pairs = as_seeds(seeds, self.worlds if worlds is None else worlds)
        return records(WorldInfo, self._ask("reset", timeout, worlds=pairs))

    def restore(
        self,
        path: str | os.PathLike[str],
        *,
        worlds: range | None = None,
        first: int = 0,
        timeout: float = RESET_TIMEOUT,
    ) -> tuple[WorldInfo, ...]:
        """Replaces its worlds with those of a snapshot file, which go on as they would have.

        Args:
            path: The file, written by `Client.snapshot` or `emberwatch-server snapshot`.
            worlds: Only these worlds, consecutive; None: all of the lease.
            first: The first of the file's worlds that is read.
        """
        chosen = self.worlds if worlds is None else self._part(worlds)
        place = {"first_world": chosen.start, "n_worlds": len(chosen), "from": first}
        reply = self._ask("restore", timeout, **place, path=os.path.abspath(path))
        return records(WorldInfo, reply)

    def fork(
        self, source: int, target: int, *, timeout: float = STEP_TIMEOUT
    ) -> tuple[WorldInfo, ...]:
        """Puts a copy of any world in the place of one of its own: both have the same future."""
        return records(WorldInfo, self._ask("fork", timeout, **{"from": source, "to": target}))

    def leave_belief(
        self,
        result: StepResult,
        kind: str,
        data: bytes,
        *,
        world: int | None = None,
        timeout: float = STEP_TIMEOUT,
    ) -> None:
        """Leaves bytes about the present step of a world to its next client (`Client.belief`).

        Args:
            result: The world's last result; another step is refused.
            kind: Says to other agents what the bytes are, in at most 256 bytes.
            data: At most 32,768 bytes and 76 per cell; more if the model has over 18 states.
            world: Which world; None: the first of the lease.
        """
        for offset in range(0, max(len(data), 1), _BELIEF_PART):
            self._ask(
                "leave_belief",
                timeout,
                world=self.worlds.start if world is None else world,
                episode=result.episode,
                step=result.step,
                kind=kind,
                offset=offset,
                length=len(data),
                data=b64encode(data[offset : offset + _BELIEF_PART]).decode(),
            )

    def renew(self, *, timeout: float = RESET_TIMEOUT) -> None:
        """Starts the lease's clock again without acting."""
        self._ask("renew", timeout)

    def release(self, *, timeout: float = STEP_TIMEOUT) -> None:
        """Gives the worlds back. May be called again."""
        if not self._is_over:
            self._is_over = True
            self._ask("release", timeout)

    def _ask(self, operation: str, timeout: float, **keys: Any) -> dict[str, Any]:
        request = {"op": operation, "lease": self.number, **keys}
        return self.client.control(request, timeout=timeout)

    def _part(self, worlds: range) -> range:
        is_part = isinstance(worlds, range) and worlds.step == 1 and len(worlds) > 0  # pyright: ignore[reportUnnecessaryIsInstance]
        if not is_part or worlds.start < self.worlds.start or worlds.stop > self.worlds.stop:
            raise InvalidArgumentError(
                f"worlds: expected a range of consecutive worlds within {self.worlds}, got {worlds}"
            )
        return worlds

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.release()
        except Exception:
            if kind is None:  # else the first error says more
                raise
