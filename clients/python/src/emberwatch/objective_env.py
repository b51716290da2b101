"""`emberwatch/WildfireObjective-v1`: one step chooses what the next path is for.

For one world, or for many.
"""

from os import PathLike, fspath
from typing import Any, Literal, Unpack

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emberwatch.agent_session import AgentSession, AgentSessionOwner, Features
from emberwatch.arguments import as_choice, as_choices
from emberwatch.base import ONE_ROW, WorldEnv
from emberwatch.settings import Settings, WorldArguments, shows_keywords
from emberwatch.vector_base import WorldVectorEnv
from emberwatch.wire import StepAnswer

_Estimator = Literal[
    "known_model",
    "spatial_filter",
    "learned_filter",
    "learned_spatial_filter",
    "learned_own_filter",
    "learned_own_spatial_filter",
    "neural_belief",
]


class WildfireObjectiveEnv(AgentSessionOwner, WorldEnv):
    """The paper's high-level decision: what the next path of the robot is for.

    ## Description

    The world is that of `WildfireEnv`. An `emberwatch-agent` keeps the belief about it, plans a
    path for each of eight objectives, and describes what each path promises. A learner here
    chooses which of them is flown: it takes the place of the paper's deep Q-network (section
    III.E).

    ## Action Space

    `Discrete(8)`, by the names in `objectives`: exploit what pays most; the same with some entropy
    beside it (two weights); the belief's entropy alone; cells that were not seen for long; what
    pays most over three paths; the region that promises most; the region not seen for longest.

    ## Observation Space

    `Box(-inf, inf, (8, 26), float32)`: row i describes the path that action i flies.
    `feature_names` names the 26 numbers, PROTOCOL.md section 13 explains them. One network can
    score each row by itself. `gymnasium.wrappers.FlattenObservation` makes a vector of them.

    ## Starting State

    As `WildfireEnv`, with the first belief that `prior` names, or the learned one.

    ## Rewards, Episode End, Information

    As `WildfireEnv`.

    ## Arguments

    As `WildfireEnv` without `observation`, `reward` and `robot`, in worlds of one robot, and

    * `estimator`: what keeps the belief. `"known_model"` is the paper's Bayes filter;
      `"learned_filter"` one with learned parameters, which finds several times as many fires where
      they are rare; `"learned_own_filter"` one that learned a kernel for each state of the cell
      itself. Each of them has a spatial one, whose corrections reach neighbouring cells:
      `"spatial_filter"`, `"learned_spatial_filter"`, `"learned_own_spatial_filter"`.
      `"neural_belief"` is a network from what was seen in each cell. By default the checkpoint's,
      without one the known model's filter.
    * `checkpoint`: the file that `emberwatch-agent train` saved, for learned estimators.
    * `prior`: of the known model's filter, `"simulated"` (the default; the first time it takes a
      second), `"initial"` or `"uniform"`.
    * `agent`: `"own"` starts an agent on the world; `"running"` uses one that serves decisions
      already, for `world` of `instance`.

    ## Vectorized environment

    `gymnasium.make_vec("emberwatch/WildfireObjective-v1", num_envs=64)` is
    `WildfireObjectiveVectorEnv`: one agent decides for all worlds.

    ## Version History

    * v1: eight plans with features, on a belief of choice; v0 chose among states and entropy.
    """

    @shows_keywords
    def __init__(
        self,
        *,
        estimator: _Estimator | None = None,
        checkpoint: str | PathLike[str] | None = None,
        prior: Literal["simulated", "initial", "uniform"] = "simulated",
        agent: Literal["own", "running"] = "own",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class. No server of its own runs before the first reset."""
        settings = Settings.of(WildfireObjectiveEnv, world)
        self._agent = AgentSession(settings, _arguments(estimator, checkpoint, prior, agent))
        super().__init__(self._agent)
        self.action_space = self._agent.action_space
        self.observation_space = self._agent.space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begins an episode; see `WildfireEnv`. An agent that does not start says why."""
        with self._session.turn:
            seen = self._seen(self._begin(seed, options))
            self._session.finish()
        return seen

    def step(
        self, action: np.integer[Any] | int
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Flies the path planned for an objective.

        Raises:
            EmberwatchError: As `WildfireEnv.step`, in the agent's words if it has ended.
        """
        objective = as_choice(action, int(self._agent.action_space.n))
        with self._session.turn:
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
        return self._agent.features[0], info


class WildfireObjectiveVectorEnv(AgentSessionOwner, WorldVectorEnv):
    """Many worlds of `WildfireObjectiveEnv`: one message to one agent, which steps them together.

    As `WildfireVectorEnv`; arguments are those of `WildfireObjectiveEnv`, and `num_envs`,
    `max_episode_steps`, `autoreset_mode`. With `agent="running"` that agent acts on these worlds.
    """

    @shows_keywords
    def __init__(
        self,
        *,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        estimator: _Estimator | None = None,
        checkpoint: str | PathLike[str] | None = None,
        prior: Literal["simulated", "initial", "uniform"] = "simulated",
        agent: Literal["own", "running"] = "own",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class. No server of its own runs before the first reset."""
        settings = Settings.of(WildfireObjectiveVectorEnv, world)
        arguments = _arguments(estimator, checkpoint, prior, agent)
        self._agent = AgentSession(settings, arguments, num_envs)
        super().__init__(
            self._agent,
            Features(self._agent),
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
        return self._results["world"]["reward"].copy()


def _arguments(
    estimator: str | None, checkpoint: str | PathLike[str] | None, prior: str, agent: str
) -> dict[str, str | None]:
    file = None if checkpoint is None else fspath(checkpoint)
    return {"estimator": estimator, "checkpoint": file, "prior": prior, "agent": agent}
