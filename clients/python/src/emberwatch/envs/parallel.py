"""`emberwatch.parallel_env`: all robots of one world for PettingZoo, imported only here."""

# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

from copy import deepcopy
from typing import Any, Final, Literal, Unpack

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from emberwatch.client.wire import UNOBSERVED
from emberwatch.common.arguments import as_array, told
from emberwatch.envs.base import NOTHING_TO_DRAW, as_options
from emberwatch.envs.moves_env import MovesReward, WildfireMovesVectorEnv
from emberwatch.envs.observations import MovesParts, names_of, of_row
from emberwatch.envs.owner import state_of
from emberwatch.envs.path_env import WildfireVectorEnv
from emberwatch.envs.settings import WorldArguments, shows_keywords
from emberwatch.envs.vector_base import WorldVectorEnv, info_of
from emberwatch.envs.view import RENDER_FPS, RENDER_MODES
from emberwatch.errors import invalid

_ENVIRONMENTS: Final = {"move": WildfireMovesVectorEnv, "path": WildfireVectorEnv}
_OBSERVATIONS: Final = {"move": "local", "path": ("frame", "robot")}


class WildfireParallelEnv(ParallelEnv[str, Any, Any]):
    """All robots of one world, as agents `robot_0`, `robot_1`, ... of PettingZoo's parallel API.

    With `action="move"` each agent acts, observes and is paid as in `WildfireMovesEnv`, with
    `action="path"` as in `WildfireEnv`. The robots begin together, fly together and end together.
    Seeds, `resume`, infos and pictures are as there; a picture shows the whole team. The action
    mask of each agent is where PettingZoo's tools look: in `infos[agent]["action_mask"]` or, if
    `observation` names it, in the observation.

    Arguments, all by keyword, are those of these environments, and:

    * `robots`: how many (2); with `instance` or `task` as many as that has.
    * `action`: `"move"`, a `Discrete(4)` (the default), or `"path"`, a `MultiDiscrete([4] * T)`.
    * `observation`: parts, by default `"local"` for moves, `("frame", "robot")` for paths.
    * `reward`: `"share"` (the default), `"team"`, `"marginal"`, or for moves `"move"`.
    * `max_episode_steps`: truncate after so many moves or paths (1,000); None: never.
    """

    @shows_keywords
    def __init__(
        self,
        *,
        action: Literal["move", "path"] = "move",
        observation: MovesParts | None = None,
        reward: MovesReward = "share",
        max_episode_steps: int | None = 1000,
        window: int | None = None,
        **world: Unpack[WorldArguments],
    ) -> None:
        """See the class. Nothing is opened before the first reset."""
        if action not in _ENVIRONMENTS:
            raise invalid("action", "'move' or 'path'", repr(action))
        if world.get("instance") is None and world.get("task") is None:
            world.setdefault("robots", 2)
        keywords: dict[str, Any] = {"reward": reward, **world}
        keywords["observation"] = _OBSERVATIONS[action] if observation is None else observation
        if window is not None:
            keywords["window"] = window
        self._worlds: Final[WorldVectorEnv] = _ENVIRONMENTS[action](
            num_envs=None,
            max_episode_steps=max_episode_steps,
            autoreset_mode=AutoresetMode.DISABLED,
            **keywords,
        )
        self._worlds.keeps_frames = True
        self._observes_masks = "action_mask" in names_of(keywords["observation"])
        self.possible_agents = [f"robot_{row}" for row in range(self._worlds.num_envs)]
        self.agents: list[str] = []
        self.metadata = {
            "name": "emberwatch_wildfire_v0",
            "render_modes": list(RENDER_MODES),
            "render_fps": RENDER_FPS,
            "is_parallelizable": True,
        }
        self.render_mode = self._worlds.render_mode
        # Copies with seeds of their own: each agent draws its own samples.
        self.observation_spaces = {
            agent: deepcopy(self._worlds.single_observation_space) for agent in self.possible_agents
        }
        self.action_spaces = {
            agent: deepcopy(self._worlds.single_action_space) for agent in self.possible_agents
        }
        for space in (*self.observation_spaces.values(), *self.action_spaces.values()):
            space.seed()
        spec = self._worlds.world_spec
        #: What `state` returns.
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
        """Begins an episode; of the options, only `resume` counts, see `WildfireEnv`."""
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
        """A move or a path of each robot; raises as `WildfireEnv.step` does."""
        with self._worlds.turn:
            return self._step(actions)

    def _step(self, actions: dict[str, Any]) -> tuple[Any, Any, Any, Any, Any]:
        given: Any = actions
        if not isinstance(given, dict) or actions.keys() != set(self.agents):
            raise invalid("actions", f"one for each of {self.agents}", told(actions))
        if not actions:
            return {}, {}, {}, {}, {}
        chosen = as_array([actions[agent] for agent in self.agents], "actions", "all of one shape")
        seen, rewards, terminated, truncated, infos = self._worlds.step(chosen)
        if (terminated | truncated).any():
            self.agents = []
        agents = self.possible_agents
        return (
            self._by_agent(seen),
            dict(zip(agents, rewards.tolist(), strict=True)),
            dict(zip(agents, terminated.tolist(), strict=True)),
            dict(zip(agents, truncated.tolist(), strict=True)),
            self._infos(infos),
        )

    def action_masks(self) -> dict[str, NDArray[np.int8]]:
        """The mask of each agent, as in its info; see `WildfireMovesEnv.action_masks`.

        Of moves only: where a move of a path leads depends on those before it.
        """
        if not isinstance(self._worlds, WildfireMovesVectorEnv):
            raise invalid("action_masks", "an environment of action='move'", "'path'")
        return dict(zip(self.possible_agents, self._worlds.action_masks(), strict=True))

    def state(self) -> NDArray[np.uint8]:
        """What the team saw in the last step, and where the robots are; not the hidden states.

        A channel of 0 or 255 for each observed value, one for nothing, one for the robots' cells.
        """
        frame, cells = self._worlds.seen(self._all)
        shown = np.zeros(self.state_space.shape, np.uint8)
        unseen = shown.shape[2] - 2
        values = np.where(frame == UNOBSERVED, unseen, frame).astype(np.intp)
        np.put_along_axis(shown, values[..., np.newaxis], 255, axis=2)
        shown[cells[:, 0], cells[:, 1], unseen + 1] = 255
        return shown

    def render(self) -> Any:
        """Draws the team: what all saw, their paths and where they are."""
        if self.render_mode is None or not self._worlds.is_open:
            gymnasium.logger.warn(NOTHING_TO_DRAW)
            return None
        return None if self.render_mode == "human" else self._worlds.draw(self._all)

    def close(self) -> None:
        self._worlds.close()
        self.agents = []

    def __getstate__(self) -> dict[str, Any]:
        return state_of(self, self._worlds.is_open, "emberwatch.parallel_env")

    @property
    def _all(self) -> slice:
        return slice(0, len(self.possible_agents))

    def _by_agent(self, seen: Any) -> dict[str, Any]:
        return {agent: of_row(seen, row) for row, agent in enumerate(self.possible_agents)}

    def _infos(self, infos: dict[str, Any]) -> dict[str, dict[str, Any]]:
        if self._observes_masks:
            # PettingZoo has a mask in the observation or in the info; TorchRL fails on both.
            infos = {name: each for name, each in infos.items() if name != "action_mask"}
        return {agent: info_of(infos, row) for row, agent in enumerate(self.possible_agents)}
