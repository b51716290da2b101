"""The worlds behind an environment: those of a running server, or of a private one.

Nothing of iceoryx2 is open before the first reset, so that environments may be made in one
process and used in a forked child, as Gymnasium's `AsyncVectorEnv` does.
"""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from emberwatch import wire
from emberwatch.arguments import as_seed
from emberwatch.client import Client, connect
from emberwatch.errors import (
    ClosedError,
    EmberwatchError,
    LeaseLostError,
    RequestTimeoutError,
    ServerGoneError,
    SettingError,
)
from emberwatch.lease import Lease
from emberwatch.model import Model
from emberwatch.ports import RESET_TIMEOUT
from emberwatch.programs import Program, unused_instance
from emberwatch.settings import Settings, private_world, running_world
from emberwatch.truth import HiddenStates
from emberwatch.wire import StepAnswer

#: A lease of an environment ends this long after its last use, seconds: learners may think long,
#: and a dead holder is noticed at once anyway. Of a private server nobody else wants the worlds.
_LEASE: Final = 3600.0
_PRIVATE_LEASE: Final = 86400.0

#: How long a private server may take to answer that it ends, seconds.
_FAREWELL: Final = 0.5


class Session:
    """Consecutive worlds, under a lease. Opens itself at the first reset."""

    def __init__(self, settings: Settings, n_worlds: int = 1) -> None:
        """Checks the settings, with the running server if one is named.

        Raises:
            SettingError: If a value is impossible or not the running server's.
            NoServerError: If the named instance has no server.
        """
        self.settings: Final = settings
        self.n_worlds: Final = n_worlds
        self._client: Client | None = None
        self._lease: Lease | None = None
        self._program: Program | None = None
        self._truth: HiddenStates | None = None
        #: Whether a step has timed out, so that the worlds may stand elsewhere than thought.
        self._is_lost = False
        if settings.truth and n_worlds > wire.TRUTH_BUFFER:
            raise SettingError(
                f"truth: expected at most {wire.TRUTH_BUFFER} worlds, got {n_worlds}"
            )
        if settings.instance is None:
            self.model, self.shape, self.burn_in = private_world(settings)
        else:
            with connect(
                settings.instance, timeout=settings.timeout, wait=settings.timeout
            ) as client:
                self.model, self.shape, self.burn_in = running_world(
                    settings, n_worlds, client.info
                )
        if self.model is not None and not self.model.reward.any():
            warnings.warn(
                f"model {self.model.name!r}: no state pays: every reward will be 0; give a state "
                "a `reward` in the model file",
                stacklevel=2,
            )

    @property
    def instance(self) -> str:
        """The instance's name, once open.

        Raises:
            ClosedError: Before the first reset.
        """
        return self._opened().client.instance

    @property
    def is_open(self) -> bool:
        """Whether there has been a reset since it was made or closed."""
        return self._lease is not None

    @property
    def is_private(self) -> bool:
        """Whether the server is its own."""
        return self.settings.instance is None

    def resume(self) -> StepAnswer:
        """Goes on from where the worlds stand, such as after another agent.

        Raises:
            SettingError: If a private server has not been started yet.
            LeaseLostError, ServerGoneError: The session is closed then; another try opens anew.
        """
        if self.is_private and not self.is_open:
            raise SettingError("options: expected a reset before resume=True, got the first one")
        self.open(None)
        try:
            return self._observe()
        except (LeaseLostError, ServerGoneError):
            self.close()
            raise

    def reset(self, indices: Sequence[int], seeds: Sequence[int]) -> StepAnswer:
        """Begins new episodes in some of the worlds, counted from 0; returns how all stand.

        If the server has ended, those in all worlds begin at another.

        Raises:
            SettingError: If a seed does not fit into 64 bits.
            LeaseLostError, ServerGoneError: The session is closed then; another try opens anew.
        """
        seeds = [as_seed(seed) for seed in seeds]
        may_move = self.is_open and len(indices) == self.n_worlds
        try:
            return self._begin(indices, seeds)
        except ServerGoneError:
            if not may_move:
                raise
        return self._begin(indices, seeds)

    def step(self, moves: NDArray[np.uint8], indices: range | None = None) -> StepAnswer:
        """Flies checked paths in all worlds, or some consecutive ones.

        Raises:
            LeaseLostError: If another client took a world over; the session is closed then.
            ServerGoneError: If the server has ended; the session is closed then.
            RequestTimeoutError: If no answer comes in time. The worlds may have moved: reset or
                resume next.
        """
        lease = self._opened()
        if self._is_lost:
            raise ClosedError(
                "an earlier step timed out, and the world may have moved: reset, or go on from "
                "where it stands with reset(options={'resume': True})"
            )
        worlds = lease.worlds if indices is None else lease.worlds[indices.start : indices.stop]
        try:
            return lease.step_moves(moves, worlds, full=False, timeout=self.settings.timeout)
        except (LeaseLostError, ServerGoneError):
            self.close()
            raise
        except RequestTimeoutError:
            self._is_lost = True
            raise

    def truth(self, answer: StepAnswer) -> NDArray[np.uint8]:
        """The hidden states that belong to an answer, `(n_worlds, H, W)`; a copy.

        Raises:
            RequestTimeoutError: If they are not published in time.
        """
        if self._truth is None:
            raise ClosedError("truth: expected an open session made with truth=True")
        first = answer.first_world - self.settings.world
        results = [answer.result(index) for index in range(len(answer.frames))]
        moments = [(result.seed, result.episode, result.step) for result in results]
        return self._truth.at(moments, self.settings.timeout, first)

    def open(self, seed: int | None) -> None:
        """Connects and acquires the worlds; a private server starts with `seed` for world 0.

        Raises:
            SettingError: If the named server is no longer as it was when this was made.
        """
        if self._lease is not None:
            return
        settings = self.settings
        try:
            if settings.instance is None:
                self._client = client = self.launch(0 if seed is None else seed % 2**64)
            else:
                client = connect(settings.instance, timeout=settings.timeout, wait=settings.timeout)
                self._client = client
                self._check_unchanged(client)
            self._lease = client.acquire(
                settings.world,
                self.n_worlds,
                takeover=settings.takeover,
                ttl=_PRIVATE_LEASE if self.is_private else _LEASE,
                timeout=RESET_TIMEOUT,
            )
            if settings.truth:
                self._truth = HiddenStates(client.instance, settings, self.n_worlds, self.shape)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Gives the worlds back; a private server stops. Again is fine, and so is a new reset."""
        lease, self._lease = self._lease, None
        client, self._client = self._client, None
        program, self._program = self._program, None
        truth, self._truth = self._truth, None
        self._is_lost = False
        if truth is not None:
            truth.close()
        try:
            if program is not None and client is not None:
                # A server asked ends at once, one that gets a signal when it next looks around.
                client.shutdown(timeout=min(self.settings.timeout, _FAREWELL))
            elif lease is not None:
                lease.release(timeout=self.settings.timeout)
        except EmberwatchError:
            pass  # lost, or the server is gone: nothing is held any more
        if client is not None:
            client.close()
        if program is not None:
            program.stop()

    def _begin(self, indices: Sequence[int], seeds: Sequence[int]) -> StepAnswer:
        self.open(seeds[0] - indices[0])
        lease = self._opened()
        try:
            lease.reset(seeds, worlds=[lease.worlds[index] for index in indices])
            return self._observe()
        except (LeaseLostError, ServerGoneError):
            self.close()
            raise

    def _opened(self) -> Lease:
        if self._lease is None:
            raise ClosedError("the environment is closed: reset it first")
        return self._lease

    def _observe(self) -> StepAnswer:
        answer = self._opened().observe(timeout=self.settings.timeout)
        self._is_lost = False
        return answer

    def _check_unchanged(self, client: Client) -> None:
        """Another server may serve the instance by now."""
        model, shape, burn_in = running_world(self.settings, self.n_worlds, client.info)
        if (shape, burn_in, _text(model)) != (self.shape, self.burn_in, _text(self.model)):
            raise SettingError(
                f"instance {client.instance!r}: expected the server as it was when the environment "
                f"was made, {self.shape}, got {shape} or another model: make the environment anew"
            )

    def launch(self, seed: int) -> Client:
        """Starts the private server, with this seed for world 0; `close` stops it.

        Raises:
            LaunchError: If it does not start, with its own words.
        """
        instance = unused_instance()
        settings = self.settings
        shape = self.shape
        arguments = {
            "instance": instance,
            "worlds": self.n_worlds,
            "model": settings.model_argument,
            "height": shape.height,
            "width": shape.width,
            "moves": shape.n_moves,
            "burn-in": self.burn_in,
            "start": settings.start or "corner",
            "seed": seed,
            "publish-truth": str(settings.truth).lower(),
        }
        self._program = Program(
            "emberwatch-server", [f"--{flag}={value}" for flag, value in arguments.items()]
        )
        # For environments that nobody closes. Does nothing where it has been stopped before.
        weakref.finalize(self, self._program.stop)
        return self._program.wait_for(lambda: Client(instance, timeout=settings.timeout))


def state_to_copy(environment: object, is_open: bool) -> dict[str, Any]:
    """What a copy of an environment gets, pickled or not.

    Raises:
        TypeError: If it is open: no two may act on the same worlds.
    """
    if is_open:
        raise TypeError(
            f"copy or pickle: expected a closed environment, got a {type(environment).__name__} "
            "that acts on a server's worlds: close it first, or make another with "
            "gymnasium.make(env.spec); Client.snapshot and Lease.fork copy worlds"
        )
    return vars(environment).copy()


def _text(model: Model | None) -> str | None:
    return None if model is None else model.toml
