"""`gymnasium.make_vec("emberwatch/Wildfire-v0")`: one message steps all worlds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Unpack

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from emberwatch.arguments import as_moves, as_seed
from emberwatch.base import NOTHING_TO_DRAW, REPORTED, WorldEnv, wants_to_resume
from emberwatch.errors import InvalidArgumentError
from emberwatch.observations import Observations, Parts
from emberwatch.session import Session, SessionOwner
from emberwatch.settings import Settings, WorldArguments, draw_seed
from emberwatch.view import View, fly
from emberwatch.wire import RESULT_DTYPE, StepAnswer


class WildfireVectorEnv(SessionOwner, VectorEnv[Any, NDArray[np.integer[Any]], NDArray[Any]]):
    """Many worlds of `WildfireEnv`, stepped together.

    Observations, rewards, ends and infos are those of Gymnasium's `SyncVectorEnv` over the single
    environment with the same seeds, field by field, in all three autoreset modes; world i of
    `reset(seed=s)` has seed s + i. `options={"reset_mask": mask}` resets some of the worlds.

    Arguments are those of `WildfireEnv`, and:

    * `num_envs`: number of worlds.
    * `max_episode_steps`: truncate after so many steps; None or -1: never.
    * `autoreset_mode`: a `gymnasium.vector.AutoresetMode`; `NEXT_STEP` by default.
    * `world`: the first world; the others follow.
    * `render_mode`: `"human"` shows the first world only.
    """

    def __init__(
        self,
        *,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        observation: Parts = ("frame", "robot"),
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class. No server of its own runs before the first reset."""
        self.closed = True  # until it is made: Gymnasium 1.2 closes what failed to be made, too
        if max_episode_steps == -1:  # no limit in Gymnasium's own `make`
            max_episode_steps = None
        if max_episode_steps is not None and max_episode_steps < 1:
            raise InvalidArgumentError(
                f"max_episode_steps: expected at least 1 or None, got {max_episode_steps}"
            )
        self._mode = AutoresetMode(autoreset_mode)
        settings = Settings.of(WildfireVectorEnv, world)
        self._session = Session(settings, num_envs)
        self._spec = spec = self._session.spec
        self._observations = Observations(observation, spec, num_envs)
        self._views = [View(settings.render_mode, spec) for _ in range(num_envs)]
        self._max_steps = max_episode_steps
        self.metadata = {**WorldEnv.metadata, "autoreset_mode": self._mode}
        self.num_envs = num_envs
        self.render_mode = settings.render_mode
        self.single_observation_space = self._observations.space
        self.observation_space = batch_space(self._observations.space, num_envs)
        self.single_action_space = spaces.MultiDiscrete([4] * spec.n_moves)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators: list[np.random.Generator | None] = [None] * num_envs
        self._frames = np.zeros((num_envs, spec.height, spec.width), np.uint8)
        self._results = np.zeros(num_envs, RESULT_DTYPE)
        self._elapsed = np.zeros(num_envs, np.int64)
        self._over = np.zeros(num_envs, np.bool_)
        self._truths: NDArray[np.uint8] | None = None
        self._paths: list[NDArray[np.intp] | None] = [None] * num_envs
        self.closed = False

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begins episodes in all worlds, or in those of `options["reset_mask"]`.

        Args:
            seed: For world 0, the others follow; or one per world; None: each world's own
                generator goes on.
            options: `reset_mask`, `(num_envs,)` booleans, at least one true; or `resume`, see
                `WildfireEnv`.
        """
        rest = dict(options or {})
        mask = self._check_mask(rest.pop("reset_mask", None))
        seeds = self._check_seeds(seed)
        resumes = wants_to_resume(rest, seed)
        if not mask.all() and not self._session.is_open:
            raise gymnasium.error.ResetNeeded("reset_mask: expected a reset of all worlds before")
        self.closed = False
        chosen = np.flatnonzero(mask).tolist()
        if resumes:
            self._take(self._session.resume())
            self._reset_episodes(chosen)
        else:
            self._restart(chosen, seeds)
        return self._seen(), self._infos(mask)

    def step(
        self, actions: NDArray[np.integer[Any]]
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Flies one path in each world.

        Raises:
            gymnasium.error.ResetNeeded: In mode `DISABLED`, if an episode is over.
            EmberwatchError: As `WildfireEnv.step`.
        """
        moves = as_moves(actions, self.num_envs, self._spec.n_moves)
        moves = moves.reshape(self.num_envs, -1)
        over = self._over
        if not over.any():
            self._fly(moves, range(self.num_envs))
        elif self._mode is AutoresetMode.NEXT_STEP:
            for run in _runs(~over):
                self._fly(moves, run)
            self._restart(np.flatnonzero(over).tolist(), [None] * self.num_envs)
        else:
            raise gymnasium.error.ResetNeeded(
                f"worlds {np.flatnonzero(over).tolist()}: the episode is over; reset with "
                "options={'reset_mask': ...}"
            )
        flown = ~over if over.any() else np.ones(self.num_envs, np.bool_)
        return self._outcome(flown)

    def render(self) -> tuple[Any, ...] | None:
        """The picture of each world, as `WildfireEnv.render` draws it."""
        if self.render_mode is None or not self._session.is_open:
            gymnasium.logger.warn(NOTHING_TO_DRAW)
            return None
        if self.render_mode == "human":
            return (None,) * self.num_envs
        return tuple(self._draw(index) for index in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        self._session.close()
        for view in self._views:
            view.close()

    def _fly(self, moves: NDArray[np.uint8], run: range) -> None:
        """Steps consecutive worlds."""
        before = self._results
        answer = self._session.step(moves[run.start : run.stop], run)
        if len(run) == self.num_envs:  # else the reset of the others brings all results again
            self._take(answer)
        self._observations.update(answer, run.start)
        self._elapsed[run.start : run.stop] += 1
        if self.render_mode is not None:
            for index in run:
                start = (int(before["row"][index]), int(before["col"][index]))
                self._paths[index] = fly(start, moves[index], self._spec)

    def _restart(self, indices: list[int], seeds: Sequence[int | None]) -> None:
        """Begins episodes in some worlds."""
        chosen: list[int] = []
        for index in indices:
            seed, generator = seeds[index], self._generators[index]
            if seed is not None or generator is None:
                generator, _ = seeding.np_random(seed)
                self._generators[index] = generator
            chosen.append(draw_seed(generator) if seed is None else seed)
        self._take(self._session.reset(indices, chosen))
        self._reset_episodes(indices)

    def _reset_episodes(self, chosen: list[int]) -> None:
        self._elapsed[chosen] = 0
        self._over = self._over.copy()
        self._over[chosen] = False
        self._observations.reset(chosen, self._frames)
        for index in chosen:
            self._paths[index] = None

    def _take(self, answer: StepAnswer) -> None:
        self._frames, self._results = answer.frames, answer.results
        if self._session.settings.truth:
            self._truths = self._session.truth(answer)

    def _outcome(
        self, flown: NDArray[np.bool_]
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """What `step` returns; worlds that began an episode in this step earned nothing."""
        rewards = np.where(flown, self._results["reward"], 0.0)
        terminations = flown & (self._results["terminated"] != 0)
        truncations = flown & (self._results["truncated"] != 0)
        if self._max_steps is not None:
            truncations |= flown & (self._elapsed >= self._max_steps)
        over = terminations | truncations
        infos: dict[str, Any] = {}
        if self._mode is AutoresetMode.SAME_STEP and over.any():
            infos = self._final(over)
            self._restart(np.flatnonzero(over).tolist(), [None] * self.num_envs)
        else:
            self._over = over
        infos |= self._infos(np.ones(self.num_envs, np.bool_))
        return self._seen(), rewards, terminations, truncations, infos

    def _final(self, over: NDArray[np.bool_]) -> dict[str, Any]:
        """The last observations and infos of episodes that end in this step."""
        observations = np.full(self.num_envs, None, dtype=object)
        for index in np.flatnonzero(over):
            row, col = int(self._results["row"][index]), int(self._results["col"][index])
            frame = self._frames[index].copy()
            observations[index] = self._observations.one(frame, row, col, int(index))
        return {
            "final_obs": observations,
            "_final_obs": over.copy(),
            "final_info": self._infos(over),
            "_final_info": over.copy(),
        }

    def _infos(self, mask: NDArray[np.bool_]) -> dict[str, Any]:
        """The infos of some worlds, zero for the others, as Gymnasium stacks them."""
        infos: dict[str, Any] = {}
        for name in REPORTED:
            infos[name] = np.where(mask, self._results[name], 0).astype(np.int64)
            infos[f"_{name}"] = mask.copy()
        if self._truths is not None:
            infos["truth"] = np.where(mask[:, np.newaxis, np.newaxis], self._truths, np.uint8(0))
            infos["_truth"] = mask.copy()
        return infos

    def _seen(self) -> Any:
        robots = np.stack((self._results["row"], self._results["col"]), axis=1).astype(np.int64)
        if self.render_mode == "human":
            self._draw(0)
        # The learner may write to its frames: pictures come from others.
        frames = self._frames if self.render_mode is None else self._frames.copy()
        return self._observations.all(frames, robots)

    def _draw(self, index: int) -> Any:
        robot = (int(self._results["row"][index]), int(self._results["col"][index]))
        truth = None if self._truths is None else self._truths[index]
        return self._views[index].draw(self._frames[index], robot, self._paths[index], truth)

    def _check_seeds(self, seed: int | Sequence[int | None] | None) -> Sequence[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            return [int(seed) + index for index in range(self.num_envs)]
        if not hasattr(seed, "__len__") or len(seed) != self.num_envs:
            raise InvalidArgumentError(
                f"seed: expected an integer, None or {self.num_envs} of them, got {seed!r}"
            )
        # Checked before any world's generator is replaced.
        return [None if one is None else as_seed(one) for one in seed]

    def _check_mask(self, mask: Any) -> NDArray[np.bool_]:
        shape = (self.num_envs,)
        if mask is None:
            return np.ones(shape, np.bool_)
        got = f"{mask.dtype} {mask.shape}" if hasattr(mask, "dtype") else repr(mask.__class__)
        if got != f"bool {shape}" or not mask.any():
            raise InvalidArgumentError(
                f"reset_mask: expected an array {shape} of bool with at least one True, got {got}"
            )
        return mask


def _runs(mask: NDArray[np.bool_]) -> list[range]:
    """The runs of consecutive true entries."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False]))))
    return [range(start, stop) for start, stop in edges.reshape(-1, 2).tolist()]
