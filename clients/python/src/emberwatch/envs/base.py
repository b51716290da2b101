"""The base class of the environments of one robot, and checks that several environments share."""

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Final, Literal, TypeAlias, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from emberwatch.client.wire import UNOBSERVED, StepAnswer
from emberwatch.common.arguments import as_seed
from emberwatch.envs.observations import Observations
from emberwatch.envs.owner import SessionOwner
from emberwatch.envs.session import Session, not_reset
from emberwatch.envs.settings import draw_seed
from emberwatch.envs.view import RENDER_FPS, RENDER_MODES, View
from emberwatch.errors import InvalidArgumentError, invalid, repr_of
from emberwatch.model.moves import fly

NOTHING_TO_DRAW: Final = (
    "render: nothing to draw; give a render_mode to gymnasium.make and reset first"
)

#: Kinds of reward, in the order of the native module's `pays`.
REWARDS: Final = ("share", "team", "marginal")
Reward: TypeAlias = Literal["share", "team", "marginal"]

#: The mask that selects the only row of an environment of one robot.
ONE_ROW: Final = np.ones(1, np.bool_)


class WorldEnv(SessionOwner, gymnasium.Env[Any, Any]):  # pyright: ignore[reportIncompatibleVariableOverride]
    """An environment of one robot, in its own world or in a world of a running server."""

    #: Missing in environments that plan, which refuse `clone_state`.
    _observations: Observations

    metadata: ClassVar[dict[str, Any]] = {  # pyright: ignore[reportIncompatibleVariableOverride]
        "render_modes": list(RENDER_MODES),
        "render_fps": RENDER_FPS,
    }

    def __init__(self, session: Session) -> None:
        self._session = session
        self._spec: Final = session.spec
        self.render_mode = session.settings.render_mode
        self._view = View(self.render_mode, self._spec)
        self._reveals = session.settings.reveals
        #: The robot's index in a world that other clients fly in; None: it is alone in its world.
        self._robot: Final = session.settings.robot
        self._n_missed = 0
        #: Whether the last reset continued the episode where this environment left it.
        self.continues = False
        self._answer: StepAnswer | None = None
        self._truth: NDArray[np.uint8] | None = None
        self._path: NDArray[np.intp] | None = None

    def render(self) -> Any:
        """Draws the last frame, path and robot; next to them the hidden states, if revealed."""
        if self.render_mode is None or not self.is_open:
            gymnasium.logger.warn(NOTHING_TO_DRAW)
            return None
        return None if self.render_mode == "human" else self._draw()

    def close(self) -> None:
        self._session.close()
        self._view.close()
        self._answer = None  # an answer cannot be copied or pickled

    def past_frames(self) -> Iterator[NDArray[np.uint8]]:
        """Yields the robot's frames before the current step, `(H, W)`, from the first that is kept.

        Warns once if frames from the beginning of the episode are no longer kept.
        """
        if self._answer is None:
            raise not_reset()
        step = int(self._answer.worlds["step"][0])
        return (past.frames[0] for past in self._session.history(0, step))

    def _begin(self, seed: int | None, options: dict[str, Any] | None) -> StepAnswer:
        """Begins an episode, or continues the world's current one; sets `continues`."""
        processed = None if self._session.is_unfinished else self._answer
        resumes = wants_to_resume(options, seed) or self._robot is not None
        seed = None if seed is None else as_seed(seed)
        super().reset(seed=seed)
        self._session.begin_reset()
        if resumes:
            answer = self._session.resume()
            if self._robot is not None and answer.worlds["truncated"][0]:
                raise self._session.refuse_over()
        else:
            drawn = draw_seed(self.np_random) if seed is None else seed
            answer = self._session.reset([0], [drawn])
        told = processed.results.tobytes() if resumes and processed is not None else None
        self.continues = answer.results.tobytes() == told
        if not self.continues:
            self._path, self._n_missed = None, 0
        return answer

    def _form(self) -> str:
        return f"{type(self).__name__} with {self._observations.form}"

    def _memory(self) -> dict[str, Any]:
        return {
            "generator": (self.np_random, self._np_random_seed),
            "path": self._path,
            "observations": self._observations.memory(),
        }

    def _restore(self, answer: StepAnswer, memory: dict[str, Any]) -> None:
        self._answer, self._path = answer, memory["path"]
        self._np_random, self._np_random_seed = memory["generator"]
        self._truth = self._session.truth(answer)[0] if self._reveals else None
        self._begin_path(answer)
        self._observations.restore(memory["observations"])

    def _begin_path(self, answer: StepAnswer) -> None:
        """Begins the paths of environments of moves."""

    def _update(self, observations: Observations, answer: StepAnswer) -> None:
        """Updates the observations with one empty frame per missed step, then with `answer`."""
        if self._robot is not None:
            stayed = int(answer.robots["n_moves"][0]) == 0
            self._n_missed = self._session.n_skipped + stayed
        for _ in range(self._session.n_skipped):
            observations.update(ONE_ROW, np.full_like(answer.frames, UNOBSERVED))
        observations.update(ONE_ROW, answer.frames)

    def _teams(self, observations: Observations, answer: StepAnswer) -> StepAnswer | None:
        """Returns the team's results and frame; None if no observation part needs them."""
        is_needed = self._robot is not None and observations.shows_team
        return self._session.teams(answer) if is_needed else None

    def _trace(self, answer: StepAnswer, path: NDArray[np.uint8]) -> None:
        """Stores the cells of a path that was flown, for pictures."""
        robot = answer.result().robot
        self._path = fly(robot.start, path[: robot.n_moves], self._spec)

    def _describe(self, answer: StepAnswer, step: int, n_visited: int) -> dict[str, Any]:
        """Returns the info of a step, never with the seed, which reveals the hidden states."""
        info: dict[str, Any] = {"step": step, "n_visited": n_visited}
        if self._robot is not None:
            info["n_missed"] = self._n_missed
        if self._reveals:
            world, robot = answer.result()
            info |= {"n_target_cells": world.n_target_cells, "n_hits": robot.n_hits}
            self._truth = truth = self._session.truth(answer)[0]
            info["truth"] = truth.copy()
        return info

    def _draw(self) -> Any:
        if self._answer is None:
            return None
        cells, paths = [self._cell()], [] if self._path is None else [self._path]
        return self._view.draw(self._answer.frames[0], cells, paths, self._truth)

    def _cell(self) -> tuple[int, int]:
        """Returns the cell at which the robot is drawn."""
        assert self._answer is not None
        return self._answer.result().robot.cell


def check_reward(reward: str, *more: str) -> int:
    """Returns the index of a reward in `REWARDS`, or for a reward in `more`, of `"share"`."""
    if reward not in (*REWARDS, *more):
        expected = ", ".join(map(repr, (*REWARDS, *more)))
        raise invalid("reward", f"one of {expected}", repr_of(reward))
    return REWARDS.index(reward) if reward in REWARDS else 0


def as_options(options: object) -> dict[str, Any]:
    """Checks that the options of a reset are a dictionary, or None for no options."""
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise invalid("options", "a dictionary such as {'resume': True}, or None", repr_of(options))
    return dict(cast("Mapping[str, Any]", options))


def wants_to_resume(options: dict[str, Any] | None, seed: object) -> bool:
    """Returns whether a reset continues the current episode, from the option `resume`."""
    for key in as_options(options):
        if key != "resume":
            raise invalid("options", "'resume'", repr_of(key))
    resume = as_options(options).get("resume", False)
    if not isinstance(resume, bool):
        raise invalid("options", "resume True or False", repr_of(resume))
    if resume and seed is not None:
        raise InvalidArgumentError(
            "options: resume=True continues an episode, so it cannot be combined with a seed"
        )
    return resume
