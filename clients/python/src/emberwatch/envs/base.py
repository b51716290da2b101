"""What the environments of one robot share: its session, its pictures, its beginning."""

from collections.abc import Mapping
from typing import Any, ClassVar, Final, Literal, TypeAlias, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from emberwatch.client.wire import UNOBSERVED, StepAnswer
from emberwatch.common.arguments import as_seed, told
from emberwatch.envs.observations import Observations
from emberwatch.envs.owner import SessionOwner
from emberwatch.envs.session import Session
from emberwatch.envs.settings import draw_seed
from emberwatch.envs.view import RENDER_FPS, RENDER_MODES, View
from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.model.moves import fly

NOTHING_TO_DRAW: Final = (
    "render: nothing to draw; give a render_mode to gymnasium.make and reset first"
)

#: Rewards of a robot's step, in the order of the native module's `pays`.
REWARDS: Final = ("share", "team", "marginal")
Reward: TypeAlias = Literal["share", "team", "marginal"]

#: What moves in an environment of one robot.
ONE_ROW: Final = np.ones(1, np.bool_)


class WorldEnv(SessionOwner, gymnasium.Env[Any, Any]):  # pyright: ignore[reportIncompatibleVariableOverride]
    """One robot, in a world of its own or of a running server."""

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
        #: Which robot of a world that others fly in; None: it is alone in its world.
        self._robot: Final = session.settings.robot
        self._n_missed = 0
        self._answer: StepAnswer | None = None
        self._truth: NDArray[np.uint8] | None = None
        self._path: NDArray[np.intp] | None = None

    def render(self) -> Any:
        """Draws the last frame, path and robot, next to the truth if it is revealed."""
        if self.render_mode is None or not self.is_open:
            gymnasium.logger.warn(NOTHING_TO_DRAW)
            return None
        return None if self.render_mode == "human" else self._draw()

    def close(self) -> None:
        self._session.close()
        self._view.close()
        self._answer = None  # which cannot be copied

    def _begin(self, seed: int | None, options: dict[str, Any] | None) -> StepAnswer:
        """Begins an episode, or continues the world's present one."""
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
        self._path, self._n_missed = None, 0
        return answer

    def _update(self, observations: Observations, answer: StepAnswer) -> None:
        """Updates the observations with a step, first with an empty frame for each missed step."""
        if self._robot is not None:
            stayed = int(answer.robots["n_moves"][0]) == 0
            self._n_missed = self._session.n_skipped + stayed
        for _ in range(self._session.n_skipped):
            observations.update(ONE_ROW, np.full_like(answer.frames, UNOBSERVED))
        observations.update(ONE_ROW, answer.frames)

    def _teams(self, observations: Observations, answer: StepAnswer) -> StepAnswer | None:
        """What is seen of teammates that others fly."""
        is_needed = self._robot is not None and observations.shows_team
        return self._session.teams(answer) if is_needed else None

    def _trace(self, answer: StepAnswer, path: NDArray[np.uint8]) -> None:
        """Keeps the cells of a path for pictures, if it was flown."""
        robot = answer.result().robot
        self._path = fly(robot.start, path[: robot.n_moves], self._spec)

    def _describe(self, answer: StepAnswer, step: int, n_visited: int) -> dict[str, Any]:
        """The info of a step: never the seed, which gives the hidden states away."""
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
        """Where the robot is drawn."""
        assert self._answer is not None
        return self._answer.result().robot.cell


def check_reward(reward: str, *more: str) -> int:
    """The index of a reward in `REWARDS`; `more` rewards have the share's."""
    if reward not in (*REWARDS, *more):
        expected = ", ".join(map(repr, (*REWARDS, *more)))
        raise invalid("reward", f"one of {expected}", repr(reward))
    return REWARDS.index(reward) if reward in REWARDS else 0


def as_options(options: object) -> dict[str, Any]:
    """The options of a reset, checked to be a dictionary; None: none."""
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise invalid("options", "a dictionary such as {'resume': True}, or None", told(options))
    return dict(cast("Mapping[str, Any]", options))


def wants_to_resume(options: dict[str, Any] | None, seed: object) -> bool:
    """Reads the options of a reset."""
    for key in as_options(options):
        if key != "resume":
            raise invalid("options", "'resume'", told(key))
    resume = as_options(options).get("resume", False)
    if not isinstance(resume, bool):
        raise invalid("options", "resume True or False", told(resume))
    if resume and seed is not None:
        raise InvalidArgumentError(
            "options: expected no seed with resume=True, which begins no episode"
        )
    return resume
