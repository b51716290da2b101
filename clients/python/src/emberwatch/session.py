"""The worlds behind an environment: those of a running server, or of a private one.

Nothing of iceoryx2 is open before the first reset, so that environments may be made in one
process and used in a forked child, as Gymnasium's `AsyncVectorEnv` does.
"""

from __future__ import annotations

import os
import time
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypedDict

import numpy as np
from numpy.typing import NDArray

from emberwatch import wire
from emberwatch.client import RESET_TIMEOUT, STEP_TIMEOUT, Client, Lease, ServerInfo
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
from emberwatch.observer import Truth, TruthReader
from emberwatch.programs import Program, unused_instance
from emberwatch.wire import StepAnswer

#: A lease of an environment ends this long after its last use, seconds: learners may think long,
#: and a dead holder is noticed at once anyway. Of a private server nobody else wants the worlds.
_LEASE: Final = 3600.0
_PRIVATE_LEASE: Final = 86400.0

#: How long a private server may take to answer that it ends, seconds.
_FAREWELL: Final = 0.5

#: How long to wait for hidden states before they are asked for anew the first time, seconds.
_PATIENCE: Final = 0.02

#: Longest side of a grid and longest path of any server (PROTOCOL.md section 1).
_MAX_SIDE: Final = 4096
_MAX_MOVES: Final = 4096

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
        self._truth: _Truth | None = None
        #: Whether a step has timed out, so that the worlds may stand elsewhere than thought.
        self._is_lost = False
        if not settings.timeout > 0:
            raise SettingError(f"timeout: expected seconds above 0, got {settings.timeout}")
        if settings.truth and n_worlds > wire.TRUTH_BUFFER:
            raise SettingError(
                f"truth: expected at most {wire.TRUTH_BUFFER} worlds, got {n_worlds}"
            )
        if settings.instance is None:
            self.model, self.shape, self.burn_in = _private(settings)
        else:
            with Client(settings.instance, timeout=settings.timeout) as client:
                self.model, self.shape, self.burn_in = _attached(settings, n_worlds, client.info)

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
            LeaseLostError, ServerGoneError: The session is closed then; another try opens anew.
        """
        self.open(None)
        try:
            return self._observe()
        except (LeaseLostError, ServerGoneError):
            self.close()
            raise

    def reset(self, indices: Sequence[int], seeds: Sequence[int]) -> StepAnswer:
        """Begins new episodes in some of the worlds, counted from 0; returns how all stand.

        Raises:
            SettingError: If a seed does not fit into 64 bits.
            LeaseLostError, ServerGoneError: The session is closed then; another try opens anew.
        """
        check_seeds(seeds)
        self.open(seeds[0] - indices[0])
        lease = self._opened()
        try:
            lease.reset(seeds, worlds=[lease.worlds[index] for index in indices])
            return self._observe()
        except (LeaseLostError, ServerGoneError):
            self.close()
            raise

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
        return self._truth.states(answer, self.settings.timeout)

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
                self._client = client = Client(settings.instance, timeout=settings.timeout)
                self._check_unchanged(client)
            self._lease = client.acquire(
                settings.world,
                self.n_worlds,
                takeover=settings.takeover,
                ttl=_PRIVATE_LEASE if self.is_private else _LEASE,
                timeout=RESET_TIMEOUT,
            )
            if settings.truth:
                self._truth = _Truth(client.instance, settings, self.n_worlds, self.shape)
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
        model, shape, burn_in = _attached(self.settings, self.n_worlds, client.info)
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
        # For environments that nobody closes. Does nothing where it has been stopped before.
        weakref.finalize(self, self._program.stop)
        return self._program.wait_for(lambda: Client(instance, timeout=settings.timeout))


class _Truth:
    """The newest hidden states of each world of a session."""

    def __init__(self, instance: str, settings: Settings, n_worlds: int, shape: Shape) -> None:
        self._reader = TruthReader(instance)
        self._first = settings.world
        self._moments: list[tuple[int, int]] = [(-1, -1)] * n_worlds
        self._states = np.zeros((n_worlds, shape.height, shape.width), np.uint8)

    def states(self, answer: StepAnswer, timeout: float) -> NDArray[np.uint8]:
        """The states at the answer's steps, waited for."""
        first = answer.first_world - self._first
        results = [answer.result(index) for index in range(len(answer.frames))]
        wanted = [(result.episode, result.step) for result in results]
        last = first + len(wanted)
        begin = asked = time.perf_counter()
        n_asked = n_lost = 0
        while self._moments[first:last] != wanted:
            now = time.perf_counter()
            if now - begin > timeout:
                raise RequestTimeoutError(f"no hidden states within {timeout} s")
            # Others' worlds may have crowded ours out: a new reader is shown all anew. Where it
            # missed nothing, they may just take longer.
            if now - asked > (_PATIENCE if n_lost else _PATIENCE * 2**n_asked):
                self._reader.close()
                self._reader = TruthReader(self._reader.instance)
                asked, n_asked, n_lost = now, n_asked + 1, 0
            truth = self._reader.receive(min(timeout, _PATIENCE))
            if truth is not None:
                n_lost += truth.n_lost
                self._take(truth)
        return self._states[first:last].copy()

    def close(self) -> None:
        self._reader.close()

    def _take(self, truth: Truth) -> None:
        index = truth.world - self._first
        if 0 <= index < len(self._moments):
            if truth.states.shape != self._states.shape[1:]:
                raise GarbledAnswerError(f"truth: got a grid of {truth.states.shape}")
            self._moments[index] = (truth.episode, truth.step)
            self._states[index] = truth.states


def check_seeds(seeds: Sequence[int]) -> None:
    """Refuses seeds that do not fit into the wire's 64 bits.

    Raises:
        SettingError: Naming one.
    """
    for seed in seeds:
        if not 0 <= seed < 2**64:
            raise SettingError(f"seed: expected 0 to 2**64 - 1, got {seed}")


def draw_seed(generator: np.random.Generator) -> int:
    """The world's seed of a reset without one: the environment's own generator goes on."""
    return int(generator.integers(SEEDS))


def _private(settings: Settings) -> tuple[Model, Shape, int]:
    if settings.takeover or settings.world != 0:
        raise SettingError(
            "takeover, world: expected instance=..., a running server to attach to; a private "
            f"server has its own worlds, got world {settings.world}"
        )
    named = _model_argument(settings)
    model = Model.wildfire() if named == "wildfire" else Model.read(Path(named))
    shape = Shape(
        height=check_count("height", settings.height, 64, _MAX_SIDE),
        width=check_count("width", settings.width, 64, _MAX_SIDE),
        n_moves=check_count("n_moves", settings.n_moves, 64, _MAX_MOVES),
        n_observations=len(model.observation_names),
    )
    burn_in = 10_000 if settings.burn_in is None else settings.burn_in
    if burn_in < 0:
        raise SettingError(f"burn_in: expected steps, at least 0, got {burn_in}")
    return model, shape, burn_in


def _attached(
    settings: Settings, n_worlds: int, info: ServerInfo
) -> tuple[Model | None, Shape, int]:
    for name in ("model", "start"):
        if getattr(settings, name) is not None:
            raise SettingError(f"{name}: expected None, as the running server has its own")
    for name in ("height", "width", "n_moves", "burn_in"):
        asked, has = getattr(settings, name), getattr(info, name)
        if asked is not None and asked != has:
            raise SettingError(f"{name}: expected {has}, as the server has, or None, got {asked}")
    last = settings.world + n_worlds - 1
    if settings.world < 0 or last >= info.n_worlds:
        raise SettingError(
            f"world: expected worlds within 0 to {info.n_worlds - 1}, "
            f"got {settings.world} to {last}"
        )
    if settings.truth and not info.publish_truth:
        raise SettingError("truth: expected a server started with --publish-truth, got one without")
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


def _text(model: Model | None) -> str | None:
    return None if model is None else model.toml


def check_count(name: str, value: int | None, default: int, highest: int) -> int:
    """A keyword that counts something, or its default.

    Raises:
        SettingError: If it is not within 1 to `highest`.
    """
    if value is None:
        return default
    if not 1 <= value <= highest or int(value) != value:
        raise SettingError(f"{name}: expected an integer within 1 to {highest}, got {value}")
    return value
