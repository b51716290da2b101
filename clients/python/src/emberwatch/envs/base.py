"""The base class of the environments of one robot, and checks that several environments share."""

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Final, Literal, TypeAlias, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from emberwatch.client.wire import UNOBSERVED, StepAnswer
from emberwatch.common.arguments import as_seed
from emberwatch.envs.observations import Observations
from emberwatch.envs.owner import METADATA, SessionOwner
from emberwatch.envs.plans import Plans
from emberwatch.envs.session import Session, not_reset
from emberwatch.envs.settings import draw_seed
from emberwatch.errors import InvalidArgumentError, invalid, repr_of

#: Kinds of reward, in the order of the native module's `pays`.
REWARDS: Final = ("share", "team", "marginal")
Reward: TypeAlias = Literal["share", "team", "marginal"]

#: The mask that selects the only row of an environment of one robot.
ONE_ROW: Final = np.ones(1, np.bool_)


class WorldEnv(SessionOwner, gymnasium.Env[Any, Any]):  # pyright: ignore[reportIncompatibleVariableOverride]
    """An environment of one robot, in its own world or in a world of a running server."""

    metadata: ClassVar[dict[str, Any]] = METADATA  # pyright: ignore[reportIncompatibleVariableOverride]
    _KEPT = ("_np_random", "_np_random_seed", "_paths")

    def __init__(
        self,
        session: Session,
        observations: Observations | Plans,
        action_space: spaces.Space[Any],
        *,
        pays: int,
    ) -> None:
        self._attach(session, observations, pays)
        self.observation_space = observations.space
        self.action_space = action_space
        #: The robot's index in a world that other clients fly in; None: it is alone in its world.
        self._robot: Final = session.settings.robot
        #: Whether observations contain the robot's teammates, whom another client may fly.
        self._needs_teams = self._robot is not None and observations.shows_team
        self._n_missed = 0
        #: Whether the last reset continued the episode where this environment left it.
        self.continues = False
        self._answer: StepAnswer | None = None
        self._teams: StepAnswer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode, or joins the current one.

        See `WildfireEnv`, *Starting State* and *One Robot of a Team*.
        """
        with self._session.turn:
            self._answer = answer = self._begin(seed, options)
            if not self.continues:
                self._observations.start_episodes(ONE_ROW, answer.results, answer.frames)
                self._take(answer)
            else:  # learners may have written to the arrays
                self._frames, self._numbers = answer.frames, answer.numbers(self._pays)
            seen = self._seen()
            self._session.finish()
        return seen

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Flies a path of T moves.

        Raises:
            InvalidArgumentError: If the action is not in the action space. Nothing is sent.
            LeaseLostError: If another client took over the world.
            ServerGoneError: If the server has ended. The next reset attaches to a new server of
                the same instance.
            RequestTimeoutError: If the server does not answer. The world may have moved: reset or
                resume.
            EmberwatchError: With code `"interrupted"` if an earlier step or reset did not finish,
                for example after Ctrl-C: reset or resume. Nothing is sent.
        """
        session = self._session
        with session.turn:
            session.begin_step()
            outcome = self._fly(action)
            session.finish()
        return outcome

    def render(self) -> Any:
        """Draws the last frame, path and robot; next to them the hidden states, if revealed."""
        if not self.can_draw() or self._answer is None or self.render_mode == "human":
            return None
        return self.draw(slice(0, 1))

    def close(self) -> None:
        self._close()
        self._answer = self._teams = None  # answers cannot be copied or pickled

    def past_frames(self) -> Iterator[NDArray[np.uint8]]:
        """Yields the robot's earlier frames of the episode, `(H, W)`; warns if some are missing."""
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
            self._paths[0], self._n_missed = None, 0
        return answer

    def _restore(self, answer: StepAnswer) -> None:
        self._take(answer)

    def _fly(self, path: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        answer = self._session.step(path)
        if self._robot is not None:
            self._n_missed = self._session.n_skipped + (int(answer.robots["n_moves"][0]) == 0)
        if self._observations.has_memory:
            for _ in range(self._session.n_skipped):
                unseen = np.full_like(answer.frames, UNOBSERVED)
                self._observations.update(ONE_ROW, answer.results, unseen)
            self._observations.update(ONE_ROW, answer.results, answer.frames)
        if self.render_mode is not None:
            self._keep_paths(ONE_ROW, answer.results, path)
        self._take(answer)
        reward, terminated, truncated, *_ = self._numbers
        observation, info = self._seen()
        return observation, reward, terminated, truncated, info

    def _take(self, answer: StepAnswer) -> None:
        self._answer, self._frames = answer, answer.frames
        self._numbers = answer.numbers(self._pays)
        if self._reads_truth:
            self._truths = self._session.truth(answer)
        if self._needs_teams:
            self._teams = self._session.teams(answer)

    def _seen(self) -> tuple[Any, dict[str, Any]]:
        frames, info = self._frames, self._info()
        if self.render_mode is not None:
            frames = frames.copy()  # the learner may write to it, and pictures show the original
            if self.render_mode == "human":
                self.draw(slice(0, 1))
        return self._observations.one(frames, self._numbers[5], self._teams), info

    def _info(self) -> dict[str, Any]:
        """Returns the info of a step, never with the seed, which reveals the hidden states."""
        _, _, _, step, n_visited, _ = self._numbers
        info: dict[str, Any] = {"step": step, "n_visited": n_visited}
        if self._robot is not None:
            info["n_missed"] = self._n_missed
        if self._reveals:
            assert self._answer is not None and self._truths is not None
            world, robot = self._answer.result()
            info |= {"n_target_cells": world.n_target_cells, "n_hits": robot.n_hits}
            info["truth"] = self._truths[0].copy()
        return info

    def _robots(self) -> NDArray[np.int64]:
        assert self._answer is not None
        return self._answer.numbers(self._pays)[5]


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
    given = as_options(options)
    resume = given.pop("resume", False)
    if given:
        raise invalid("options", "'resume'", repr_of(next(iter(given))))
    if not isinstance(resume, bool):
        raise invalid("options", "resume True or False", repr_of(resume))
    if resume and seed is not None:
        raise InvalidArgumentError(
            "options: resume=True continues an episode, so it cannot be combined with a seed"
        )
    return resume
