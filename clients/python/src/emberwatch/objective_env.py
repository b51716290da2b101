"""`emberwatch/WildfireObjective-v0`: one step chooses what the next path is for.

For one world, or for many.
"""

from typing import Any, Literal, Unpack

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emberwatch.agent_session import AgentSession, AgentSessionOwner, Summaries
from emberwatch.arguments import as_choice, as_choices
from emberwatch.base import ONE_ROW, WorldEnv
from emberwatch.settings import Settings, WorldArguments
from emberwatch.vector_base import WorldVectorEnv
from emberwatch.wire import StepAnswer


class WildfireObjectiveEnv(AgentSessionOwner, WorldEnv):
    """The paper's high-level decision: what the next path of the robot is for.

    ## Description

    The world is that of `WildfireEnv`. An `emberwatch-agent` keeps the belief about it with the
    known-model filter, and plans each path for the objective chosen; a learner here takes the
    place of the paper's deep Q-network (section III.E), with everything else kept.

    ## Action Space

    `Discrete(S + 1)`: the path is planned for the probability of this state of the model's S
    (wildfire: 0 normal, 1 latent, 2 fire), or S for the entropy of the belief.

    ## Observation Space

    `Box(0, 1, (18 (S + 1) + 2,), float32)`: a summary of the belief that the next plan will use,
    in place of the paper's h_k. Its length is the same for every grid; PROTOCOL.md section 13
    explains the numbers, and `summary_names` names them.

    ## Starting State

    As `WildfireEnv`, with the belief that the world's burn-in leaves one with (`prior`).

    ## Rewards, Episode End, Information

    As `WildfireEnv`.

    ## Arguments

    As `WildfireEnv` without `observation`, `reward` and `robot`, in worlds of one robot, and

    * `estimator`: `"known_model"` (the paper's Bayes filter, the default) or `"spatial_filter"`
      (what is seen also changes the belief about neighbouring cells, by correlations that each
      episode learns for itself, so that the same seed and actions give the same episode).
    * `planner`: `"beam"` (beam search, the default) or `"shooting"` (the paper's).
    * `prior`: `"simulated"` (the default; takes a second to start), `"initial"` or `"uniform"`.
    * `agent`: `"own"` starts an agent on the world; `"running"` uses one that serves decisions
      already, for `world` of `instance`.

    ## Vectorized environment

    `gymnasium.make_vec("emberwatch/WildfireObjective-v0", num_envs=64)` is
    `WildfireObjectiveVectorEnv`: one agent decides for all worlds.

    ## Version History

    * v0: the first.
    """

    def __init__(
        self,
        *,
        estimator: Literal["known_model", "spatial_filter"] = "known_model",
        planner: Literal["beam", "shooting"] = "beam",
        prior: Literal["simulated", "initial", "uniform"] = "simulated",
        agent: Literal["own", "running"] = "own",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class. No server of its own runs before the first reset."""
        settings = Settings.of(WildfireObjectiveEnv, world)
        arguments = {"estimator": estimator, "planner": planner, "prior": prior, "agent": agent}
        self._agent = AgentSession(settings, arguments)
        super().__init__(self._agent)
        self.action_space = self._agent.action_space
        self.observation_space = self._agent.space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begins an episode; see `WildfireEnv`. An agent that does not start says why."""
        seen = self._seen(self._begin(seed, options))
        self._session.finish()
        return seen

    def step(
        self, action: np.integer[Any] | int
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Plans and flies a path for an objective.

        Raises:
            EmberwatchError: As `WildfireEnv.step`, in the agent's words if it has ended.
        """
        objective = as_choice(action, int(self._agent.action_space.n))
        self._session.begin_step()
        answer = self._agent.decide(np.array([objective], np.uint8), ONE_ROW)
        if self.render_mode is not None:
            self._path = self._agent.paths[0]
        observation, info = self._seen(answer)
        world = answer.result().world
        self._session.finish()
        return observation, world.reward, bool(world.terminated), bool(world.truncated), info

    def _seen(self, answer: StepAnswer) -> tuple[NDArray[np.float32], dict[str, Any]]:
        self._answer = answer
        info = self._describe(answer, answer.result())
        if self.render_mode == "human":
            self._draw()
        return self._agent.summaries[0], info


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
