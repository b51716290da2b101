"""The robots behind an environment: those of a running server, or of a private one.

Nothing of iceoryx2 is open before the first reset, so that environments may be made in one
process and used in a forked child, as Gymnasium's `AsyncVectorEnv` does.
"""

import inspect
import logging
import os
import threading
import warnings
import weakref
from collections.abc import Generator, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emberwatch import wire
from emberwatch.client import Client, connect, embed_settings
from emberwatch.connection import RESET_TIMEOUT
from emberwatch.errors import (
    EmberwatchError,
    LeaseLostError,
    RequestTimeoutError,
    ServerGoneError,
    TrainingOnTestWorldsWarning,
    invalid,
)
from emberwatch.lease import Lease
from emberwatch.observer import Newest, Present, Truth, TruthReader
from emberwatch.programs import Program, unused_instance
from emberwatch.replies import LeftBelief
from emberwatch.settings import Settings, WorldSpec, private_spec, running_spec
from emberwatch.tasks import FIRST_TRAINING_SEED
from emberwatch.wire import StepAnswer, WorldResult

_log: Final = logging.getLogger("emberwatch")

# Seconds after its last use that a lease ends: learners may think long, and a dead holder is
# noticed at once anyway. No other client uses the worlds of a private server.
_LEASE: Final = 3600.0
_PRIVATE_LEASE: Final = 86400.0

#: How long a private server may take to answer that it ends, seconds.
_SHUTDOWN_TIMEOUT: Final = 0.5

#: After these the worlds are no longer held, or stand elsewhere than expected.
LOST: Final = (LeaseLostError, RequestTimeoutError, ServerGoneError)

#: Why there is no next step: the error's code, and its words.
_INTERRUPTED: Final = "interrupted", "an earlier step or reset did not finish (Ctrl-C or an error)"
_TIMED_OUT: Final = "closed", "an earlier step or reset timed out"
_CLOSED: Final = "closed", "the environment is closed"
_OVER: Final = (
    "episode_over",
    "the episode of the world is over: a reset is for a client that holds all its robots",
)

#: A forked child waits for no thread of its parent's, which it does not have.
_sessions: Final = weakref.WeakSet["Session"]()


def _free_turns() -> None:
    for session in _sessions:
        session.turn = threading.RLock()


os.register_at_fork(after_in_child=_free_turns)


class Session:
    """Consecutive robots, under a lease, in rows. Opens itself at the first reset.

    It flies all robots of its worlds, or one robot of a world that others fly in. An environment
    calls `begin_step` or `begin_reset` first and `finish` last: anything between the two may be
    interrupted, by Ctrl-C or by a signal's handler, after which the worlds may have moved unseen.
    All of it is within `with turn`, for programs whose threads share an environment.
    """

    def __init__(self, settings: Settings, n_rows: int | None = 1) -> None:
        """`n_rows`: how many robots; None: those of one world."""
        self.settings: Final = settings
        self._asked_rows = n_rows
        self._client: Client | None = None
        self._lease: Lease | None = None
        self._program: Program | None = None
        self._truth: Newest[Truth] | Present | None = None
        self._has_warned = False
        #: Whether test worlds are meant, as in an evaluation.
        self.allows_test_worlds = False
        #: Lets one thread at a time step or reset. A signal leaves it free again.
        self.turn: AbstractContextManager[object] = threading.RLock()
        _sessions.add(self)
        #: Why there is no next step, such as one that did not finish: worlds may have moved unseen.
        self._unfinished: tuple[str, str] | None = _CLOSED
        #: Whether the worlds may have moved since it began: a refusal alone changes nothing.
        self._has_moved = False
        #: Whether the server may still have a request of an unfinished step or reset.
        self._is_torn = False
        #: World steps that passed unseen before the last answer, as a path came too late.
        self.n_skipped = 0
        if settings.instance is None:
            self.spec, self._robots = private_spec(settings, n_rows)
        else:
            with self._connect(settings.instance) as client:
                self.spec, self._robots = running_spec(settings, n_rows, client.info)
        self.n_rows: Final = len(self._robots)
        n_worlds = self.spec.shape.n_worlds(self._robots.start, self.n_rows)
        self.n_worlds: Final = n_worlds
        self._worlds: Final = range(settings.world, settings.world + n_worlds)
        if settings.truth and not settings.is_embedded and n_worlds > wire.TRUTH_BUFFER:
            raise invalid("truth", f"at most {wire.TRUTH_BUFFER} worlds", n_worlds)
        described = self.spec.described
        if described is not None and not described.reward.any():
            kind = "model" if self.spec.description is None else "description"
            _warn(
                f"{kind} {described.name!r}: no state pays: every reward will be 0; give a state "
                f"a `reward` in the {kind}'s file"
            )

    @property
    def instance(self) -> str:
        if self.settings.is_embedded:
            raise invalid("instance", "backend='server'", "embedded worlds, which have none")
        return self._opened().client.instance

    @property
    def lease(self) -> Lease:
        """Under which it flies."""
        return self._opened()

    @property
    def is_open(self) -> bool:
        """Whether there has been a reset since it was made or closed."""
        return self._lease is not None

    def __getstate__(self) -> dict[str, Any]:
        """For copies, which wait for no thread of this one."""
        return {name: value for name, value in vars(self).items() if name != "turn"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, turn=threading.RLock())
        _sessions.add(self)

    def begin_step(self) -> None:
        """Refuses a step before a reset, and after what did not finish."""
        if self._unfinished is not None:
            raise self._no_step()
        self._has_moved = False
        self._unfinished = _INTERRUPTED

    def begin_reset(self) -> None:
        """Before a reset of all worlds, or of some."""
        self._is_torn = self._has_moved = self.is_unfinished
        self._unfinished = _INTERRUPTED

    def finish(self) -> None:
        """The environment has taken in what `begin_step` or `begin_reset` began."""
        self._unfinished = None

    def refuse_over(self) -> EmberwatchError:
        """The error for one robot of a world that is over; steps raise it until the next reset."""
        self._unfinished = _OVER
        return self._no_step()

    @property
    def is_unfinished(self) -> bool:
        """Whether worlds may have moved unseen: then all are reset, or resumed."""
        return self._unfinished not in (None, _CLOSED, _OVER)

    def resume(self) -> StepAnswer:
        """Goes on from where the worlds stand, such as after another agent."""
        if self.settings.instance is None and not self.is_open:
            self._unfinished = _CLOSED
            raise invalid("options", "a reset before resume=True", "the first one")
        self._open(0)
        with self._told():
            self._settle()
            return self._observe()

    def reset(self, indices: Sequence[int], seeds: Sequence[int]) -> StepAnswer:
        """Begins new episodes in some of the worlds, counted from 0; returns how all stand.

        If the server has ended, those in all worlds begin at another.
        """
        may_move = self.is_open and len(indices) == self.n_worlds
        try:
            return self._begin(indices, seeds)
        except ServerGoneError:
            if not may_move:
                raise
        return self._begin(indices, seeds)

    def step(self, paths: ArrayLike, rows: range | None = None) -> StepAnswer:
        """Flies paths with all robots, or with those of some consecutive worlds.

        Slow teammates are waited for, without end while the server lives. A path that came too
        late for them is given up, and the answer is how the world stands.
        """
        lease = self._opened()
        robots = None if rows is None else lease.robots[rows.start : rows.stop]
        self.n_skipped = 0
        # Sooner would take back the path with which the deadline began.
        timeout = self.settings.timeout + lease.client.info.deadline_millis / 1000
        while True:
            try:
                answer = lease.step(paths, robots=robots, timeout=timeout)
                self._has_moved = True
                return answer
            except (LeaseLostError, ServerGoneError) as error:
                raise self._lost(error) from None
            except EmberwatchError as error:
                # Nobody else moves worlds of which it flies all robots.
                is_late = error.code == "late" and self.settings.robot is not None
                if error.code != "timeout" and not is_late:
                    self._refused(error)
                    raise
            before = lease.steps_of(robots or lease.robots)[0]
            answer = self._look(lease, robots)
            n_moved = int(answer.worlds["step"][0]) - before
            if n_moved > 0:
                self.n_skipped = n_moved - 1
                self._has_moved = True
                return answer
            _log.warning(
                f"world {self._worlds.start} waits for the paths of other robots that are held; "
                "environments of one world need a thread or a process each"
            )

    def truth(self, answer: StepAnswer) -> NDArray[np.uint8]:
        """The hidden states that belong to an answer, `(n_rows, H, W)`; a copy."""
        if self._truth is None:
            raise EmberwatchError("truth: expected an open session made with truth=True", "closed")
        first = answer.first_robot // self.spec.n_robots - self.settings.world
        moments = [WorldResult(*world.item()).moment for world in answer.worlds]
        truths = self._truth.at(moments, self.settings.timeout, first)
        return np.stack([truth.states for truth in truths])[answer.world_of]

    def teams(self, answer: StepAnswer) -> StepAnswer:
        """Results of all robots in the answer's worlds, and the frame of each world's team."""
        # Of one robot's world, which may stand elsewhere by now.
        shape, client = self.spec.shape, self._client
        if client is None:
            raise not_reset()
        first = answer.first_robot // shape.n_robots * shape.n_robots
        step = int(answer.worlds["step"][0])
        return client.recall(step, first, shape.n_robots, team=True, timeout=self.settings.timeout)

    def left_belief(self, row: int) -> LeftBelief | None:
        """The belief that was left for a robot's present step."""
        if self._client is None:
            raise not_reset()
        try:
            return self._client.belief(self._robots[row], timeout=self.settings.timeout)
        except LOST as error:
            raise self._lost(error) from None

    def history(self, row: int, step: int) -> Iterator[StepAnswer]:
        """The steps of a robot's episode before this one, from the first on whose are all kept."""
        client, robot, past = self._client, self._robots[row], 0
        while client is not None and past < step:
            try:
                yield client.recall(past, robot, timeout=self.settings.timeout)
            except LOST as error:
                raise self._lost(error) from None
            except EmberwatchError as error:
                if error.code != "not_kept":
                    raise
                if past > 0:
                    return
                past = error.detail - 1
            past += 1

    def launch(self, seed: int) -> Client:
        """Begins worlds of its own, with this seed for world 0; `close` ends them."""
        if self.settings.is_embedded:
            chosen = {"seed": seed, **self.settings.of_server(self.n_worlds)}
            return embed_settings(chosen, warns=False)
        instance = unused_instance()
        flags = [f"--instance={instance}", f"--seed={seed}"]
        flags += self.settings.server_flags(self.n_worlds)
        self._program = Program("emberwatch-server", flags)
        return self._program.wait_for(lambda: Client(instance, timeout=self.settings.timeout))

    def close(self) -> None:
        """Gives the worlds back; a private server stops. A new reset opens it again.

        May be called again, also after it was interrupted.
        """
        self._unfinished = _CLOSED
        lease, self._lease = self._lease, None
        client, program = self._client, self._program
        try:
            if program is not None and client is not None:
                # Quicker than a signal, which the server notices at its next check.
                client.shutdown(timeout=min(self.settings.timeout, _SHUTDOWN_TIMEOUT))
            elif lease is not None:
                lease.release(timeout=self.settings.timeout)
        except EmberwatchError:
            pass  # lost, or the server is gone: nothing is held any more
        finally:
            self._drop()

    def _drop(self) -> None:
        """Closes all connections; a private server stops."""
        for part in (self._truth, self._client):
            if part is not None:
                part.close()
        self._truth = self._client = None
        if self._program is not None:
            self._program.stop()
        self._program = None

    def _open(self, seed: int) -> None:
        """Connects and holds the worlds; a private server starts with `seed` for world 0."""
        if self.is_open:
            return
        settings = self.settings
        self.close()  # what an interrupted call has left
        try:
            if settings.instance is None:
                self._client = client = self.launch(seed)
            else:
                self._client = client = self._connect(settings.instance)
                self._check_unchanged(client)
            if settings.truth and settings.is_embedded:
                self._truth = Present(client.truths)
            elif settings.truth:
                self._truth = Newest(partial(TruthReader, client.instance), self._worlds)
            self._hold(client)  # the last, as it is open from then on
            self._is_torn, self._has_moved = False, True
            self._unfinished = _INTERRUPTED
        except BaseException:
            self.close()
            raise

    def _hold(self, client: Client) -> None:
        """Gets the right to fly the robots."""
        self._lease = self._acquire(client, self.settings.takeover)

    def _acquire(self, client: Client, takeover: bool) -> Lease:
        return client.acquire(
            self._robots.start,
            self.n_rows,
            takeover=takeover,
            ttl=_PRIVATE_LEASE if self.settings.instance is None else _LEASE,
            timeout=RESET_TIMEOUT,
        )

    def _settle(self) -> None:
        """Waits until the server has nothing left of an unfinished step or reset."""
        client = self._client
        if not self._is_torn or client is None:
            return
        # A server that does not answer is not waited for as long as a burn-in may take.
        client.status(timeout=self.settings.timeout)
        try:
            # Answered after the burn-in of a reset; paths under the old lease are refused by then.
            self._lease = self._acquire(client, takeover=False)
        except EmberwatchError as error:
            if error.code == "busy":
                words = f"lease lost to pid {error.detail}, which took the robots over"
                raise LeaseLostError(words, detail=error.detail) from None
            raise
        self._is_torn = False

    def _connect(self, instance: str) -> Client:
        return connect(instance, timeout=self.settings.timeout, wait=self.settings.timeout)

    def _begin(self, indices: Sequence[int], seeds: Sequence[int]) -> StepAnswer:
        self._warn_of_test_worlds(seeds)
        self._open((seeds[0] - indices[0]) & (2**64 - 1))
        with self._told():
            self._settle()
            answer = self._restart([self._worlds[index] for index in indices], seeds)
        self._warn_of_barren(answer)
        return answer

    def _restart(self, worlds: Sequence[int], seeds: Sequence[int]) -> StepAnswer:
        self._opened().reset(seeds, worlds=worlds)
        self._has_moved = True
        return self._observe()

    def _warn_of_barren(self, answer: StepAnswer) -> None:
        """Warns once of worlds in which there is nothing to find."""
        worlds = answer.worlds
        barren = np.flatnonzero((worlds["n_target_cells"] == 0) & (worlds["step"] == 0))
        if self._has_warned or self.spec.is_recorded or not len(barren):
            return
        self._has_warned = True
        _warn(
            f"no cell of world {barren[0]} (of {len(barren)} of {len(worlds)} worlds) is in the "
            "state that pays most: give it a burn_in, a larger grid, or a model for small ones, "
            "model='wildfire-small'"
        )

    def _warn_of_test_worlds(self, seeds: Sequence[int]) -> None:
        task = self.spec.task
        if (
            task is None
            or self.allows_test_worlds
            or not any(it in task.test_seeds for it in seeds)
        ):
            return
        tests, others = task.test_seeds, max(FIRST_TRAINING_SEED, task.test_seeds.stop)
        # Of this line, wherever the reset is: Python shows it once in a process.
        warnings.warn(
            f"task {task.name!r}: an episode begins on a test world, as seeds {tests.start} to "
            f"{tests.stop - 1} do; train on seeds from {others} on, with reset(seed={others}) or a "
            f"trainer's seed={others}; to test, use emberwatch.benchmark.evaluate, or ignore "
            "emberwatch.TrainingOnTestWorldsWarning with warnings.filterwarnings",
            TrainingOnTestWorldsWarning,
            stacklevel=1,
        )

    def _lost(self, error: EmberwatchError) -> EmberwatchError:
        """Closes what is gone, a reset opens it again; remembers what timed out."""
        if isinstance(error, RequestTimeoutError):
            self._unfinished = _TIMED_OUT
        else:
            self.close()
        return error

    def _refused(self, error: EmberwatchError) -> None:
        """Forgets what has begun, if nothing has changed."""
        if not self._has_moved and error.code not in ("late", "early"):
            self._unfinished = None

    @contextmanager
    def _told(self) -> Generator[None]:
        """Errors of a reset tell whether the worlds are held, and where they stand."""
        try:
            yield
        except LOST as error:
            raise self._lost(error) from None
        except EmberwatchError as error:
            self._refused(error)
            raise

    def _no_step(self) -> EmberwatchError:
        if self._unfinished is None or self._unfinished is _CLOSED:
            return not_reset()
        code, words = self._unfinished
        if self._unfinished is _OVER:
            return EmberwatchError(words, code)
        return EmberwatchError(
            f"{words}, and the world may have moved: reset, or go on from where it stands with "
            "reset(options={'resume': True})",
            code,
        )

    def _opened(self) -> Lease:
        if self._lease is None:
            raise not_reset()
        return self._lease

    def _observe(self) -> StepAnswer:
        return self._opened().observe(timeout=self.settings.timeout)

    def _look(self, lease: Lease, robots: range | None) -> StepAnswer:
        """Where the worlds stand after a step that has no answer."""
        try:
            return lease.observe(robots=robots, timeout=self.settings.timeout)
        except LOST as error:
            raise self._lost(error) from None

    def _check_unchanged(self, client: Client) -> None:
        """Another server may serve the instance by now."""
        spec, _ = running_spec(self.settings, self._asked_rows, client.info)
        if spec != self.spec:
            raise invalid(
                f"instance {client.instance!r}",
                f"the server as it was when the environment was made, {_told(self.spec)}",
                f"{_told(spec)} or another model: make the environment again",
            )


def _told(spec: WorldSpec) -> WorldSpec:
    return replace(spec, model=None, description=None)


def _warn(message: str) -> None:
    """Warns at the caller's line: the first outside this package and Gymnasium."""
    frame, level = inspect.currentframe(), 1
    while frame and frame.f_globals["__name__"].partition(".")[0] in ("emberwatch", "gymnasium"):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)


def not_reset() -> EmberwatchError:
    """The error of an environment without an episode."""
    return EmberwatchError("the environment is closed: reset it first", "closed")
