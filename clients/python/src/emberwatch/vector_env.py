"""`gymnasium.make_vec("emberwatch/Wildfire-v0")`: one message steps all worlds."""

from __future__ import annotations

from typing import Any, Unpack

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emberwatch import wire
from emberwatch.arguments import as_moves
from emberwatch.observations import Observations, Parts
from emberwatch.session import Session
from emberwatch.settings import Settings, WorldArguments
from emberwatch.vector_base import WorldVectorEnv
from emberwatch.view import fly


class WildfireVectorEnv(WorldVectorEnv):
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
        settings = Settings.of(WildfireVectorEnv, world)
        session = Session(settings, num_envs)
        super().__init__(
            session,
            Observations(observation, session.spec, num_envs),
            spaces.MultiDiscrete([wire.N_MOVES] * session.spec.n_moves),
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
            reveals=settings.truth,
        )

    def _check_actions(self, actions: NDArray[np.integer[Any]]) -> NDArray[np.uint8]:
        return as_moves(actions, self.num_envs, self._spec.n_moves).reshape(self.num_envs, -1)

    def _fly(self, actions: NDArray[np.uint8], flown: NDArray[np.bool_]) -> NDArray[np.float64]:
        before = self._robots() if self.render_mode is not None else None
        self._exchange(actions, flown)
        if before is not None:
            for index in np.flatnonzero(flown).tolist():
                row, col = before[index].tolist()
                self._paths[index] = fly((row, col), actions[index], self._spec)
        return self._results["reward"]
