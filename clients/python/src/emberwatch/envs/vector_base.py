"""The base class of the vector environments: episodes, their ends, infos and pictures.

Rows are robots: all robots of the first world, then those of the next world, and so on. The robots
of a world begin and end their episodes together.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from emberwatch._native import columns
from emberwatch.client.wire import RESULT_DTYPE, StepAnswer
from emberwatch.common.arguments import as_array, as_integer, as_moves, as_seed
from emberwatch.envs.base import as_options, wants_to_resume
from emberwatch.envs.observations import Observations, of_row
from emberwatch.envs.owner import METADATA, SessionOwner
from emberwatch.envs.plans import Plans
from emberwatch.envs.session import Session
from emberwatch.envs.settings import draw_seed
from emberwatch.errors import invalid, repr_of


class Columns(NamedTuple):
    """The results of all rows as columns, `(n_rows,)` each."""

    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    steps: NDArray[np.int64]
    n_visited: NDArray[np.int64]
    #: Row and column of each robot, `(n_rows, 2)`.
    cells: NDArray[np.int64]
    #: Whether any episode is over.
    is_over: bool


class WorldVectorEnv(  # pyright: ignore[reportIncompatibleVariableOverride]
    SessionOwner, VectorEnv[Any, NDArray[np.integer[Any]], NDArray[Any]]
):
    """A vector environment of many robots, stepped together."""

    _KEPT = ("_elapsed", "_over", "_has_ended", "_generators", "_paths")

    # True until `__init__` ends, because Gymnasium 1.2 also closes an object whose `__init__`
    # failed.
    closed = True

    def __init__(
        self,
        session: Session,
        observations: Observations | Plans,
        action_space: spaces.Space[Any],
        *,
        pays: int,
        max_episode_steps: int | None,
        autoreset_mode: AutoresetMode | str,
    ) -> None:
        if max_episode_steps == -1:  # means no limit in `gymnasium.make`
            max_episode_steps = None
        if max_episode_steps is not None:
            given, max_episode_steps = max_episode_steps, as_integer(max_episode_steps)
            if max_episode_steps is None or max_episode_steps < 1:
                raise invalid("max_episode_steps", "at least 1 or None", repr_of(given))
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self._attach(session, observations, pays)
        #: Number of steps after which episodes are truncated; None: never.
        self.max_episode_steps = max_episode_steps
        self.metadata = {**METADATA, "autoreset_mode": self.autoreset_mode}
        self.num_envs = num_envs = session.n_rows
        self.single_observation_space = observations.space
        self.observation_space = batch_space(observations.space, num_envs)
        self.single_action_space = action_space
        self.action_space = batch_space(action_space, num_envs)
        #: The generator of each world's seeds, with its own seed; None before the first reset.
        self._generators: list[tuple[np.random.Generator, int] | None] = [None] * session.n_worlds
        self._frames = np.zeros((num_envs, self._spec.height, self._spec.width), np.uint8)
        self._results = np.zeros(num_envs, RESULT_DTYPE)
        self._columns = self._columns_of(self._results)
        self._every = np.ones(num_envs, np.bool_)
        self._none = np.zeros(num_envs, np.bool_)
        self._elapsed = np.zeros(num_envs, np.int64)
        self._over, self._has_ended = self._none, False
        #: Mask of the robots that completed a path in the current step; None if no robot did.
        self._exchanged: NDArray[np.bool_] | None = None
        self.closed = False

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begins episodes in all worlds, or in the worlds of `options["reset_mask"]`.

        Args:
            seed: The seed s of the first world; world i gets s + i. Or a sequence with one seed for
                each row; a world uses the seed of its first row. None: each world's own
                generator draws a seed.
            options: `reset_mask`, `(num_envs,)` booleans, at least one true, the same for all
                robots of a world; or `resume`, see `WildfireEnv`.
        """
        rest = as_options(options)
        mask = self._check_mask(rest.pop("reset_mask", None))
        seeds = self._check_seeds(seed)
        resumes = wants_to_resume(rest, seed)
        with self._session.turn:
            was_ready = self.is_open and not self._session.is_unfinished
            if not mask.all() and not was_ready:
                raise gymnasium.error.ResetNeeded(
                    "reset_mask: expected all worlds in the first reset, or after a step or reset "
                    "that did not finish, got some"
                )
            self.closed = False
            self._session.begin_reset()
            chosen = np.flatnonzero(mask).tolist()
            if resumes:
                processed = self._results.view(np.uint8).reshape(self.num_envs, -1)
                self._take(self._session.resume())
                told = self._results.view(np.uint8).reshape(self.num_envs, -1)
                moved = (processed != told).any(axis=1) if was_ready else self._every
                self._reset_episodes(chosen, moved)
            else:
                self._restart(chosen, seeds)
            outcome = self._seen(), self._infos(mask)
            self._session.finish()
        return outcome

    def step(
        self, actions: NDArray[np.integer[Any]]
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Steps all robots.

        Raises:
            gymnasium.error.ResetNeeded: In mode `DISABLED`, if an episode is over.
            EmberwatchError: As in `WildfireEnv.step`.
        """
        chosen = self._check_actions(actions)
        with self._session.turn:
            over, has_ended = self._over, self._has_ended
            if has_ended and self.autoreset_mode is not AutoresetMode.NEXT_STEP:
                raise gymnasium.error.ResetNeeded(
                    f"rows {np.flatnonzero(over).tolist()}: the episode is over; reset with "
                    "options={'reset_mask': ...}"
                )
            self._session.begin_step()
            flown = ~over if has_ended else self._every
            self._exchanged = None
            rewards = self._step_worlds(chosen, flown)
            self._elapsed += flown
            if has_ended:
                rewards = np.where(flown, rewards, 0.0)
                self._restart(np.flatnonzero(over).tolist(), [None] * self._session.n_worlds)
            outcome = self._outcome(flown, rewards)
            self._session.finish()
        return outcome

    def render(self) -> tuple[Any, ...] | None:
        """Returns a picture for each robot, as `WildfireEnv.render` draws it."""
        if not self.can_draw():
            return None
        if self.render_mode == "human":
            return (None,) * self.num_envs
        return tuple(self.draw(slice(row, row + 1)) for row in range(self.num_envs))

    @property
    def results(self) -> NDArray[np.void]:
        """The last result of each robot and its world, `(num_envs,)` of `wire.RESULT_DTYPE`."""
        return self._results.copy()

    @property
    def truths(self) -> NDArray[np.uint8] | None:
        """The hidden states of each robot's world, `(num_envs, H, W)`. Do not write to them."""
        return self._truths

    def close_extras(self, **kwargs: Any) -> None:
        self._close()

    def _check_actions(self, actions: NDArray[np.integer[Any]]) -> NDArray[Any]:
        # If all robots fly, the session checks their paths.
        if not self._has_ended:
            return actions
        return as_moves(actions, self.num_envs, self._spec.n_moves)

    def _step_worlds(self, actions: NDArray[Any], flown: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Steps the rows `flown`, and returns rewards; the values of other rows are ignored."""
        self._exchange(actions, flown)
        return self._columns.rewards

    def _begin(self, begun: NDArray[np.bool_]) -> None:
        """Is called after episodes in the rows `begun` have begun or have been resumed."""

    def _robots(self) -> NDArray[np.int64]:
        return self._columns.cells.copy()

    def _form(self) -> str:
        mode, steps = self.autoreset_mode.value, self.max_episode_steps
        return f"{super()._form()}, max_episode_steps={steps}, autoreset_mode={mode}"

    def _restore(self, answer: StepAnswer) -> None:
        self._take(answer)
        self._begin(self._every)

    def _exchange(self, paths: NDArray[Any], moved: NDArray[np.bool_]) -> None:
        """Flies complete paths in the rows `moved`, with one message for each run of rows."""
        if moved is self._every or moved.all():
            self._take(self._session.step(paths))
        elif moved.any():
            self._frames = self._frames.copy()  # the learner holds the previous array
            for run in _runs(moved):
                rows = slice(run.start, run.stop)
                answer = self._session.step(paths[rows], run)
                self._frames[rows], self._results[rows] = answer.frames, answer.results
                if self._truths is not None:
                    self._truths[rows] = self._session.truth(answer)
            self._columns = self._columns_of(self._results)
        self._exchanged = moved
        if self._observations.has_memory:
            self._observations.update(moved, self._results, self._frames)
        if self.render_mode is not None:
            self._keep_paths(moved, self._results, paths)

    def _restart(self, rows: list[int], seeds: Sequence[int | None]) -> None:
        """Begins episodes in the worlds of some rows; `seeds` has an entry for every world."""
        n_robots = self._spec.n_robots
        worlds, chosen = [row // n_robots for row in rows[::n_robots]], list[int]()
        for world in worlds:
            seed = seeds[world]
            generator, _ = self._generator(world, seed)
            chosen.append(draw_seed(generator) if seed is None else seed)
        self._take(self._session.reset(worlds, chosen))
        self._reset_episodes(rows, self._every)

    def _generator(self, world: int, seed: int | None) -> tuple[np.random.Generator, int]:
        """Returns the generator of a world's seeds; begins it anew with a seed."""
        generator = self._generators[world]
        if seed is not None or generator is None:
            generator = self._generators[world] = seeding.np_random(seed)
        return generator

    @property
    def np_random_seed(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
    ) -> tuple[int, ...]:
        """The seed of each row's world in its last reset with a seed, as from `SyncVectorEnv`."""
        worlds = np.arange(self.num_envs) // self._spec.n_robots
        return tuple(self._generator(world, None)[1] for world in worlds.tolist())

    def _reset_episodes(self, rows: list[int], moved: NDArray[np.bool_]) -> None:
        # In rows that have not moved since the last step, the robots' paths and memory continue.
        self._elapsed[rows] = 0
        self._over = self._over.copy()
        self._over[rows] = False
        self._has_ended = bool(self._over.any())
        begun = np.zeros(self.num_envs, np.bool_)
        begun[rows] = True
        begun &= moved
        self._observations.start_episodes(begun, self._results, self._frames)
        self._begin(begun)
        for row in np.flatnonzero(begun).tolist():
            self._paths[row] = None

    def _take(self, answer: StepAnswer) -> None:
        self._frames, self._results = answer.frames, answer.results
        self._columns = self._columns_of(self._results)
        if self._reads_truth:
            self._truths = self._session.truth(answer)

    def _columns_of(self, results: NDArray[np.void]) -> Columns:
        return Columns(*columns(results.view(np.uint8), self._pays))

    def _outcome(
        self, flown: NDArray[np.bool_], rewards: NDArray[np.float64]
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Returns the outcome of a step, after resets in mode `SAME_STEP`."""
        terminations, truncations = self._none.copy(), self._none.copy()
        if self._exchanged is not None and self._columns.is_over:
            terminations |= self._exchanged & self._columns.terminated
            truncations |= self._exchanged & self._columns.truncated
        if self.max_episode_steps is not None:
            truncations |= flown & (self._elapsed >= self.max_episode_steps)
        over = terminations | truncations
        has_ended = np.count_nonzero(over) > 0
        infos: dict[str, Any] = {}
        if has_ended and self.autoreset_mode is AutoresetMode.SAME_STEP:
            infos = self._final(over)
            self._restart(np.flatnonzero(over).tolist(), [None] * self._session.n_worlds)
        else:
            self._over, self._has_ended = over, has_ended
        infos |= self._infos(self._every)
        return self._seen(), rewards, terminations, truncations, infos

    def _final(self, over: NDArray[np.bool_]) -> dict[str, Any]:
        """Returns the last observations and infos of the episodes that end in this step."""
        observations = np.full(self.num_envs, None, dtype=object)
        seen = self._observations.all(self._frames.copy(), self._robots())
        for index in np.flatnonzero(over).tolist():
            observations[index] = of_row(seen, index)
        return {
            "final_obs": observations,
            "_final_obs": over.copy(),
            "final_info": self._infos(over),
            "_final_info": over.copy(),
        }

    def _infos(self, mask: NDArray[np.bool_]) -> dict[str, Any]:
        """Returns the infos of the rows in `mask`, stacked as in Gymnasium; other rows are 0."""
        infos: dict[str, Any] = {}
        for name, values in self._reported().items():
            if mask is self._every:
                infos[name] = values.copy()
            else:
                infos[name] = np.zeros_like(values)
                infos[name][mask] = values[mask]
            infos[f"_{name}"] = mask.copy()
        return infos

    def _reported(self) -> dict[str, NDArray[Any]]:
        """Returns the info of `WorldEnv` for all rows, by name."""
        reported: dict[str, NDArray[Any]] = {
            "step": self._columns.steps,
            "n_visited": self._columns.n_visited,
        }
        if self._reveals:
            world, robot = self._results["world"], self._results["robot"]
            reported["n_target_cells"] = world["n_target_cells"].astype(np.int64)
            reported["n_hits"] = robot["n_hits"].astype(np.int64)
            if self._truths is not None:
                reported["truth"] = self._truths
        return reported

    def _seen(self) -> Any:
        if self.render_mode == "human":
            self.draw(slice(0, self._spec.n_robots))
        return self._observations.all(self._shown(), self._robots())

    def _shown(self) -> NDArray[np.uint8]:
        # Pictures need the originals, to which learners may write.
        return self._frames if self.render_mode is None else self._frames.copy()

    def _check_seeds(self, seed: int | Sequence[int | None] | None) -> Sequence[int | None]:
        """Returns the seed of each world, after checking all before a generator is replaced."""
        n_worlds = self._session.n_worlds
        if seed is None:
            return [None] * n_worlds
        first = as_integer(seed)
        if first is not None:
            return [as_seed(first + world) for world in range(n_worlds)]
        if isinstance(seed, np.ndarray):
            seed = as_array(seed, "seed", "integers").tolist()
        if not isinstance(seed, Sequence) or len(seed) != self.num_envs:
            raise invalid("seed", f"an integer, None or {self.num_envs} of them", repr_of(seed))
        seeds = [None if one is None else as_seed(one) for one in seed]
        return seeds[:: self._spec.n_robots]

    def _check_mask(self, mask: Any) -> NDArray[np.bool_]:
        shape = (self.num_envs,)
        if mask is None:
            return np.ones(shape, np.bool_)
        got = f"{mask.dtype} {mask.shape}" if hasattr(mask, "dtype") else repr_of(mask.__class__)
        if got != f"bool {shape}" or np.ma.is_masked(mask) or not mask.any():
            expected = f"an array {shape} of bool with at least one True, none masked"
            raise invalid("reset_mask", expected, got)
        worlds = mask.reshape(-1, self._spec.n_robots)
        if (worlds.any(axis=1) != worlds.all(axis=1)).any():
            raise invalid("reset_mask", "the same value for all robots of a world", "a mixture")
        return mask


def info_of(infos: dict[str, Any], row: int) -> dict[str, Any]:
    """Returns the info of one row of stacked infos, with numbers as `int`, `float` and `bool`."""
    shown = {name: values[row] for name, values in infos.items() if not name.startswith("_")}
    return {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in shown.items()
    }


def _runs(mask: NDArray[np.bool_]) -> list[range]:
    """Returns the ranges of consecutive true entries."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False]))))
    return [range(start, stop) for start, stop in edges.reshape(-1, 2).tolist()]
