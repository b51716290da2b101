"""`gymnasium.make_vec("emberwatch/Wildfire-v0")`: one message steps all worlds."""

from __future__ import annotations

from typing import Any, Unpack

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emberwatch import wire
from emberwatch.arguments import as_moves
from emberwatch.base import Reward, check_reward
from emberwatch.observations import Observations, Parts
from emberwatch.settings import Settings, WorldArguments
from emberwatch.vector_base import WorldVectorEnv, vector_session


class WildfireVectorEnv(WorldVectorEnv):
    """Many robots of `WildfireEnv`, stepped together: all of some worlds.

    Observations, rewards, ends and infos are those of Gymnasium's `SyncVectorEnv` over the single
    environment with the same seeds, field by field, in all three autoreset modes; world i of
    `reset(seed=s)` has seed s + i. `options={"reset_mask": mask}` resets some of the worlds.

    Arguments are those of `WildfireEnv`, and:

    * `num_envs`: number of robots, a multiple of `robots`; None: those of one world.
    * `robots`: robots of each world (1). They begin and end their episodes together.
    * `max_episode_steps`: truncate after so many steps; None or -1: never.
    * `autoreset_mode`: a `gymnasium.vector.AutoresetMode`; `NEXT_STEP` by default.
    * `world`: the first world; the others follow.
    * `render_mode`: `"human"` shows the first world only.
    """

    def __init__(
        self,
        *,
        num_envs: int | None = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        observation: Parts = ("frame", "robot"),
        reward: Reward = "share",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class. No server of its own runs before the first reset."""
        self._pays = check_reward(reward)
        settings = Settings.of(WildfireVectorEnv, world)
        session = vector_session(settings, num_envs)
        super().__init__(
            session,
            Observations(observation, session.spec, session.n_rows),
            spaces.MultiDiscrete([wire.N_MOVES] * session.spec.n_moves),
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
            reveals=settings.truth,
        )

    def _check_actions(self, actions: NDArray[np.integer[Any]]) -> NDArray[np.uint8]:
        return as_moves(actions, self.num_envs, self._spec.n_moves).reshape(self.num_envs, -1)

    def _fly(self, actions: NDArray[np.uint8], flown: NDArray[np.bool_]) -> NDArray[np.float64]:
        self._exchange(actions, flown)
        part, name = self._pays
        return self._results[part][name]
