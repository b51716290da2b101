"""Worlds that an agent estimates, plans and steps in: its client chooses what each path is for."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from emberwatch import wire
from emberwatch.client import Client, connect_with_retry
from emberwatch.connection import RESET_TIMEOUT
from emberwatch.decisions import Decisions
from emberwatch.errors import (
    EmberwatchError,
    InvalidArgumentError,
    LeaseLostError,
    NoServerError,
    RequestTimeoutError,
    ServerGoneError,
    bad_answer,
    invalid,
)
from emberwatch.lease import Lease
from emberwatch.moves import fly
from emberwatch.observer import Frame, Newest, Observer
from emberwatch.programs import Program
from emberwatch.replies import Decision, DecisionsInfo
from emberwatch.session import Session, not_reset
from emberwatch.settings import Settings
from emberwatch.wire import StepAnswer

#: Exit code of an agent whose lease was lost.
_LEASE_LOST: Final = 3

_CHOICES: Final = {
    "estimator": (
        None,
        "known_model",
        "spatial_filter",
        "learned_filter",
        "learned_spatial_filter",
        "learned_own_filter",
        "learned_own_spatial_filter",
        "neural_belief",
    ),
    "prior": ("simulated", "initial", "uniform"),
    "agent": ("own", "running"),
}

#: Objectives of an agent that serves decisions, and numbers that describe the plan for each.
_N_OBJECTIVES: Final = 8
_N_FEATURES: Final = 26


class AgentSession(Session):
    """Consecutive worlds that an agent holds the lease of. Opens itself at the first reset.

    Its answers' frames are empty unless there is a render mode.
    """

    def __init__(
        self, settings: Settings, arguments: Mapping[str, str | None], n_worlds: int = 1
    ) -> None:
        """`arguments` are `estimator`, `checkpoint`, `prior` and `agent` of the environment."""
        for name, choices in _CHOICES.items():
            if arguments[name] not in choices:
                expected = f"one of {', '.join(map(str, choices))}"
                raise invalid(name, expected, repr(arguments[name]))
        if arguments["agent"] == "running" and settings.instance is None:
            raise InvalidArgumentError("agent='running': expected instance=..., where it runs")
        if arguments["agent"] == "running" and arguments["checkpoint"] is not None:
            given = repr(arguments["checkpoint"])
            raise invalid("checkpoint", "none, as the agent runs already", given)
        estimator, checkpoint = arguments["estimator"], arguments["checkpoint"]
        is_learned = estimator is not None and estimator.startswith(("learned", "neural"))
        if is_learned and checkpoint is None and arguments["agent"] == "own":
            expected = f"the file that a training has saved, for estimator={estimator!r}"
            raise invalid("checkpoint", expected, None)
        if settings.render_mode is not None and n_worlds > wire.FRAME_BUFFER:
            raise invalid("render_mode", f"at most {wire.FRAME_BUFFER} worlds", n_worlds)
        if settings.robot is not None or (settings.robots or 1) > 1:
            raise _no_team()
        if settings.is_embedded:
            raise invalid("backend", "'server', which the agent attaches to", repr("embedded"))
        super().__init__(settings, n_worlds)
        if self.spec.n_robots > 1:
            raise _no_team()
        if self.spec.model is None and not self.spec.is_recorded:
            raise InvalidArgumentError("model: expected one, as the server does not reveal its own")
        #: Of one world.
        self.action_space: Final = spaces.Discrete(_N_OBJECTIVES)
        shape = _N_OBJECTIVES, _N_FEATURES
        self.space: Final = spaces.Box(-np.inf, np.inf, shape, np.float32)
        self._arguments = arguments
        self._own_agent: Program | None = None
        self._decisions: Decisions | None = None
        self._frames: Newest[Frame] | None = None
        #: What the plans of each world promise; new after each answer.
        self.features = np.zeros((n_worlds, *self.space.shape), np.float32)
        #: The cells of each world's last path, where there is a render mode.
        self.paths: list[NDArray[np.intp]] = []

    @property
    def info(self) -> DecisionsInfo:
        """The agent's description of itself, once there has been a reset."""
        return self._asked().info

    @property
    def instance(self) -> str:
        return self.info.instance

    @property
    def lease(self) -> Lease:
        raise invalid("lease", "an environment that flies itself", "one whose agent flies")

    @property
    def is_open(self) -> bool:
        return self._decisions is not None

    def decide(self, objectives: NDArray[np.uint8], moved: NDArray[np.bool_]) -> StepAnswer:
        """One step of the worlds `moved`, each for its objective; returns how all stand."""
        agent = self._asked()
        worlds = zip(objectives.tolist(), moved.tolist(), strict=True)
        asked = [objective if moves else None for objective, moves in worlds]
        with self._told():
            decisions = agent.decide(asked, timeout=self.settings.timeout)
        self._has_moved = True
        return self._answer(decisions)

    def close(self) -> None:
        """Ends the agent and the private server, if they are its own. May be called again."""
        decisions, self._decisions = self._decisions, None
        try:
            if decisions is not None:
                decisions.close()
        finally:
            super().close()

    def _drop(self) -> None:
        if self._frames is not None:
            self._frames.close()
        if self._own_agent is not None:
            self._own_agent.stop()
        self._frames = self._own_agent = None
        super()._drop()

    def _hold(self, client: Client) -> None:
        """Starts the agent, which acquires the worlds."""
        instance = client.instance
        if self.settings.instance is not None:
            client.close()  # a server has few places for clients, and the agent needs one
            self._client = None
        if self.settings.render_mode is not None:
            self._frames = Newest(partial(Observer, instance), self._worlds)
        if self._arguments["agent"] == "own":
            self._decisions = self._start_agent(instance)
            return
        decisions = connect_with_retry(
            self.settings.timeout, partial(self._connect_to_agent, instance)
        )
        if decisions.worlds != self._worlds:
            decisions.close()
            first, last = decisions.worlds[0], decisions.worlds[-1]
            raise InvalidArgumentError(
                f"agent='running': expected one of worlds {self._worlds[0]} to {self._worlds[-1]}, "
                f"got one of {first} to {last}"
            )
        asked, runs = self._arguments["estimator"], decisions.info.estimator
        if asked not in (None, runs):
            decisions.close()
            raise invalid("estimator", f"that of the running agent, {runs!r}", repr(asked))
        self._decisions = decisions

    def _start_agent(self, instance: str) -> Decisions:
        settings = self.settings
        flags = {"instance": instance, "world": settings.world, "worlds": self.n_worlds, "wait": 0}
        given = {name: self._arguments[name] for name in ("estimator", "checkpoint", "prior")}
        flags |= {name: value for name, value in given.items() if value is not None}
        if settings.instance is not None and settings.model is not None:
            flags["model"] = str(settings.model)
        command = ["serve-decisions", *(f"--{flag}={value}" for flag, value in flags.items())]
        self._own_agent = agent = Program(
            "emberwatch-agent", command + ["--takeover"] * settings.takeover
        )

        def connect_to_own() -> Decisions:
            decisions = self._connect_to_agent(instance)
            if decisions.info.pid == agent.pid:
                return decisions
            # Another agent serves the worlds; the own one will end with an error about it.
            decisions.close()
            raise NoServerError(f"world {settings.world} has another agent")

        return agent.wait_for(connect_to_own, RESET_TIMEOUT)

    def _asked(self) -> Decisions:
        if self._decisions is None:
            raise not_reset()
        return self._decisions

    def _connect_to_agent(self, instance: str) -> Decisions:
        return Decisions(instance, self.settings.world, timeout=self.settings.timeout)

    def _restart(self, worlds: Sequence[int], seeds: Sequence[int]) -> StepAnswer:
        decisions = self._asked().reset(seeds, worlds=worlds)
        self._has_moved = True
        return self._answer(decisions)

    def _observe(self) -> StepAnswer:
        if self._program is not None and self._program.has_ended():
            # An agent answers from memory until it notices.
            raise ServerGoneError(f"the server of instance {self.instance!r} has ended")
        return self._answer(self._asked().last(timeout=self.settings.timeout))

    def _settle(self) -> None:
        """Waits for a reset that still runs: the agent answers one request after the other."""
        if self._is_torn:
            self._asked().last(timeout=RESET_TIMEOUT)
            self._is_torn = False

    def _answer(self, decisions: tuple[Decision, ...]) -> StepAnswer:
        """Takes in the features; the rest as the server would tell it."""
        spec, expected = self.spec, self.features.shape
        self.features = self._asked().features(decisions)
        if self.features.shape != expected:
            raise bad_answer("decisions", f"features of shape {expected}", self.features.shape)
        results = b"".join([*map(_world, decisions), *map(_robot, decisions)])
        frames = self._seen([(made.seed, made.episode, made.step) for made in decisions])
        payload = np.frombuffer(bytearray(results + frames), np.uint8)
        return StepAnswer(spec.shape, self.settings.world, len(decisions), 0, 0, payload)

    def _seen(self, moments: list[tuple[int, int, int]]) -> bytes:
        spec = self.spec
        if self._frames is None:
            return bytes([wire.UNOBSERVED]) * (len(moments) * spec.height * spec.width)
        seen = self._frames.at(moments, self.settings.timeout)
        robots = [one.robots[0] for one in seen]
        self.paths = [fly(robot.result.start, robot.path, spec) for robot in robots]
        return b"".join(robot.frame.tobytes() for robot in robots)

    def _lost(self, error: EmberwatchError) -> EmberwatchError:
        """The error in the agent's own words, if it has ended."""
        agent = self._own_agent
        code = (
            None if agent is None or isinstance(error, RequestTimeoutError) else agent.exit_code()
        )
        words = "" if agent is None or code is None else agent.output()
        super()._lost(error)
        if code is None or isinstance(error, LeaseLostError):
            return error
        kind = LeaseLostError if code == _LEASE_LOST else ServerGoneError
        return kind(f"{error}: {words}")


def _no_team() -> InvalidArgumentError:
    return InvalidArgumentError(
        "robots, robot: expected worlds of one robot, as an agent that serves decisions flies one"
    )


def _world(made: Decision) -> bytes:
    counts = made.n_target_cells, made.n_visited, made.n_hits
    ends = made.terminated, made.truncated
    return wire.WORLD.pack(made.step, made.seed, made.episode, made.reward, 0, 0, *counts, *ends)


def _robot(made: Decision) -> bytes:
    counts, cell = (made.n_visited, made.n_hits), made.robot
    return wire.ROBOT.pack(made.reward, made.reward, *counts, *cell, *cell, 0, 0)


class Features:
    """Observations of worlds that an agent acts on: what its plans promise."""

    def __init__(self, session: AgentSession) -> None:
        self._session = session
        self.space: Final = session.space

    def reset(self, begun: NDArray[np.bool_], frames: NDArray[np.uint8]) -> None:
        """The agent forgets by itself."""

    def update(self, moved: NDArray[np.bool_], frames: NDArray[np.uint8]) -> None:
        """The agent sees by itself."""

    def all(self, frames: NDArray[np.uint8], robots: NDArray[np.int64]) -> NDArray[np.float32]:
        """The observations of all worlds, stacked."""
        return self._session.features


class AgentSessionOwner:
    """What environments of one world and of many tell of their agent."""

    _agent: AgentSession

    @property
    def objectives(self) -> tuple[str, ...]:
        """The names of the actions, once the environment has been reset."""
        return self._agent.info.objectives

    @property
    def feature_names(self) -> tuple[str, ...]:
        """The names of an observation's columns, once the environment has been reset."""
        return self._agent.info.features
