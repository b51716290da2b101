"""`gymnasium.make_vec("emberwatch/WildfireObjective-v0")`: one agent decides for all worlds."""

from __future__ import annotations

from typing import Any, Literal, Unpack

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emberwatch.agent_session import AgentSession, AgentSessionOwner, Summaries
from emberwatch.arguments import as_choices
from emberwatch.settings import Settings, WorldArguments
from emberwatch.vector_base import WorldVectorEnv


class WildfireObjectiveVectorEnv(AgentSessionOwner, WorldVectorEnv):
    """Many worlds of `WildfireObjectiveEnv`: one message to one agent, which steps them together.

    As `WildfireVectorEnv`; arguments are those of `WildfireObjectiveEnv`, and `num_envs`,
    `max_episode_steps`, `autoreset_mode`. With `agent="running"` that agent acts on these worlds.
    """

    def __init__(
        self,
        *,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        estimator: Literal["known_model", "spatial_filter"] = "known_model",
        planner: Literal["beam", "shooting"] = "beam",
        prior: Literal["simulated", "initial", "uniform"] = "simulated",
        agent: Literal["own", "running"] = "own",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class. No server of its own runs before the first reset."""
        settings = Settings.of(WildfireObjectiveVectorEnv, world)
        arguments = {"estimator": estimator, "planner": planner, "prior": prior, "agent": agent}
        self._agent = AgentSession(settings, arguments, num_envs)
        super().__init__(
            self._agent,
            Summaries(self._agent),
            self._agent.action_space,
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
            reveals=settings.truth,
        )

    def _check_actions(self, actions: NDArray[np.integer[Any]]) -> NDArray[np.uint8]:
        return as_choices(actions, self.num_envs, int(self._agent.action_space.n))

    def _fly(self, actions: NDArray[np.uint8], flown: NDArray[np.bool_]) -> NDArray[np.float64]:
        if flown.any():
            self._take(self._agent.decide(actions, flown))
        self._exchanged = flown
        if self.render_mode is not None:
            for index in np.flatnonzero(flown).tolist():
                self._paths[index] = self._agent.paths[index]
        return self._results["world"]["reward"]
