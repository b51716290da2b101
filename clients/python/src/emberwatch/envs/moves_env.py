"""`emberwatch/WildfireMoves-v0`: one step is one move, and the world moves after T moves."""

from typing import Any, Literal, TypeAlias, Unpack

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emberwatch._native import Flights
from emberwatch.client import wire
from emberwatch.client.wire import StepAnswer
from emberwatch.common.arguments import as_choice, as_choices
from emberwatch.envs.base import ONE_ROW, Reward, WorldEnv, check_reward
from emberwatch.envs.observations import WINDOW, MovesParts, Observations
from emberwatch.envs.owner import SessionOwner
from emberwatch.envs.plans import Plans
from emberwatch.envs.session import Session, not_reset
from emberwatch.envs.settings import Settings, WorldArguments, shows_keywords
from emberwatch.envs.vector_base import WorldVectorEnv
from emberwatch.model.moves import fly

MovesReward: TypeAlias = Literal[Reward, "move"]


class MovesOwner(SessionOwner):
    """Robots that fly move by move."""

    _flights: Flights

    def _attach(self, session: Session, observations: Observations | Plans, pays: int) -> None:
        assert isinstance(observations, Observations) and observations.flights is not None
        super()._attach(session, observations, pays)
        self._flights = observations.flights

    def _masks(self) -> NDArray[np.int8]:
        if not self.is_open:
            raise not_reset()
        return self._flights.masks

    def _robots(self) -> NDArray[np.int64]:
        return self._flights.robots

    def _path(self, row: int) -> NDArray[np.intp] | None:
        made = self._flights.made(row)
        return fly(super()._robots()[row], made, self._spec) if len(made) else super()._path(row)


class WildfireMovesEnv(MovesOwner, WorldEnv):
    """The world of `WildfireEnv`, flown move by move.

    One step is one move of the robot. After T moves the path is complete. Then the world moves
    once, and the visited cells are observed and rewarded.

    ## Action Space

    `Discrete(4)`: 0 up, 1 down, 2 left, 3 right. A move off the grid or into a no-fly cell leaves
    the robot in place. The action mask, `(4,)` int8, is 1 for each move that leads to another cell.
    If no move does, it is 1 for all moves. The mask is in `info["action_mask"]`, and can be an
    observation part. It is also returned by `action_masks()`, which MaskablePPO of sb3-contrib
    calls.

        action = env.action_space.sample(info["action_mask"])

    ## Observation Space

    `observation` names the parts: the parts of `WildfireEnv`, where `frame` and `image` show the
    last complete path, and these:

    | part | space | meaning |
    |---|---|---|
    | `visited` | `Box(0, 255, (H, W, 1), uint8)` | 255 in cells that this path has visited |
    | `move` | `Discrete(T)` | number of moves made on this path |
    | `local` | `Box(0, 255, (L, L, 5), uint8)` | the belief around the robot, L = `window` |
    | `recent` | `Box(0, 255, (L, L, O + 3), uint8)` | the last observations around the robot |
    | `action_mask` | `Box(0, 1, (4,), int8)` | 1 for each move that leads to another cell |

    `local` has five channels, whose values are multiplied by 255: the probability of the state that
    pays most; the entropy of the belief divided by log S; 1 in the cells that this path has
    visited; 1 off the grid and in no-fly cells; the share of the path's moves that remain. The
    first two are 0 in visited cells.

    `recent` needs no model. It has one channel for each of the O observed values. The channel of a
    cell's last observed value is 255 if the last frame observed it, and halves every 16 steps; the
    cell's other channels are 0, and all O in visited cells. The last three channels are those of
    `local`.

    ## Rewards

    With `reward="share"` (the default), `"team"` or `"marginal"`, as in `WildfireEnv`, the last
    move of a path gets the path's reward, and all other moves get 0, as cells pay by their state
    after the world has moved.

    With `reward="move"`, each cell pays when the path first visits it, by its hidden state before
    the world moves. The last move's reward also includes a correction, so that the rewards of a
    path sum to the robot's share, as with `"share"`. But `"move"` reveals more about the hidden
    state, and earlier, so results with the two rewards are not comparable. With `instance`, the
    server must publish the hidden states.

    ## Episode End

    As in `WildfireEnv`, but `max_episode_steps` counts moves (default 64,000, which is 1,000 paths
    of 64 moves; pass another number for paths of another length).

    ## Starting State, Information

    As in `WildfireEnv`. If an episode ends within a path, `reset(options={"resume": True})` of the
    same environment continues this path, unless the world has moved. The moves of a path exist
    only in the environment that makes them: another environment begins a new path. Except for
    `action_mask`, the info is about the last complete path.

    ## Arguments

    As in `WildfireEnv`, with these differences:

    * `observation`: `("frame", "visited", "robot", "move")` by default.
    * `reward`: may also be `"move"`.
    * `window`: L, the side of `local` and `recent` in cells, an odd number (15).
    * `kind`: the kind of belief in `belief` and `local`.

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
        kind: str = "known",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class."""
        settings = Settings.of(WildfireMovesEnv, world, needs_truth=reward == "move")
        session, pays = Session(settings), check_reward(reward, "move")
        parts = Observations(observation, session, kind, window=window, pays=reward == "move")
        super().__init__(session, parts, spaces.Discrete(wire.N_MOVES), pays=pays)

    def step(self, action: np.integer[Any] | int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Flies one move. Move number T completes the path and moves the world.

        Raises:
            EmberwatchError: As in `WildfireEnv.step`.
        """
        move = np.array([as_choice(action, wire.N_MOVES)], np.uint8)
        with self._session.turn:
            self._session.begin_step()
            completes = self._flights.completes()[0]
            outcome = self._complete(move) if completes else self._move(move)
            self._session.finish()
        return outcome

    def action_masks(self) -> NDArray[np.int8]:
        """Returns 1 for each move that takes the robot to another cell, otherwise 0; `(4,)` int8.

        All 1 if no move leads to another cell. The same as `info["action_mask"]`.
        """
        return self._masks()[0]

    def _move(self, move: NDArray[np.uint8]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Makes a move that does not complete its path."""
        reward = float(self._flights.move(ONE_ROW, move)[0])
        observation, info = self._seen()
        return observation, reward, False, False, info

    def _complete(self, move: NDArray[np.uint8]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Completes the path with its last move, flies it, and moves the world."""
        paid = float(self._flights.paid[0])
        outcome = self._fly(self._flights.paths(move))
        observation, reward, terminated, truncated, info = outcome
        return observation, reward - paid, terminated, truncated, info

    def _take(self, answer: StepAnswer) -> None:
        super()._take(answer)
        self._flights.start_paths(ONE_ROW, self._numbers[5], self._truths)

    def _seen(self) -> tuple[Any, dict[str, Any]]:
        info = self._info()
        info["action_mask"] = self._flights.masks[0]
        if self.render_mode == "human":
            self.draw(slice(0, 1))
        # Copied, because each move of a path returns the same frame.
        frames = self._frames.copy()
        return self._observations.one(frames, self._flights.robots, self._teams), info


class WildfireMovesVectorEnv(MovesOwner, WorldVectorEnv):
    """Many robots of `WildfireMovesEnv`, stepped together.

    One message flies the paths of all robots that complete a path. Takes the arguments of
    `WildfireMovesEnv`, and `num_envs`, `max_episode_steps` (in moves) and `autoreset_mode` of
    `WildfireVectorEnv`.
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
        kind: str = "known",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class."""
        pays = check_reward(reward, "move")
        settings = Settings.of(WildfireMovesVectorEnv, world, needs_truth=reward == "move")
        session = Session(settings, num_envs)
        super().__init__(
            session,
            Observations(observation, session, kind, window=window, pays=reward == "move"),
            spaces.Discrete(wire.N_MOVES),
            pays=pays,
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
        )

    def action_masks(self) -> NDArray[np.int8]:
        """Returns the masks of all robots, `(num_envs, 4)`; see `WildfireMovesEnv.action_masks`."""
        return self._masks()

    def _check_actions(self, actions: NDArray[np.integer[Any]]) -> NDArray[np.uint8]:
        return as_choices(actions, self.num_envs, wire.N_MOVES)

    def _step_worlds(
        self, actions: NDArray[np.uint8], flown: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        completed = flown & self._flights.completes()
        if not completed.any():
            return self._flights.move(flown, actions)
        self._exchange(self._flights.paths(actions), completed)
        rewards = self._columns.rewards - self._flights.paid
        others = flown & ~completed
        if others.any():
            rewards = np.where(others, self._flights.move(others, actions), rewards)
        self._begin(completed)
        return rewards

    def _reported(self) -> dict[str, NDArray[Any]]:
        return {**super()._reported(), "action_mask": self._flights.masks}

    def _begin(self, begun: NDArray[np.bool_]) -> None:
        self._flights.start_paths(begun, self._columns.cells, self._truths)

    def _shown(self) -> NDArray[np.uint8]:
        return self._frames.copy()  # each move of a path returns the same frames
