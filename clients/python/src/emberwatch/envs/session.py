"""Sessions: the robots that an environment flies, in this process or on a running server.

A session opens no worlds before the first reset, so that an environment can be made in one process
and used in a forked child, as in Gymnasium's `AsyncVectorEnv`.
"""

import threading
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emberwatch._native import CheckedSettings
from emberwatch.client import wire
from emberwatch.client.client import RESET_TIMEOUT, Client, Lease, connect
from emberwatch.client.observer import Newest, Present
from emberwatch.client.replies import LeftBelief
from emberwatch.client.wire import StepAnswer, WorldResult
from emberwatch.envs.advice import (
    about_barren_worlds,
    warn,
    warn_of_test_worlds,
    warn_without_rewards,
)
from emberwatch.envs.fork_lock import ForkLock
from emberwatch.envs.settings import Settings, own_spec, running_spec
from emberwatch.errors import (
    EmberwatchError,
    LeaseLostError,
    RequestTimeoutError,
    ServerGoneError,
    invalid,
)

# Seconds without use after which a lease on a running server expires. It is long because learners
# may pause between steps. The server notices a dead client at once anyway.
_LEASE: Final = 3600.0

#: Errors after which the session no longer holds its worlds, or does not know their step.
LOST: Final = (LeaseLostError, RequestTimeoutError, ServerGoneError)


class State(Enum):
    """The state of a session, which determines the calls that it allows."""

    #: Nothing is open: the next reset opens the worlds.
    CLOSED = "closed"
    #: The worlds are in the state that the last step or reset returned.
    READY = "ready"
    #: A step or reset has begun, but has changed nothing yet. If it is refused, the state is READY
    #: again.
    BEGUN = "begun"
    #: A step or reset has changed worlds, but the environment has not finished processing the
    #: result.
    MOVED = "moved"
    #: A reset has begun after an interrupted call, whose request the server may still be
    #: processing.
    TORN = "torn"
    #: A request was not answered in time.
    TIMED_OUT = "timed out"
    #: The episode of a world that is shared with other clients is over.
    OVER = "over"


#: States in which steps are refused, because worlds may have moved without the session's knowledge.
_UNFINISHED: Final = frozenset((State.BEGUN, State.MOVED, State.TORN, State.TIMED_OUT))


class Session:
    """Consecutive robots under a lease, one row for each: all of some worlds, or one of a world.

    An environment holds the lock `turn` during each step and reset, as threads may share it. It
    first calls `begin_step` or `begin_reset`, and at the end `finish`. Ctrl-C or a signal handler
    may interrupt it in between. Then the state stays unfinished, and steps are refused.
    """

    def __init__(self, settings: Settings, n_rows: int | None = 1) -> None:
        """`n_rows`: number of robots; None: all robots of one world."""
        self.settings: Final = settings
        self._asked_rows = n_rows
        self._client: Client | None = None
        self._lease: Lease | None = None
        #: The settings of worlds in this process.
        self._own: CheckedSettings | None = None
        self._truth: Newest | Present | None = None
        self._has_warned = False
        self._has_warned_of_gap = False
        self._state = State.CLOSED
        self._turn = ForkLock()
        #: Whether test worlds are allowed without a warning, as in an evaluation.
        self.allows_test_worlds = False
        # Only worlds in which other clients fly can move without this session's path.
        self._accepts_late = settings.robot is not None
        #: Number of world steps that the last answer skipped, because a path came too late.
        self.n_skipped = 0
        if settings.instance is None:
            self.spec, self._robots, self._own = own_spec(settings, n_rows)
        else:
            with self._connect(settings.instance) as client:
                self.spec, self._robots = running_spec(settings, n_rows, client.info)
        self.n_rows: Final = len(self._robots)
        self.n_worlds: Final = max(1, self.n_rows // self.spec.n_robots)
        self._worlds: Final = range(settings.world, settings.world + self.n_worlds)
        if settings.reads_truth and settings.instance and self.n_worlds > wire.TRUTH_BUFFER:
            raise invalid("truth", f"at most {wire.TRUTH_BUFFER} worlds", self.n_worlds)
        warn_without_rewards(self.spec)

    @property
    def turn(self) -> threading.RLock:
        """A lock, for `with` statements, that lets only one thread at a time step or reset."""
        return self._turn.lock

    @property
    def instance(self) -> str:
        """Name of the running server."""
        if self.settings.instance is None:
            raise invalid("instance", "an environment made with instance=...", "one without")
        return self.lease.client.instance

    @property
    def lease(self) -> Lease:
        """The lease on the session's robots."""
        if self._lease is None:
            raise not_reset()
        return self._lease

    @property
    def is_open(self) -> bool:
        """Whether the session has been reset since it was made or closed."""
        return self._lease is not None

    @property
    def is_unfinished(self) -> bool:
        """Whether worlds may have moved unobserved, so that all must be reset or resumed."""
        return self._state in _UNFINISHED

    def begin_step(self) -> None:
        if self._state is not State.READY:
            raise self._no_step()
        self._state = State.BEGUN

    def begin_reset(self) -> None:
        self._state = State.TORN if self.is_unfinished else State.BEGUN

    def finish(self) -> None:
        self._state = State.READY

    def refuse_over(self) -> EmberwatchError:
        """Returns the error that steps in a shared world raise after its episode's end."""
        self._state = State.OVER
        return self._no_step()

    def resume(self) -> StepAnswer:
        """Continues the current episodes of the worlds, for example after another agent."""
        if self.settings.instance is None and not self.is_open:
            self._state = State.CLOSED
            raise invalid("options", "a reset before resume=True", "the first one")
        self._open(0)
        with self._classified():
            return self._observe()

    def reset(self, indices: Sequence[int], seeds: Sequence[int]) -> StepAnswer:
        """Begins episodes in the worlds `indices`, counted from 0; returns all worlds' results.

        If the server has ended, a reset of all worlds connects to a new server of the instance.
        """
        may_move = self.is_open and len(indices) == self.n_worlds
        try:
            return self._begin(indices, seeds)
        except ServerGoneError:
            if not may_move:
                raise
        return self._begin(indices, seeds)

    def clone_state(self) -> bytes:
        """Returns the state of the worlds, which must be in this process."""
        if self._client is None or self._state is not State.READY:
            raise self._no_step()
        return self._client.clone_state()

    def restore_state(self, worlds: bytes) -> StepAnswer:
        """Replaces the worlds; returns the results and frames of their current steps."""
        if self._client is None or not self.is_open:
            raise not_reset()
        self.begin_reset()
        self._open(0)
        with self._classified():
            self._client.restore_state(worlds)
            self._state = State.MOVED
            return self._observe()

    def step(self, paths: ArrayLike, rows: range | None = None) -> StepAnswer:
        """Flies a path with each robot, or with all robots `rows` of some worlds.

        If a shared world moved on without this path, the path is dropped, and the answer has the
        world's current results.
        """
        lease = self.lease
        robots = None if rows is None else self._robots[rows.start : rows.stop]
        accepts_late, timeout = self._accepts_late, self.settings.timeout
        try:
            answer, self.n_skipped = lease.fly(
                paths, robots=robots, accepts_late=accepts_late, timeout=timeout
            )
        except LOST as error:
            raise self._lost(error) from None
        except EmberwatchError as error:
            self._refused(error)
            raise
        self._state = State.MOVED
        return answer

    def truth(self, answer: StepAnswer) -> NDArray[np.uint8]:
        """Returns the hidden states after the step of an answer, `(n_rows, H, W)`; a copy."""
        if self._truth is None:
            raise EmberwatchError("truth: expected an open session made with truth=True", "closed")
        first = answer.first_robot // self.spec.n_robots - self.settings.world
        moments = [WorldResult(*world.item()).moment for world in answer.worlds]
        truths = self._truth.at(moments, self.settings.timeout, first)
        return np.stack([truth.states for truth in truths])[answer.world_of]

    def teams(self, answer: StepAnswer) -> StepAnswer:
        """Returns the results of all robots in the answer's world, and the team's frame."""
        # Recalls the answer's step, because other clients may have moved the world since then.
        n_robots, client = self.spec.n_robots, self._client
        if client is None:
            raise not_reset()
        first = answer.first_robot // n_robots * n_robots
        step = int(answer.worlds["step"][0])
        return client.recall(step, first, n_robots, team=True, timeout=self.settings.timeout)

    def left_belief(self, row: int) -> LeftBelief | None:
        """Returns the belief that an agent left for a robot's current step."""
        if self._client is None:
            raise not_reset()
        try:
            return self._client.belief(self._robots[row], timeout=self.settings.timeout)
        except LOST as error:
            raise self._lost(error) from None

    def history(self, row: int, step: int) -> Iterator[StepAnswer]:
        """Yields the earlier steps of a robot's episode; warns once if the first are not kept."""
        client, robot, past = self._client, self._robots[row], 0
        while client is not None and past < step:
            try:
                yield client.recall(past, robot, timeout=self.settings.timeout)
            except LOST as error:
                raise self._lost(error) from None
            except EmberwatchError as error:
                if error.code != "not_kept":
                    raise
                if error.detail <= past:
                    return  # another episode has begun
                past = error.detail - 1  # earlier steps are gone, perhaps since the last recall
                if not self._has_warned_of_gap:
                    self._has_warned_of_gap = True
                    warn(
                        f"row {row}: joins an episode whose first {error.detail} steps are no "
                        "longer kept: its belief and its memory of frames begin with the later "
                        "ones; start the server with a larger --history"
                    )
            past += 1

    def close(self) -> None:
        """Releases the worlds; the next reset opens the session again."""
        self._state = State.CLOSED
        lease, self._lease = self._lease, None
        try:
            # Worlds in this process end with their client, without a release.
            if lease is not None and self.settings.instance is not None:
                lease.release(timeout=self.settings.timeout)
        except EmberwatchError:
            pass  # the lease is lost or the server has ended: there is nothing to release
        finally:
            for part in (self._truth, self._client):
                if part is not None:
                    part.close()
            self._truth = self._client = None

    def _open(self, seed: int) -> None:
        """Opens the worlds, or waits for an interrupted call. `seed`: of world 0, if it is here."""
        if self.is_open:
            if self._state is State.TORN:
                with self._classified():
                    self._settle()
            return
        settings = self.settings
        self.close()  # an interrupted call may have left parts open
        try:
            if settings.instance is None:
                assert self._own is not None
                self._client = client = Client.embedded(self._own, seed)
                self._truth = Present(client.truths) if settings.reads_truth else None
            else:
                self._client = client = self._connect(settings.instance)
                self._check_unchanged(client)
                if settings.reads_truth:
                    self._truth = Newest(client.instance, self._worlds)
            self._lease = self._acquire(client, settings.takeover)  # sets `is_open`
            self._state = State.MOVED
        except BaseException:
            self.close()
            raise

    def _acquire(self, client: Client, takeover: bool) -> Lease:
        return client.acquire(
            self._robots.start,
            self.n_rows,
            takeover=takeover,
            ttl=None if self.settings.instance is None else _LEASE,
            timeout=RESET_TIMEOUT,
        )

    def _settle(self) -> None:
        client = self._client
        assert client is not None
        # Checks first that the server answers, because the answer to `acquire` may take a whole
        # burn-in.
        client.status(timeout=self.settings.timeout)
        try:
            # The answer comes only after a reset's burn-in. From then on, the server refuses paths
            # sent with the old lease.
            self._lease = self._acquire(client, takeover=False)
        except EmberwatchError as error:
            if error.code == "busy":
                words = f"lease lost to pid {error.detail}, which took the robots over"
                raise LeaseLostError(words, detail=error.detail) from None
            raise
        self._state = State.MOVED

    def _connect(self, instance: str) -> Client:
        return connect(instance, timeout=self.settings.timeout, wait=self.settings.timeout)

    def _begin(self, indices: Sequence[int], seeds: Sequence[int]) -> StepAnswer:
        self._warn_of_test_worlds(seeds)
        self._open((seeds[0] - indices[0]) & (2**64 - 1))
        with self._classified():
            lease = self.lease
            lease.reset(seeds, worlds=[self._worlds[index] for index in indices])
            self._state = State.MOVED
            answer = self._observe()
        if not self._has_warned and (advice := about_barren_worlds(self.spec, answer)):
            self._has_warned = True
            warn(advice)
        return answer

    def _warn_of_test_worlds(self, seeds: Sequence[int]) -> None:
        if self.allows_test_worlds:
            return
        try:
            warn_of_test_worlds(self.spec.task, seeds)
        except Warning:  # a warnings filter raised it as an error: nothing has changed yet
            if self._state is State.BEGUN:
                self._state = State.READY if self.is_open else State.CLOSED
            raise

    def _lost(self, error: EmberwatchError) -> EmberwatchError:
        """Closes the session after a loss; after a timeout, it stays open."""
        if isinstance(error, RequestTimeoutError):
            self._state = State.TIMED_OUT
        else:
            self.close()
        return error

    def _refused(self, error: EmberwatchError) -> None:
        """Makes the session ready again after a refusal, if nothing has changed."""
        if self._state is State.BEGUN and error.code not in ("late", "early"):
            self._state = State.READY

    @contextmanager
    def _classified(self) -> Generator[None]:
        try:
            yield
        except LOST as error:
            raise self._lost(error) from None
        except EmberwatchError as error:
            self._refused(error)
            raise

    def _no_step(self) -> EmberwatchError:
        if not self.is_unfinished and self._state is not State.OVER:
            return not_reset()
        if self._state is State.OVER:
            return EmberwatchError(
                "the episode of the world is over: only a client that holds all its robots can "
                "reset it",
                "episode_over",
            )
        what, code = "did not finish (Ctrl-C or an error)", "interrupted"
        if self._state is State.TIMED_OUT:
            what, code = "timed out", "closed"
        return EmberwatchError(
            f"an earlier step or reset {what}, and the world may have moved: reset, or continue "
            "the episode with reset(options={'resume': True})",
            code,
        )

    def _observe(self) -> StepAnswer:
        return self.lease.observe(timeout=self.settings.timeout)

    def _check_unchanged(self, client: Client) -> None:
        """Refuses a new server of the instance if its worlds differ from the first server's."""
        spec, _ = running_spec(self.settings, self._asked_rows, client.info)
        if spec != self.spec:
            names = [each.name for each in fields(spec) if each.compare]
            others = [name for name in names if getattr(spec, name) != getattr(self.spec, name)]
            raise invalid(
                f"instance {client.instance!r}",
                "the server as it was when the environment was made",
                f"another {', '.join(others)}: make the environment again",
            )


def not_reset() -> EmberwatchError:
    """Returns the error for an environment that was not reset."""
    return EmberwatchError("the environment is closed: reset it first", "closed")
