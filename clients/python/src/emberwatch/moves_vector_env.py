"""`gymnasium.make_vec("emberwatch/WildfireMoves-v0")`: one move in each world."""

from __future__ import annotations

from typing import Any, Unpack

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emberwatch import wire
from emberwatch.arguments import as_choices
from emberwatch.base import check_reward
from emberwatch.moves_env import MovesReward, moves_flights, moves_settings
from emberwatch.observations import WINDOW, MovesParts, Observations
from emberwatch.session import not_reset
from emberwatch.settings import WorldArguments
from emberwatch.vector_base import WorldVectorEnv, vector_session
from emberwatch.view import fly


class WildfireMovesVectorEnv(WorldVectorEnv):
    """Many robots of `WildfireMovesEnv`: one message steps all whose paths are complete.

    As `WildfireVectorEnv`; arguments are those of `WildfireMovesEnv`, and `num_envs`,
    `max_episode_steps` (moves), `autoreset_mode`.
    """

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
        """See the class. No server of its own runs before the first reset."""
        reveals = world.get("truth", False)
        self._pays = check_reward(reward, "move")
        settings = moves_settings(WildfireMovesVectorEnv, reward, world)
        session = vector_session(settings, num_envs)
        n_rows = session.n_rows
        self._flights = flights = moves_flights(session.spec, n_rows, reward)
        self._parts = Observations(observation, session.spec, n_rows, flights, window)
        super().__init__(
            session,
            self._parts,
            spaces.Discrete(wire.N_MOVES),
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
            reveals=reveals,
        )

    def _check_actions(self, actions: NDArray[np.integer[Any]]) -> NDArray[np.uint8]:
        return as_choices(actions, self.num_envs, wire.N_MOVES)

    def _fly(self, actions: NDArray[np.uint8], flown: NDArray[np.bool_]) -> NDArray[np.float64]:
        if not self._session.is_open:
            raise not_reset()
        completed = flown & self._flights.completes()
        if not completed.any():
            return self._move(actions, flown)
        self._exchange(self._flights.paths(actions), completed)
        part, name = self._pays
        rewards = self._results[part][name] - self._flights.paid
        others = flown & ~completed
        if others.any():
            rewards = np.where(others, self._move(actions, others), rewards)
        self._begin(completed)
        return rewards

    def _move(self, actions: NDArray[np.uint8], moved: NDArray[np.bool_]) -> NDArray[np.float64]:
        """One move that completes no path."""
        indices = np.flatnonzero(moved)
        rewards = np.zeros(self.num_envs)
        rewards[indices] = self._flights.move(indices, actions)
        self._parts.visit(indices)
        return rewards

    def _begin(self, begun: NDArray[np.bool_]) -> None:
        self._flights.begin(begun, super()._robots(), self._truths)

    def _robots(self) -> NDArray[np.int64]:
        return self._flights.robots.copy()

    def _shown(self) -> NDArray[np.uint8]:
        return self._frames.copy()  # each move of a path returns the frames again

    def _path(self, row: int) -> NDArray[np.intp] | None:
        if not self._flights.n_made[row]:
            return super()._path(row)
        start_row, start_col = super()._robots()[row].tolist()
        return fly((start_row, start_col), self._flights.made(row), self._spec)
