"""A lease: the right to fly some robots, and what may be done with it."""

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

#: Maximum number of bytes of a belief in one message.
_BELIEF_PART: Final = 1 << 19


class Lease:
    """The right to fly consecutive robots. Ends by `release`, or leaving its `with`.

    A path is flown in the step k that it is meant for: of each world, the one after the last step
    that this lease has stepped to, reset to or observed.
    """

    def __init__(
        self, client: ServerConnection, grant: Grant, start: tuple[WorldInfo, ...], robots: range
    ) -> None:
        self.client: Final = client
        #: The server's number for it.
        self.number: Final = grant.lease
        #: It ends this many seconds after its last use.
        self.ttl: Final = grant.ttl_millis / 1000
        #: The numbers of the robots it covers.
        self.robots: Final = robots
        self._all = robots.start, len(robots)
        #: The worlds that these robots are in.
        self.worlds: Final = self._worlds_of(robots)
        #: Where these worlds stood when it was given.
        self.start: Final = start
        #: It knows k of each world.
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

        Where others hold robots of the world, it waits for their paths too.

        Args:
            paths: Moves, integers: 0 up, 1 down, 2 left, 3 right; `(n_robots, T)`, or `(T,)` for
                one robot.
            robots: Only these, consecutive, and all of the lease in their worlds; None: all.
            full: Observe every cell; needs a server with coverage "client" or "full".
            team: Get the frame of each world's team instead of each robot's.

        Raises:
            InvalidArgumentError: If the paths are not of that shape, type and range.
            LeaseLostError: If the lease ended or a robot was taken over.
            RequestTimeoutError: If no answer comes; `observe` tells whether the step was made.
            ServerGoneError: If the server ended.
            EmberwatchError: With code `"late"`: the world has moved on without this path, `observe`
                tells to where. With code `"episode_over"`: reset that world.
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
        """Flies one path with each robot, as `step`, however long teammates take.

        After each timeout it looks whether the worlds have moved, and if not, sends the paths
        again. It waits as long as the server answers. If paths of another thread moved a world,
        that world counts as moved on without these paths.

        Args:
            paths: As for `step`.
            robots: As for `step`.
            accepts_late: If a world has moved on without these paths, return how it stands instead
                of raising the error with code `"late"`.
            timeout: Seconds until it looks; the server's own deadline for teammates comes on top.

        Returns:
            How the worlds stand, and how many of their steps passed unseen before.

        Raises:
            RequestTimeoutError: If the server answers no observation either.
            EmberwatchError: As `step`.
        """
        place = self._all if robots is None else self._place(robots, 0)[:2]
        return self.fly_from(paths, *place, accepts_late, timeout)

    def fly_from(
        self, paths: ArrayLike, first: int, n_robots: int, accepts_late: bool, timeout: float
    ) -> tuple[StepAnswer, int]:
        """Like `fly`, for `n_robots` consecutive robots from number `first`, all of the lease."""
        flown = self.native.fly(paths, first, n_robots, accepts_late, timeout)
        if flown is None:
            moves = as_moves(paths, n_robots, self.client.info.n_moves)
            flown = self.native.fly(moves, first, n_robots, accepts_late, timeout)
            assert flown is not None
        return StepAnswer(flown[0]), flown[1]

    def observe(
        self,
        *,
        robots: range | None = None,
        team: bool = False,
        timeout: float = STEP_TIMEOUT,
    ) -> StepAnswer:
        """Returns the last results and frames of its robots again, or of some of them.

        The next `step` is for the observed step.
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
        """Begins new episodes: burn-in, k = 0, the robots at their starts, empty frames.

        No other client may hold robots of these worlds.

        Args:
            seeds: One per world; None: the server derives the next from the world's last.
            worlds: Only these worlds; None: all of the lease.

        Returns:
            Where the worlds stand, in the order asked.
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
        """Replaces its worlds with the worlds of a snapshot file, which continue bit for bit.

        Args:
            path: The file, written by `Client.snapshot` or `emberwatch-server snapshot`.
            worlds: Only these worlds, consecutive; None: all of the lease.
            first: The first of the file's worlds that is read.
        """
        chosen = self.worlds if worlds is None else _part("worlds", worlds, self.worlds)
        place = {"first_world": chosen.start, "n_worlds": len(chosen), "from": first}
        reply = self._ask("restore", timeout, **place, path=utf8("path", os.path.abspath(path)))
        return self._note(records(WorldInfo, reply))

    def fork(
        self, source: int, target: int, *, timeout: float = STEP_TIMEOUT
    ) -> tuple[WorldInfo, ...]:
        """Replaces its world `target` with a copy of any world: both have the same future."""
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
        """Leaves bytes about the present step to a robot's next client (`Client.belief`).

        Args:
            result: The robot's last result; another step is refused.
            kind: Says to other agents what the bytes are, in at most 256 bytes.
            data: At most 32,768 bytes and 76 per cell; more if the model has over 18 states.
            robot: Its number; None: the first of the lease.
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
        """Starts the lease's clock again without acting."""
        self._ask("renew", timeout)

    def release(self, *, timeout: float = STEP_TIMEOUT) -> None:
        """Gives the robots back. May be called again."""
        if not self._is_over:
            self._is_over = True
            self._ask("release", timeout)

    def _ask(self, operation: str, timeout: float, **keys: Any) -> dict[str, Any]:
        request = {"op": operation, "lease": self.number, **keys}
        return self.client.control(request, timeout=timeout)

    def _place(self, robots: range | None, flags: int) -> tuple[int, int, int]:
        """The first of some robots or of all, how many, and flags."""
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
            if kind is None:  # otherwise the first error says more
                raise


def _part(what: str, part: range, whole: range) -> range:
    is_part = isinstance(part, range) and part.step == 1 and len(part) > 0  # pyright: ignore[reportUnnecessaryIsInstance]
    if not is_part or part.start < whole.start or part.stop > whole.stop:
        raise invalid(what, f"a range of consecutive {what} within {whole}", part)
    return part
