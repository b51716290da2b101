"""Beliefs about worlds of one robot each, and the plans that `WildfireObjectiveEnv` offers."""

from os import PathLike
from typing import Final, Literal, TypeAlias

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

import emberwatch._native as _native
from emberwatch.client.wire import RobotResult, StepAnswer, StepResult, WorldResult
from emberwatch.common.paths import utf8
from emberwatch.envs.session import Session
from emberwatch.errors import EmberwatchError, InvalidArgumentError, invalid, repr_of

FirstBelief: TypeAlias = Literal["simulated", "initial", "uniform"]

_NAMES: Final = _native.option_names()

#: The names of the options, each an objective.
OBJECTIVES: Final = tuple(_NAMES[0])

#: The names of the features of each option's plan.
FEATURES: Final = tuple(_NAMES[1])


class Plans:
    """The beliefs about the worlds of a session, and each option's plan in each world."""

    def __init__(
        self,
        session: Session,
        estimator: str | None,
        checkpoint: str | PathLike[str] | None,
        prior: FirstBelief,
    ) -> None:
        """Checks the arguments, which `WildfireObjectiveEnv` explains."""
        if session.settings.robot is not None or session.spec.n_robots > 1:
            raise InvalidArgumentError(
                "robots, robot: expected worlds of one robot, as options are planned for one robot"
            )
        names: dict[str, object] = {"estimator": estimator, "prior": prior}
        for name, value in names.items():
            if not isinstance(value, str) and (name, value) != ("estimator", None):
                raise invalid(name, "a name", repr_of(value))
        self._session = session
        path = None if checkpoint is None else utf8("checkpoint", checkpoint)
        # The bytes, because the file may change or move before a reset makes the beliefs again.
        read = None if path is None else (path, _native.checkpoint_bytes(path))
        self._arguments = estimator, read, prior
        #: The action space of one world.
        self.action_space: Final = spaces.Discrete(len(OBJECTIVES))
        shape = len(OBJECTIVES), len(FEATURES)
        self.space: Final = spaces.Box(-np.inf, np.inf, shape, np.float32)
        #: Name of the estimator that computes the beliefs.
        self.estimator: Final = self._made().estimator
        self._native: _native.Options | None = None
        #: As in `Observations`.
        self.has_memory: Final = True
        self.shows_team: Final = False
        self.form: Final = f"estimator={self.estimator!r}, prior={prior!r}, checkpoint={path!r}"
        #: Features of all worlds' plans; a new array after each step.
        self.features = np.zeros((session.n_worlds, *shape), np.float32)
        self._paths = np.zeros((session.n_worlds, len(OBJECTIVES), 0), np.uint8)

    def start_episodes(
        self, begun: NDArray[np.bool_], results: NDArray[np.void], frames: NDArray[np.uint8]
    ) -> None:
        """Begins or resumes the episodes of the worlds in `begun`, as `WildfireObjectiveEnv` tells.

        `results` and `frames` have a row for every world.
        """
        native = self._native = self._native or self._made()
        native.start_episodes(begun, results.view(np.uint8))
        new = begun.copy()
        for world in np.flatnonzero(begun).tolist():
            new[world] = not self._resumes(native, world, results[world])
        native.update(new, results.view(np.uint8), frames)
        self._plan(begun, results)

    def paths(self, choices: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Returns the path of each world's chosen option, `(n_worlds, T)`."""
        return self._paths[np.arange(len(choices)), choices]

    def update(
        self, moved: NDArray[np.bool_], results: NDArray[np.void], frames: NDArray[np.uint8]
    ) -> None:
        """Updates the beliefs about the worlds in `moved` with a step, and plans again there."""
        assert self._native is not None
        self._native.update(moved, results.view(np.uint8), frames)
        self._plan(moved, results)

    def all(self, frames: NDArray[np.uint8], robots: NDArray[np.int64]) -> NDArray[np.float32]:
        """Returns the observations of all worlds, stacked."""
        return self.features

    def one(
        self, frames: NDArray[np.uint8], robots: NDArray[np.int64], teams: StepAnswer | None
    ) -> NDArray[np.float32]:
        """Returns the observation of the only world."""
        return self.features[0]

    def memory(self) -> list[tuple[str, bytes] | None]:
        """Returns the beliefs about all worlds, and what else their plans depend on."""
        native = self._native
        assert native is not None
        return [native.left(world) for world in range(self._session.n_worlds)]

    def restore(self, memory: list[tuple[str, bytes] | None], results: NDArray[np.void]) -> None:
        """Continues from `memory`, and plans again; `results` has a row for every world."""
        native = self._native
        assert native is not None
        every = np.ones(len(memory), np.bool_)
        native.start_episodes(every, results.view(np.uint8))
        for world, left in enumerate(memory):
            if left is None or not native.take_over(world, *left):
                expected = f"a state of the estimator {self.estimator!r}"
                raise invalid("restore_state", expected, "another")
        self._plan(every, results)

    def close(self, results: NDArray[np.void] | None) -> None:
        """Leaves the beliefs about a running server's worlds to their next client."""
        native, self._native = self._native, None
        if native is None:
            return
        try:
            session = self._session
            is_left = session.settings.instance is not None and session.is_open
            if is_left and results is not None and not session.is_unfinished:
                self._leave(native, results)
        finally:
            native.close()

    def _leave(self, native: _native.Options, results: NDArray[np.void]) -> None:
        lease = self._session.lease
        for world, result in enumerate(results):
            at = WorldResult(*result["world"].item()), RobotResult(*result["robot"].item())
            try:
                left = native.left(world)
                if left is not None:
                    lease.leave_belief(StepResult(*at), *left, robot=lease.robots[world])
            except EmberwatchError:
                return  # the server ended or keeps no beliefs: the next client uses past frames

    def _plan(self, worlds: NDArray[np.bool_], results: NDArray[np.void]) -> None:
        assert self._native is not None
        self.features, self._paths = self._native.plan(worlds, results.view(np.uint8))

    def _resumes(self, native: _native.Options, world: int, result: np.void) -> bool:
        """Restores the belief of a world; returns whether it includes the current step."""
        step = int(result["world"]["step"])
        if step == 0:
            return False
        left = self._session.left_belief(world)
        if left is not None and native.take_over(world, left.kind, left.data):
            return True
        for past in self._session.history(world, step):
            native.recall(world, past.results.view(np.uint8), past.frames)
        return False

    def _made(self) -> _native.Options:
        return _native.Options(self._session.spec, self._session.n_worlds, *self._arguments)


class PlansOwner:
    """The public attributes of environments whose actions choose a plan."""

    _plans: Plans

    @property
    def objectives(self) -> tuple[str, ...]:
        """The names of the actions, in order."""
        return OBJECTIVES

    @property
    def feature_names(self) -> tuple[str, ...]:
        """The names of the columns of an observation."""
        return FEATURES

    @property
    def estimator(self) -> str:
        """Name of the estimator that computes the belief."""
        return self._plans.estimator
