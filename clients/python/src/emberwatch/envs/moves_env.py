"""`emberwatch/WildfireMoves-v0`: one step flies one move; the world moves after T of them.

For one robot, or for many.
"""

from typing import Any, Literal, TypeAlias, Unpack

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emberwatch.client import wire
from emberwatch.client.wire import StepAnswer
from emberwatch.common.arguments import as_choice, as_choices
from emberwatch.envs.base import ONE_ROW, Reward, WorldEnv, check_reward
from emberwatch.envs.flights import flights_of
from emberwatch.envs.observations import WINDOW, MovesParts, Observations
from emberwatch.envs.session import Session, not_reset
from emberwatch.envs.settings import Settings, WorldArguments, shows_keywords
from emberwatch.envs.vector_base import WorldVectorEnv, vector_session
from emberwatch.model.moves import fly

MovesReward: TypeAlias = Literal[Reward, "move"]


class WildfireMovesEnv(WorldEnv):
    """The world of `WildfireEnv`, flown move by move.

    ## Description

    As `WildfireEnv`, but one step is one move of the robot. After T moves the path is complete:
    the world moves once, and the cells visited are observed and rewarded.

    ## Action Space

    `Discrete(4)`: 0 up, 1 down, 2 left, 3 right. A move off the grid or into a no-fly cell leaves
    the robot in place. The action mask, `(4,)` int8, has 1 for each move that does not, and only 1
    where all moves do. It is `info["action_mask"]`, `action_masks()`, which MaskablePPO of
    sb3-contrib calls, and on request a part of the observation:

        action = env.action_space.sample(info["action_mask"])

    ## Observation Space

    `observation` names the parts, as in `WildfireEnv`: `frame` and `image` (of the last complete
    path), `robot`, `age`, `belief`, and

    | part | space | meaning |
    |---|---|---|
    | `visited` | `Box(0, 255, (H, W, 1), uint8)` | 255 in the cells that this path has visited |
    | `move` | `Discrete(T)` | moves made of this path |
    | `local` | `Box(0, 255, (L, L, 5), uint8)` | the belief around the robot, L = `window` |
    | `recent` | `Box(0, 255, (L, L, O + 3), uint8)` | what frames alone told of the same cells |
    | `action_mask` | `Box(0, 1, (4,), int8)` | 1 for each move that leads to another cell |

    The channels of `local`, times 255: the probability of the state that pays most, and the entropy
    of the belief divided by log S, both 0 where this path has been (and what it has seen, where
    that pays); 1 where it has been; 1 off the grid and in no-fly cells; and the share of the path's
    moves that are left, everywhere alike. `recent` needs no model: its first channels are the value
    last observed in a cell, one of O channels, 1 if seen in the last frame and half of it for each
    16 steps since; the last three are the same.

    ## Rewards

    With `reward="share"` (the default), `"team"` or `"marginal"` the path's reward comes with its
    last move, and 0 before: what a cell pays is only decided when the world moves, after the
    flight. The three differ in worlds of several robots, as for `WildfireEnv`.

    With `reward="move"` each cell pays when it is first visited, what its hidden state pays before
    the world moves (or seen, where that pays); the last move also brings the difference to the
    robot's share of the path's true reward, which is small for a lone robot, as one step changes
    few cells. So both sum to the same over each path, but the second says more about the hidden
    state, and earlier: results with the two are not comparable. The environment needs the `truth`
    channel for it: with `instance`, the server must publish it.

    ## Episode End

    Never `terminated`. `truncated` after `max_episode_steps` moves (64,000, thus 1,000 paths of
    the default length, unless `gymnasium.make` is told otherwise), or after the running server's
    own `--max-steps`.

    ## Starting State, Information

    As `WildfireEnv`; the information is about the last complete path, except `action_mask`.

    ## Arguments

    As `WildfireEnv`; `observation` is `("frame", "visited", "robot", "move")` by default, `reward`
    may also be `"move"`, and `window` is an odd number of cells (15).

    ## Vectorized environment

    `gymnasium.make_vec("emberwatch/WildfireMoves-v0", num_envs=64)` is `WildfireMovesVectorEnv`.

    ## Version History

    * v0: the first.
    """

    @shows_keywords
    def __init__(
        self,
        *,
        observation: MovesParts = ("frame", "visited", "robot", "move"),
        reward: MovesReward = "share",
        window: int = WINDOW,
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class."""
        self._pays = check_reward(reward, "move")
        settings = Settings.of(WildfireMovesEnv, world, needs_truth=reward == "move")
        super().__init__(Session(settings))
        self._flights = flights = flights_of(self._spec, 1, pays=reward == "move")
        self._observations = Observations(
            observation, self._spec, 1, flights, window, first=self._robot or 0
        )
        self._seen_teams: StepAnswer | None = None
        self.observation_space = self._observations.space
        self.action_space = spaces.Discrete(wire.N_MOVES)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode; with `robot`, continues from where the shared world stands.

        See `WildfireEnv`, *Starting State* and *One Robot of a Team*.
        """
        with self._session.turn:
            answer = self._begin(seed, options)
            self._observations.reset(ONE_ROW, answer.frames)
            self._begin_path(answer)
            seen = self._seen(answer)
            self._session.finish()
        return seen

    def step(self, action: np.integer[Any] | int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Flies one move; the T-th completes the path and moves the world.

        Raises:
            EmberwatchError: As `WildfireEnv.step`.
        """
        move = np.array([as_choice(action, wire.N_MOVES)], np.uint8)
        with self._session.turn:
            self._session.begin_step()
            completes = self._flights.completes()[0]
            outcome = self._complete(move) if completes else self._move(move)
            self._session.finish()
        return outcome

    def action_masks(self) -> NDArray[np.int8]:
        """1 for each move that takes the robot to another cell, else 0; `(4,)` int8.

        All 1 in a cell that no move leads out of. As `info["action_mask"]`.
        """
        if not self.is_open:
            raise not_reset()
        return self._flights.masks[0]

    def _move(self, move: NDArray[np.uint8]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """A move that does not complete its path."""
        assert self._answer is not None
        reward = float(self._flights.move(ONE_ROW, move)[0])
        self._observations.visit(ONE_ROW)
        observation, info = self._seen(self._answer)
        return observation, reward, False, False, info

    def _complete(self, move: NDArray[np.uint8]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Flies the path after its last move, and moves the world."""
        path = self._flights.paths(move)
        answer = self._session.step(path)
        before = float(self._flights.paid[0])
        self._update(self._observations, answer)
        self._begin_path(answer)
        if self.render_mode is not None:
            self._trace(answer, path[0])
        observation, info = self._seen(answer)
        reward, terminated, truncated, *_ = answer.native.numbers(self._pays)
        return observation, reward - before, terminated, truncated, info

    def _begin_path(self, answer: StepAnswer) -> None:
        self._answer = answer
        _, _, _, self._step, self._n_visited, self._start = answer.native.numbers(self._pays)
        self._seen_teams = self._teams(self._observations, answer)
        states = self._session.truth(answer) if self._session.settings.truth else None
        self._flights.begin(ONE_ROW, self._start, states)

    def _seen(self, answer: StepAnswer) -> tuple[Any, dict[str, Any]]:
        info = self._describe(answer, self._step, self._n_visited)
        info["action_mask"] = self._flights.masks[0]
        if self.render_mode == "human":
            self._draw()
        # Copies: each move of a path returns the frame again.
        cells = self._flights.robots
        return self._observations.one(answer.frames.copy(), cells, self._seen_teams), info

    def _draw(self) -> Any:
        made, path = self._flights.made(0), self._path
        if len(made):
            row, col = self._start[0].tolist()
            self._path = fly((row, col), made, self._spec)
        picture = super()._draw()
        self._path = path
        return picture

    def _cell(self) -> tuple[int, int]:
        row, col = self._flights.robots[0].tolist()
        return row, col


class WildfireMovesVectorEnv(WorldVectorEnv):
    """Many robots of `WildfireMovesEnv`: one message steps all whose paths are complete.

    As `WildfireVectorEnv`; arguments are those of `WildfireMovesEnv`, and `num_envs`,
    `max_episode_steps` (moves), `autoreset_mode`.
    """

    @shows_keywords
    def __init__(
        self,
        *,
        num_envs: int | None = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        observation: MovesParts = ("frame", "visited", "robot", "move"),
        reward: MovesReward = "share",
        window: int = WINDOW,
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class."""
        pays = check_reward(reward, "move")
        settings = Settings.of(WildfireMovesVectorEnv, world, needs_truth=reward == "move")
        session = vector_session(settings, num_envs)
        n_rows = session.n_rows
        self._flights = flights = flights_of(session.spec, n_rows, pays=reward == "move")
        self._parts = Observations(observation, session.spec, n_rows, flights, window)
        super().__init__(
            session,
            self._parts,
            spaces.Discrete(wire.N_MOVES),
            pays=pays,
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
        )

    def action_masks(self) -> NDArray[np.int8]:
        """The masks of all robots, `(num_envs, 4)`; see `WildfireMovesEnv.action_masks`."""
        if not self.is_open:
            raise not_reset()
        return self._flights.masks

    def _check_actions(self, actions: NDArray[np.integer[Any]]) -> NDArray[np.uint8]:
        return as_choices(actions, self.num_envs, wire.N_MOVES)

    def _fly(self, actions: NDArray[np.uint8], flown: NDArray[np.bool_]) -> NDArray[np.float64]:
        completed = flown & self._flights.completes()
        if not completed.any():
            return self._move(actions, flown)
        self._exchange(self._flights.paths(actions), completed)
        rewards = self._columns.rewards - self._flights.paid
        others = flown & ~completed
        if others.any():
            rewards = np.where(others, self._move(actions, others), rewards)
        self._begin(completed)
        return rewards

    def _move(self, actions: NDArray[np.uint8], moved: NDArray[np.bool_]) -> NDArray[np.float64]:
        """One move that completes no path."""
        rewards = self._flights.move(moved, actions)
        self._parts.visit(moved)
        return rewards

    def _reported(self) -> dict[str, NDArray[Any]]:
        return {**super()._reported(), "action_mask": self._flights.masks}

    def _begin(self, begun: NDArray[np.bool_]) -> None:
        self._flights.begin(begun, super()._robots(), self._truths)

    def _robots(self) -> NDArray[np.int64]:
        return self._flights.robots

    def _shown(self) -> NDArray[np.uint8]:
        return self._frames.copy()  # each move of a path returns the frames again

    def _path(self, row: int) -> NDArray[np.intp] | None:
        if not self._flights.n_made[row]:
            return super()._path(row)
        start_row, start_col = super()._robots()[row].tolist()
        return fly((start_row, start_col), self._flights.made(row), self._spec)
