"""Leases: the right to fly some robots, and the requests that need it."""

import os
from base64 import b64encode
from collections.abc import Iterable, Sequence
from typing import Any, Final, Self

from numpy.typing import ArrayLike

from emberwatch.client import wire
from emberwatch.client.connection import RESET_TIMEOUT, STEP_TIMEOUT, ServerConnection
from emberwatch.client.replies import Grant, WorldInfo, records
from emberwatch.client.wire import StepAnswer, StepResult
from emberwatch.common.arguments import as_moves, as_seeds
from emberwatch.common.paths import utf8
from emberwatch.errors import invalid

#: Maximum number of bytes of a belief in one request.
_BELIEF_PART: Final = 1 << 19


class Lease:
    """The right to fly consecutive robots. It ends with `release`, or on leaving its `with` block.

    For each world, the lease remembers the step k that it last stepped to, reset to or observed.
    The next path is for step k + 1, and the server flies it in no other step.
    """

    def __init__(
        self, client: ServerConnection, grant: Grant, start: tuple[WorldInfo, ...], robots: range
    ) -> None:
        self.client: Final = client
        #: The lease's number on the server.
        self.number: Final = grant.lease
        #: Seconds without use after which the lease expires.
        self.ttl: Final = grant.ttl_millis / 1000
        #: The numbers of its robots.
        self.robots: Final = robots
        self._all = robots.start, len(robots)
        #: The worlds of these robots.
        self.worlds: Final = self._worlds_of(robots)
        #: The state of these worlds when the lease was granted.
        self.start: Final = start
        #: The native lease, which keeps the step k of each world.
        self.native = client.lease(grant.lease, robots)
        self._is_over = False
        self._note(start)

    def step(
        self,
        paths: ArrayLike,
        *,
        robots: range | None = None,
        full: bool = False,
        team: bool = False,
        timeout: float = STEP_TIMEOUT,
    ) -> StepAnswer:
        """Flies one path with each robot, and moves the worlds from k to k + 1.

        If other clients hold robots of the same world, the step waits for their paths, too.

        Args:
            paths: Moves: 0 up, 1 down, 2 left, 3 right. Integers of shape (n_robots, T), or (T,)
                for one robot.
            robots: The numbers of consecutive robots to fly, which must be all the lease's robots
                in one or more worlds. None: all robots of the lease.
            full: Whether to observe every cell. Requires a server with coverage "client" or "full".
            team: Whether to return one frame for each world's team instead of one for each robot.
            timeout: Seconds to wait for the answer.

        Raises:
            InvalidArgumentError: If the paths do not have this shape, type and range.
            LeaseLostError: If the lease expired or a robot was taken over.
            RequestTimeoutError: If no answer arrives; `observe` shows whether the step was made.
            ServerGoneError: If the server ended.
            EmberwatchError: With code `"late"` if the world moved on without this path; `observe`
                shows to which step. With code `"episode_over"` if the episode has ended: reset that
                world.
        """
        place = self._place(robots, full * wire.FULL_COVERAGE | team * wire.TEAM_FRAMES)
        answer = self.native.step(paths, *place, timeout)
        if answer is None:
            moves = as_moves(paths, place[1], self.client.info.n_moves)
            answer = self.native.step(moves, *place, timeout)
            assert answer is not None
        return StepAnswer(answer)

    def fly(
        self,
        paths: ArrayLike,
        *,
        robots: range | None = None,
        accepts_late: bool = False,
        timeout: float = STEP_TIMEOUT,
    ) -> tuple[StepAnswer, int]:
        """Flies one path with each robot as `step` does, but waits as long as teammates take.

        After each timeout it observes whether the worlds have moved, and sends the paths again if
        not. It keeps waiting as long as the server answers. A world that another thread's paths
        moved counts as having moved on without these paths.

        Args:
            paths: As in `step`.
            robots: As in `step`.
            accepts_late: Whether to return the current results of a world that moved on without
                these paths, instead of raising the error with code `"late"`.
            timeout: Seconds to wait before each check whether the worlds have moved. The server's
                own deadline for teammates is added.

        Returns:
            The results and frames, and the number of earlier world steps that went unobserved.

        Raises:
            RequestTimeoutError: If the server does not answer such a check either.
            EmberwatchError: As in `step`.
        """
        place = self._all if robots is None else self._place(robots, 0)[:2]
        return self.fly_from(paths, *place, accepts_late, timeout)

    def fly_from(
        self, paths: ArrayLike, first: int, n_robots: int, accepts_late: bool, timeout: float
    ) -> tuple[StepAnswer, int]:
        """Does what `fly` does, for `n_robots` robots of the lease from number `first` on."""
        flown = self.native.send_paths(paths, first, n_robots, accepts_late, timeout)
        if flown is None:
            moves = as_moves(paths, n_robots, self.client.info.n_moves)
            flown = self.native.send_paths(moves, first, n_robots, accepts_late, timeout)
            assert flown is not None
        return StepAnswer(flown[0]), flown[1]

    def observe(
        self,
        *,
        robots: range | None = None,
        team: bool = False,
        timeout: float = STEP_TIMEOUT,
    ) -> StepAnswer:
        """Returns the results and frames of the last step again.

        The next `step` continues from the observed step.

        Args:
            robots: The numbers of consecutive robots; None: all robots of the lease.
            team: Whether to return one frame for each world's team instead of one for each robot.
            timeout: Seconds to wait for the answer.
        """
        place = self._place(robots, team * wire.TEAM_FRAMES)
        return StepAnswer(self.native.observe(*place, timeout))

    def reset(
        self,
        seeds: Iterable[int | None] | None = None,
        *,
        worlds: Sequence[int] | None = None,
        timeout: float = RESET_TIMEOUT,
    ) -> tuple[WorldInfo, ...]:
        """Begins new episodes: burn-in, then k = 0, robots at their start cells, empty frames.

        No other client may hold robots of these worlds.

        Args:
            seeds: One seed for each world; None: the server derives each seed from the world's last
                seed.
            worlds: The worlds to reset; None: all worlds of the lease.
            timeout: Seconds to wait for the answer.

        Returns:
            The state of each reset world, in the given order.
        """
        pairs = as_seeds(seeds, self.worlds if worlds is None else worlds)
        return self._note(records(WorldInfo, self._ask("reset", timeout, worlds=pairs)))

    def restore(
        self,
        path: str | os.PathLike[str],
        *,
        worlds: range | None = None,
        first: int = 0,
        timeout: float = RESET_TIMEOUT,
    ) -> tuple[WorldInfo, ...]:
        """Replaces worlds of the lease with worlds from a snapshot file.

        The restored worlds continue exactly as the saved ones would have.

        Args:
            path: The file, written by `Client.snapshot` or `emberwatch-server snapshot`.
            worlds: The consecutive worlds to replace; None: all worlds of the lease.
            first: The number of the first world in the file to use; the next worlds follow.
            timeout: Seconds to wait for the answer.

        Returns:
            The state of each restored world.
        """
        chosen = self.worlds if worlds is None else _part("worlds", worlds, self.worlds)
        place = {"first_world": chosen.start, "n_worlds": len(chosen), "from": first}
        reply = self._ask("restore", timeout, **place, path=utf8("path", os.path.abspath(path)))
        return self._note(records(WorldInfo, reply))

    def fork(
        self, source: int, target: int, *, timeout: float = STEP_TIMEOUT
    ) -> tuple[WorldInfo, ...]:
        """Replaces the lease's world `target` with a copy of the world `source`.

        With the same actions, both worlds have the same future.

        Returns:
            The state of the world `target`.
        """
        reply = self._ask("fork", timeout, **{"from": source, "to": target})
        return self._note(records(WorldInfo, reply))

    def leave_belief(
        self,
        result: StepResult,
        kind: str,
        data: bytes,
        *,
        robot: int | None = None,
        timeout: float = STEP_TIMEOUT,
    ) -> None:
        """Stores a belief about the current step for a robot's next client; see `Client.belief`.

        Args:
            result: The robot's last result. The server refuses a result of an earlier step.
            kind: The format of the bytes, for other agents. At most 256 bytes.
            data: At most 32,768 bytes plus 76 per cell; more if the model has over 18 states.
            robot: The robot's number; None: the first robot of the lease.
            timeout: Seconds to wait for the answer.
        """
        for offset in range(0, max(len(data), 1), _BELIEF_PART):
            self._ask(
                "leave_belief",
                timeout,
                robot=self.robots.start if robot is None else robot,
                episode=result.world.episode,
                step=result.world.step,
                kind=kind,
                offset=offset,
                length=len(data),
                data=b64encode(data[offset : offset + _BELIEF_PART]).decode(),
            )

    def renew(self, *, timeout: float = RESET_TIMEOUT) -> None:
        """Restarts the lease's expiry time without acting."""
        self._ask("renew", timeout)

    def release(self, *, timeout: float = STEP_TIMEOUT) -> None:
        """Ends the lease, so that other clients may fly its robots. May be called again."""
        if not self._is_over:
            self._is_over = True
            self._ask("release", timeout)

    def _ask(self, operation: str, timeout: float, **keys: Any) -> dict[str, Any]:
        request = {"op": operation, "lease": self.number, **keys}
        return self.client.control(request, timeout=timeout)

    def _place(self, robots: range | None, flags: int) -> tuple[int, int, int]:
        """Returns the first of the chosen robots, their number, and the flags."""
        if robots is None:
            return *self._all, flags
        chosen = _part("robots", robots, self.robots)
        return chosen.start, len(chosen), flags

    def _worlds_of(self, robots: range) -> range:
        n_robots = self.client.info.n_robots
        return range(robots.start // n_robots, (robots.stop - 1) // n_robots + 1)

    def _note(self, worlds: tuple[WorldInfo, ...]) -> tuple[WorldInfo, ...]:
        for info in worlds:
            self.native.note(info.world, info.step)
        return worlds

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.release()
        except Exception:
            if kind is None:  # otherwise the error of the `with` block says more
                raise


def _part(what: str, part: range, whole: range) -> range:
    is_part = isinstance(part, range) and part.step == 1 and len(part) > 0  # pyright: ignore[reportUnnecessaryIsInstance]
    if not is_part or part.start < whole.start or part.stop > whole.stop:
        raise invalid(what, f"a range of consecutive {what} within {whole}", part)
    return part
