"""`emberwatch.parallel_env`: all robots of one world. Importing this needs PettingZoo."""

# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

from copy import deepcopy
from typing import Any, Final, Literal, Unpack

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from emberwatch.client.wire import UNOBSERVED
from emberwatch.common.arguments import as_array
from emberwatch.envs.base import as_options
from emberwatch.envs.moves_env import MovesReward, WildfireMovesVectorEnv
from emberwatch.envs.observations import MovesParts, names_of, of_row
from emberwatch.envs.owner import METADATA, state_of
from emberwatch.envs.path_env import WildfireVectorEnv
from emberwatch.envs.settings import WorldArguments, shows_keywords
from emberwatch.envs.vector_base import WorldVectorEnv, info_of
from emberwatch.errors import invalid, repr_of

_ENVIRONMENTS: Final = {"move": WildfireMovesVectorEnv, "path": WildfireVectorEnv}
#: Default length of episodes without a task, in paths.
_N_PATHS: Final = 1000

_OBSERVATIONS: Final = {"move": "local", "path": ("frame", "robot")}


class WildfireParallelEnv(ParallelEnv[str, Any, Any]):
    """All robots of one world, as agents `robot_0`, `robot_1`, ... of PettingZoo's parallel API.

    Actions, observations and rewards of each agent are the same as in `WildfireMovesEnv` with
    `action="move"`, and as in `WildfireEnv` with `action="path"`. The robots begin, step and end
    their episodes together. Seeds, `resume`, infos and pictures work as in `WildfireMovesEnv` and
    `WildfireEnv`, except that a picture shows the whole team. The action mask of each agent is in
    `infos[agent]["action_mask"]`, or in the observation if `observation` names it. PettingZoo's
    tools read both.

    Takes the arguments of these environments, all by keyword, and:

    * `robots`: number of robots (2); a `task` or the server of `instance` determines it.
    * `action`: `"move"`, a `Discrete(4)` (the default), or `"path"`, a `MultiDiscrete([4] * T)`.
    * `observation`: observation parts, by default `"local"` for moves and `("frame", "robot")` for
      paths.
    * `reward`: `"share"` (the default), `"team"`, `"marginal"`, or with moves also `"move"`.
    * `max_episode_steps`: number of moves or paths after which episodes are truncated; None: never.
      By default, `"task"`, after the paths of the task, or after 1,000 paths without a task.
    """

    @shows_keywords
    def __init__(
        self,
        *,
        action: Literal["move", "path"] = "move",
        observation: MovesParts | None = None,
        reward: MovesReward = "share",
        max_episode_steps: int | Literal["task"] | None = "task",
        window: int | None = None,
        kind: str = "known",
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class. Worlds are created or acquired at the first reset."""
        if action not in _ENVIRONMENTS:
            raise invalid("action", "'move' or 'path'", repr_of(action))
        if world.get("instance") is None and world.get("task") is None:
            world.setdefault("robots", 2)
        keywords: dict[str, Any] = {"reward": reward, "kind": kind, **world}
        keywords["observation"] = _OBSERVATIONS[action] if observation is None else observation
        if window is not None:
            keywords["window"] = window
        self._worlds: Final[WorldVectorEnv] = _ENVIRONMENTS[action](
            num_envs=None,
            max_episode_steps=None if max_episode_steps == "task" else max_episode_steps,
            autoreset_mode=AutoresetMode.DISABLED,
            **keywords,
        )
        self._observes_masks = "action_mask" in names_of(keywords["observation"])
        self.possible_agents = [f"robot_{row}" for row in range(self._worlds.num_envs)]
        self.agents: list[str] = []
        self.metadata = {
            **METADATA,
            "name": "emberwatch_wildfire_v0",
            "is_parallelizable": True,
        }
        self.render_mode = self._worlds.render_mode
        # Separate copies: each agent's space draws its own samples.
        self.observation_spaces = {
            agent: deepcopy(self._worlds.single_observation_space) for agent in self.possible_agents
        }
        self.action_spaces = {
            agent: deepcopy(self._worlds.single_action_space) for agent in self.possible_agents
        }
        for space in (*self.observation_spaces.values(), *self.action_spaces.values()):
            space.seed()
        spec = self._worlds.world_spec
        if max_episode_steps == "task":
            n_paths = _N_PATHS if spec.task is None else spec.task.max_steps
            n_steps = n_paths * (spec.n_moves if action == "move" else 1)
            self._worlds.max_episode_steps = n_steps
        #: The space of `state`.
        self.state_space = spaces.Box(
            0, 255, (spec.height, spec.width, spec.n_observations + 2), np.uint8
        )

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Begins an episode. The only option is `resume`, see `WildfireEnv`; others are ignored."""
        known = {key: value for key, value in as_options(options).items() if key == "resume"}
        with self._worlds.turn:
            seen, infos = self._worlds.reset(seed=seed, options=known)
            self.agents = list(self.possible_agents)
        return self._by_agent(seen), self._infos(infos)

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[
        dict[str, Any],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Flies a move or a path with each robot.

        Raises:
            EmberwatchError: As in `WildfireEnv.step`.
        """
        given: Any = actions
        agents = self.possible_agents
        with self._worlds.turn:
            if not isinstance(given, dict) or actions.keys() != set(self.agents):
                raise invalid("actions", f"one for each of {self.agents}", repr_of(actions))
            if not actions:
                return {}, {}, {}, {}, {}
            chosen = as_array([actions[agent] for agent in agents], "actions", "all of one shape")
            seen, rewards, terminated, truncated, infos = self._worlds.step(chosen)
            if (terminated | truncated).any():
                self.agents = []
        return (
            self._by_agent(seen),
            dict(zip(agents, rewards.tolist(), strict=True)),
            dict(zip(agents, terminated.tolist(), strict=True)),
            dict(zip(agents, truncated.tolist(), strict=True)),
            self._infos(infos),
        )

    def state(self) -> NDArray[np.uint8]:
        """Returns the team's last frame and the robots' cells, without the hidden states.

        The channels are 0 or 255: one for each observed value, one for unobserved cells, and one
        for the robots' cells. Shape (H, W, O + 2).
        """
        frame, cells = self._worlds.seen(self._all)
        shown = np.zeros(self.state_space.shape, np.uint8)
        unseen = shown.shape[2] - 2
        values = np.where(frame == UNOBSERVED, unseen, frame).astype(np.intp)
        np.put_along_axis(shown, values[..., np.newaxis], 255, axis=2)
        shown[cells[:, 0], cells[:, 1], unseen + 1] = 255
        return shown

    def render(self) -> Any:
        """Draws the team's last frame, paths and robots."""
        if not self._worlds.can_draw() or self.render_mode == "human":
            return None
        return self._worlds.draw(self._all)

    def close(self) -> None:
        self._worlds.close()
        self.agents = []

    def __getstate__(self) -> dict[str, Any]:
        return state_of(self, self._worlds.is_open, "emberwatch.parallel_env")

    @property
    def _all(self) -> slice:
        return slice(0, len(self.possible_agents))

    def _by_agent(self, seen: Any) -> dict[str, Any]:
        # Copies, because `state` shows the original frames.
        rows = enumerate(self.possible_agents)
        return {agent: deepcopy(of_row(seen, row)) for row, agent in rows}

    def _infos(self, infos: dict[str, Any]) -> dict[str, dict[str, Any]]:
        if self._observes_masks:
            # PettingZoo allows a mask in the observation or in the info, but TorchRL fails if both
            # have one.
            infos = {name: each for name, each in infos.items() if name != "action_mask"}
        return {agent: info_of(infos, row) for row, agent in enumerate(self.possible_agents)}
