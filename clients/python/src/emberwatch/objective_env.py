"""`emberwatch/WildfireObjective-v0`: one step chooses what the next path is for."""

from __future__ import annotations

import contextlib
import time
import weakref
from collections.abc import Generator
from typing import Any, Final, Literal, Unpack

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from emberwatch.arguments import as_choice, as_seed
from emberwatch.base import WorldEnv, reported, wants_to_resume
from emberwatch.client import connect, connect_with_retry
from emberwatch.decisions import Decisions
from emberwatch.errors import (
    InvalidArgumentError,
    LeaseLostError,
    NoServerError,
    RequestTimeoutError,
    ServerGoneError,
)
from emberwatch.observer import Frame, Observer
from emberwatch.ports import RESET_TIMEOUT
from emberwatch.programs import Program
from emberwatch.replies import Decision
from emberwatch.session import not_reset, timed_out_before
from emberwatch.settings import Settings, WorldArguments, draw_seed
from emberwatch.truth import HiddenStates
from emberwatch.view import fly

#: Exit code of an agent whose lease was lost.
_LEASE_LOST: Final = 3


class WildfireObjectiveEnv(WorldEnv):
    """The paper's high-level decision: what the next path of the robot is for.

    ## Description

    The world is that of `WildfireEnv`. An `emberwatch-agent` keeps the belief about it with the
    known-model filter, and plans each path for the objective chosen; a learner here takes the
    place of the paper's deep Q-network (section III.E), with everything else kept.

    ## Action Space

    `Discrete(S + 1)`: the path is planned for the probability of this state of the model's S
    (wildfire: 0 normal, 1 latent, 2 fire), or S for the entropy of the belief.

    ## Observation Space

    `Box(0, 1, (18 (S + 1) + 2,), float32)`: a summary of the belief that the next plan will use,
    in place of the paper's h_k. Its length is the same for every grid; PROTOCOL.md section 13
    explains the numbers, and `summary_names` names them.

    ## Starting State

    As `WildfireEnv`, with the belief that the world's burn-in leaves one with (`prior`).

    ## Rewards, Episode End, Information

    As `WildfireEnv`.

    ## Arguments

    As `WildfireEnv` without `observation`, and

    * `estimator`: `"known_model"` (the paper's Bayes filter, the default) or `"spatial_filter"`
      (what is seen also changes the belief about neighbouring cells).
    * `planner`: `"beam"` (beam search, the default) or `"shooting"` (the paper's).
    * `prior`: `"simulated"` (the default; takes a second to start), `"initial"` or `"uniform"`.
    * `agent`: `"own"` starts an agent on the world; `"running"` uses one that serves decisions
      already, for `world` of `instance`.

    ## Version History

    * v0: the first.
    """

    def __init__(
        self,
        *,
        estimator: Literal["known_model", "spatial_filter"] = "known_model",
        planner: Literal["beam", "shooting"] = "beam",
        prior: Literal["simulated", "initial", "uniform"] = "simulated",
        agent: Literal["own", "running"] = "own",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class. No server of its own runs before the first reset."""
        for name, value, choices in (
            ("estimator", estimator, ("known_model", "spatial_filter")),
            ("planner", planner, ("beam", "shooting")),
            ("prior", prior, ("simulated", "initial", "uniform")),
            ("agent", agent, ("own", "running")),
        ):
            if value not in choices:
                expected = f"one of {', '.join(choices)}"
                raise InvalidArgumentError(f"{name}: expected {expected}, got {value!r}")
        settings = Settings.of(WildfireObjectiveEnv, world)
        if agent == "running" and settings.instance is None:
            raise InvalidArgumentError("agent='running': expected instance=..., where it runs")
        super().__init__(settings, reveals=settings.truth)
        if self.model is None:
            raise InvalidArgumentError("model: expected one, as the server does not reveal its own")
        self._arguments = {"estimator": estimator, "planner": planner, "prior": prior}
        self._agent: Program | None = None
        self._owns_agent = agent == "own"
        self._decisions: Decisions | None = None
        self._frames: Observer | None = None
        self._truths: HiddenStates | None = None
        self._frame: Frame | None = None
        #: Whether a decision has timed out, so that the world may stand elsewhere than expected.
        self._is_lost = False
        n_objectives = self.model.n_states + 1
        self.action_space = spaces.Discrete(n_objectives)
        self.observation_space = spaces.Box(0.0, 1.0, (18 * n_objectives + 2,), np.float32)

    @property
    def instance(self) -> str:
        """The server's instance name, once the environment has been reset."""
        return self._opened().info.instance

    @property
    def objectives(self) -> tuple[str, ...]:
        """What each action plans for, once the environment has been reset."""
        return self._opened().info.objectives

    @property
    def summary_names(self) -> tuple[str, ...]:
        """What each number of an observation is, once the environment has been reset."""
        return self._opened().info.summary

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begins an episode; see `WildfireEnv`. An agent that does not start says why."""
        super(WorldEnv, self).reset(seed=seed)
        resume = wants_to_resume(options, seed)
        world_seed = draw_seed(self.np_random) if seed is None and not resume else seed
        world_seed = None if world_seed is None else as_seed(world_seed)
        may_move = self._is_open() and not resume
        try:
            decision = self._begin_at(world_seed, resume)
        except ServerGoneError:
            if not may_move:
                raise
            decision = self._begin_at(world_seed, resume)
        self._is_lost = False
        self._path = None
        return self._seen(decision)

    def step(
        self, action: np.integer[Any] | int
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Plans and flies a path for an objective.

        Raises:
            EmberwatchError: As `WildfireEnv.step`, in the agent's words if it has ended.
        """
        objective = as_choice(action, len(self._opened().info.objectives))
        if self._is_lost:
            raise timed_out_before()
        with self._closed_when_lost():
            decision = self._opened().decide(objective, timeout=self._session.settings.timeout)
        observation, info = self._seen(decision)
        return observation, decision.reward, decision.terminated, decision.truncated, info

    def close(self) -> None:
        """Ends the agent and the private server, if they are its own. May be called again."""
        for part in (self._frames, self._truths, self._decisions):
            if part is not None:
                part.close()
        self._frames = self._truths = self._decisions = None
        agent, self._agent = self._agent, None
        if agent is not None:
            agent.stop()
        super().close()

    @contextlib.contextmanager
    def _closed_when_lost(self) -> Generator[None]:
        """Closes what is gone, with an error in the agent's own words; a reset opens it again."""
        try:
            yield
        except RequestTimeoutError:
            self._is_lost = True
            raise
        except (LeaseLostError, ServerGoneError) as error:
            code = None if self._agent is None else self._agent.exit_code()
            words = "" if self._agent is None or code is None else self._agent.output()
            self.close()
            if isinstance(error, LeaseLostError) or code is None:
                raise
            kind = LeaseLostError if code == _LEASE_LOST else ServerGoneError
            raise kind(f"{error}: {words}") from None

    def _is_open(self) -> bool:
        return self._decisions is not None

    def _begin_at(self, seed: int | None, resume: bool) -> Decision:
        """Where an episode begins, or goes on."""
        decisions = self._open(seed)
        with self._closed_when_lost():
            return decisions.last() if resume else decisions.reset(seed)

    def _open(self, seed: int | None) -> Decisions:
        """Starts what is missing: server, agent, readers."""
        if self._decisions is not None:
            return self._decisions
        settings = self._session.settings
        try:
            instance = settings.instance
            if instance is None:
                with self._session.launch(0 if seed is None else seed) as client:
                    instance = client.instance
            else:
                connect(instance, timeout=settings.timeout, wait=settings.timeout).close()
            if self.render_mode is not None:
                self._frames = Observer(instance, world=settings.world)
            if self._reveals:
                shape = (1, self._spec.height, self._spec.width)
                self._truths = HiddenStates(instance, settings.world, shape)
            self._decisions = self._start_agent(instance)
        except BaseException:
            self.close()
            raise
        return self._decisions

    def _start_agent(self, instance: str) -> Decisions:
        settings = self._session.settings
        if not self._owns_agent:
            return connect_with_retry(settings.timeout, lambda: self._connect(instance))
        flags = {"instance": instance, "world": settings.world, "wait": 0, **self._arguments}
        if settings.instance is not None and settings.model is not None:
            flags["model"] = str(settings.model)
        command = ["serve-decisions", *(f"--{flag}={value}" for flag, value in flags.items())]
        self._agent = agent = Program(
            "emberwatch-agent", command + ["--takeover"] * settings.takeover
        )
        # For environments that nobody closes. Does nothing where it has been stopped before.
        weakref.finalize(self, agent.stop)

        def connect_to_own() -> Decisions:
            decisions = self._connect(instance)
            if decisions.info.pid == agent.pid:
                return decisions
            # Another agent serves the world; the own one will end with an error about it.
            decisions.close()
            raise NoServerError(f"world {settings.world} has another agent")

        return agent.wait_for(connect_to_own, RESET_TIMEOUT)

    def _connect(self, instance: str) -> Decisions:
        settings = self._session.settings
        return Decisions(instance, settings.world, timeout=settings.timeout)

    def _opened(self) -> Decisions:
        if self._decisions is None:
            raise not_reset()
        return self._decisions

    def _seen(self, decision: Decision) -> tuple[NDArray[np.float32], dict[str, Any]]:
        info = reported(decision)
        moment = (decision.seed, decision.episode, decision.step)
        if self._truths is not None:
            timeout = self._session.settings.timeout
            self._truth = truth = self._truths.at([moment], timeout)[0]
            info["truth"] = truth.copy()
        if self._frames is not None:
            self._frame = frame = self._await_frame(self._frames, moment)
            self._path = fly(frame.start, frame.path, self._spec) if len(frame.path) else None
        if self.render_mode == "human":
            self._draw()
        return np.array(decision.summary, np.float32), info

    def _await_frame(self, reader: Observer, moment: tuple[int, int, int]) -> Frame:
        """The published frame of a moment: `(seed, episode, step)`."""
        deadline = time.perf_counter() + self._session.settings.timeout
        while True:
            frame = reader.receive(max(0.0, deadline - time.perf_counter()))
            if frame is None:
                raise RequestTimeoutError("no frame was published in time")
            if (frame.result.seed, frame.result.episode, frame.result.step) == moment:
                return frame

    def _draw(self) -> Any:
        if self._frame is None:
            return None
        robot = (self._frame.result.row, self._frame.result.col)
        return self._view.draw(self._frame.frame, robot, self._path, self._truth)
