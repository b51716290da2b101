"""The worlds behind an environment: those of a running server, or of a private one.

Nothing of iceoryx2 is open before the first reset, so that environments may be made in one
process and used in a forked child, as Gymnasium's `AsyncVectorEnv` does.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypedDict

import numpy as np
from numpy.typing import NDArray

from emberwatch import wire
from emberwatch.client import RESET_TIMEOUT, STEP_TIMEOUT, Client, Lease
from emberwatch.errors import (
    ClosedError,
    EmberwatchError,
    GarbledAnswerError,
    LeaseLostError,
    RequestTimeoutError,
    ServerGoneError,
    SettingError,
)
from emberwatch.model import Model
from emberwatch.observer import TruthReader
from emberwatch.programs import Program, unused_instance
from emberwatch.wire import StepAnswer

#: A lease of an environment ends this long after its last use, seconds: learners may think long,
#: and a dead holder is noticed at once anyway.
_LEASE: Final = 3600.0

#: Seeds drawn for resets stay below this, which every JSON reader holds (PROTOCOL.md section 2).
SEEDS: Final = 2**53


class WorldArguments(TypedDict, total=False):
    """The keywords that say which worlds to act on, the same for every environment."""

    instance: str | None
    world: int
    takeover: bool
    model: str | os.PathLike[str] | None
    height: int | None
    width: int | None
    n_moves: int | None
    burn_in: int | None
    start: str | None
    truth: bool
    timeout: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """The same with defaults. None: the default, or for a running server whatever it has."""

    n_worlds: int = 1
    instance: str | None = None
    world: int = 0
    takeover: bool = False
    model: str | os.PathLike[str] | None = None
    height: int | None = None
    width: int | None = None
    n_moves: int | None = None
    burn_in: int | None = None
    start: str | None = None
    truth: bool = False
    timeout: float = STEP_TIMEOUT


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """What decides the spaces."""

    height: int
    width: int
    n_moves: int
    n_observations: int


class Session:
    """Consecutive worlds, under a lease. Opens itself at the first reset."""

    def __init__(self, settings: Settings) -> None:
        """Checks the settings, with the running server if one is named.

        Raises:
            SettingError: If a value is impossible or not the running server's.
            NoServerError: If the named instance has no server.
        """
        self.settings: Final = settings
        self._client: Client | None = None
        self._lease: Lease | None = None
        self._program: Program | None = None
        self._truth: _Truth | None = None
        _check_positive("n_worlds", settings.n_worlds)
        if settings.truth and settings.n_worlds > wire.TRUTH_BUFFER:
            raise SettingError(
                f"truth: expected at most {wire.TRUTH_BUFFER} worlds, got {settings.n_worlds}"
            )
        if settings.instance is None:
            self.model, self.shape, self.burn_in = _private(settings)
        else:
            self.model, self.shape, self.burn_in = _attached(settings, settings.instance)

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
        """Goes on from where the worlds stand, such as after another agent."""
        self.open(None)
        return self._opened().observe(timeout=self.settings.timeout)

    def reset(self, indices: Sequence[int], seeds: Sequence[int]) -> StepAnswer:
        """Begins new episodes in some of the worlds, counted from 0; returns how all stand."""
        self.open(seeds[0] - indices[0])
        lease = self._opened()
        worlds = [lease.worlds[index] for index in indices]
        lease.reset(seeds, worlds=worlds)
        return lease.observe(timeout=self.settings.timeout)

    def step(self, moves: NDArray[np.uint8], indices: range | None = None) -> StepAnswer:
        """Flies checked paths in all worlds, or some consecutive ones.

        Raises:
            LeaseLostError: If another client took a world over; the session is closed then.
            ServerGoneError: If the server has ended; the session is closed then.
        """
        lease = self._opened()
        worlds = lease.worlds if indices is None else lease.worlds[indices.start : indices.stop]
        try:
            return lease.step_moves(moves, worlds, full=False, timeout=self.settings.timeout)
        except (LeaseLostError, ServerGoneError):
            self.close()
            raise

    def truth(self, answer: StepAnswer) -> NDArray[np.uint8]:
        """The hidden states that belong to an answer, `(n_worlds, H, W)`; a copy.

        Raises:
            RequestTimeoutError: If they are not published in time.
        """
        if self._truth is None:
            raise ClosedError("truth: expected an open session made with truth=True")
        return self._truth.states(answer, self.settings.timeout)

    def open(self, seed: int | None) -> None:
        """Connects and acquires the worlds; a private server starts with `seed` for world 0."""
        if self._lease is not None:
            return
        settings = self.settings
        try:
            if settings.instance is None:
                client = self.launch(0 if seed is None else seed % 2**64)
            else:
                client = Client(settings.instance, timeout=settings.timeout)
            self._client = client
            self._lease = client.acquire(
                settings.world,
                settings.n_worlds,
                takeover=settings.takeover,
                ttl=_LEASE,
                timeout=RESET_TIMEOUT,
            )
            if settings.truth:
                self._truth = _Truth(client.instance, settings, self.shape)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Gives the worlds back; a private server stops. Again is fine, and so is a new reset."""
        lease, self._lease = self._lease, None
        client, self._client = self._client, None
        program, self._program = self._program, None
        truth, self._truth = self._truth, None
        if truth is not None:
            truth.close()
        if lease is not None and program is None:
            try:
                lease.release(timeout=self.settings.timeout)
            except EmberwatchError:
                pass  # lost, or the server is gone: nothing is held any more
        if client is not None:
            client.close()
        if program is not None:
            program.stop()

    def _opened(self) -> Lease:
        if self._lease is None:
            raise ClosedError("the environment is closed: reset it first")
        return self._lease

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
            "worlds": settings.world + settings.n_worlds,
            "model": _model_argument(settings),
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
        return self._program.wait_for(lambda: Client(instance, timeout=settings.timeout))


class _Truth:
    """The newest hidden states of each world of a session."""

    def __init__(self, instance: str, settings: Settings, shape: Shape) -> None:
        self._reader = TruthReader(instance)
        self._first = settings.world
        n_worlds = settings.n_worlds
        self._moments: list[tuple[int, int]] = [(-1, -1)] * n_worlds
        self._states = np.zeros((n_worlds, shape.height, shape.width), np.uint8)

    def states(self, answer: StepAnswer, timeout: float) -> NDArray[np.uint8]:
        """The states at the answer's steps, waited for."""
        first = answer.first_world - self._first
        results = [answer.result(index) for index in range(len(answer.frames))]
        wanted = [(result.episode, result.step) for result in results]
        last = first + len(wanted)
        deadline = time.perf_counter() + timeout
        while self._moments[first:last] != wanted:
            truth = self._reader.receive(max(0.0, deadline - time.perf_counter()))
            if truth is None:
                raise RequestTimeoutError(f"no hidden states within {timeout} s")
            index = truth.world - self._first
            if 0 <= index < len(self._moments):
                if truth.states.shape != self._states.shape[1:]:
                    raise GarbledAnswerError(f"truth: got a grid of {truth.states.shape}")
                self._moments[index] = (truth.episode, truth.step)
                self._states[index] = truth.states
        return self._states[first:last].copy()

    def close(self) -> None:
        self._reader.close()


def draw_seed(generator: np.random.Generator) -> int:
    """The world's seed of a reset without one: the environment's own generator goes on."""
    return int(generator.integers(SEEDS))


def _private(settings: Settings) -> tuple[Model, Shape, int]:
    if settings.takeover:
        raise SettingError("takeover: expected instance=..., a running server to attach to")
    named = _model_argument(settings)
    model = Model.wildfire() if named == "wildfire" else Model.read(Path(named))
    shape = Shape(
        height=_check_positive("height", settings.height, 64),
        width=_check_positive("width", settings.width, 64),
        n_moves=_check_positive("n_moves", settings.n_moves, 64),
        n_observations=len(model.observation_names),
    )
    burn_in = 10_000 if settings.burn_in is None else settings.burn_in
    if burn_in < 0:
        raise SettingError(f"burn_in: expected steps, at least 0, got {burn_in}")
    return model, shape, burn_in


def _attached(settings: Settings, instance: str) -> tuple[Model | None, Shape, int]:
    with Client(instance, timeout=settings.timeout) as client:
        info = client.info
    if settings.model is not None or settings.start is not None:
        raise SettingError(f"model, start: the server on instance {instance!r} has its own; omit")
    for name in ("height", "width", "n_moves", "burn_in"):
        asked, has = getattr(settings, name), getattr(info, name)
        if asked is not None and asked != has:
            raise SettingError(f"{name}: expected {has}, as the server has, or None, got {asked}")
    last = settings.world + settings.n_worlds
    if settings.world < 0 or last > info.n_worlds:
        raise SettingError(
            f"world: expected worlds within 0 to {info.n_worlds - 1}, "
            f"got {settings.world} to {last - 1}"
        )
    if settings.truth and not info.publish_truth:
        raise SettingError("truth: expected a server started with --publish-truth")
    shape = Shape(
        height=info.height,
        width=info.width,
        n_moves=info.n_moves,
        n_observations=info.n_observations,
    )
    model = None if info.model is None else Model.from_toml(info.model)
    return model, shape, info.burn_in


def _model_argument(settings: Settings) -> str:
    return "wildfire" if settings.model is None else os.fspath(settings.model)


def _check_positive(name: str, value: int | None, default: int = 1) -> int:
    if value is None:
        return default
    if value < 1:
        raise SettingError(f"{name}: expected at least 1, got {value}")
    return value
