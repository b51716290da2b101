"""The native vector environments as a `VecEnv`. Importing this needs Stable-Baselines3.

from emberwatch.sb3 import make_vec_env
model = PPO("MultiInputPolicy", make_vec_env("emberwatch/WildfireMoves-v0", 64, reward="move"))
"""

# Stable-Baselines3 need not be installed where types are checked.
# pyright: reportMissingImports=false, reportMissingModuleSource=false, reportUnknownMemberType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportUntypedBaseClass=false

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from emberwatch.envs.vector_base import WorldVectorEnv, info_of
from emberwatch.errors import InvalidArgumentError, invalid, repr_of


def make_vec_env(name: str, n_envs: int = 1, **keywords: Any) -> WildfireVecEnv:
    """Makes a vector environment for Stable-Baselines3 with `gymnasium.make_vec`.

    For episode statistics, wrap it in Stable-Baselines3's `VecMonitor`.

    Args:
        name: The environment's name, such as ``"emberwatch/WildfireMoves-v0"``.
        n_envs: Number of robots, which is `num_envs` of the vector environment.
        keywords: The environment's keywords.
    """
    made = gymnasium.make_vec(
        name, num_envs=n_envs, autoreset_mode=AutoresetMode.SAME_STEP, **keywords
    )
    return WildfireVecEnv(made)


class WildfireVecEnv(VecEnv):
    """A native vector environment in autoreset mode `SAME_STEP`.

    The info of a world is empty, except at the end of its episode. At the end it has
    `terminal_observation`, `TimeLimit.truncated` and the info of the last complete path.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any]) -> None:
        worlds = env.unwrapped
        mode = env.metadata.get("autoreset_mode")
        if not isinstance(worlds, WorldVectorEnv) or mode is not AutoresetMode.SAME_STEP:
            raise InvalidArgumentError(
                "env: expected an environment of emberwatch from gymnasium.make_vec with "
                f"autoreset_mode='SameStep', got {env} with {mode}"
            )
        self._env: Any = env
        self._worlds = worlds
        self._actions: Any = None
        self.render_mode = worlds.render_mode
        super().__init__(worlds.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Any:
        seeds = [None if seed is None else int(seed) for seed in self._seeds]
        observations, _ = self._env.reset(seed=seeds if any(s is not None for s in seeds) else None)
        self._reset_seeds()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return observations

    def set_options(self, options: Any = None) -> None:
        if any([options] if options is None or isinstance(options, dict) else options):
            raise invalid("set_options", "no options, as resets have none here", repr_of(options))

    def step_async(self, actions: NDArray[Any]) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        observations, rewards, terminated, truncated, infos = self._env.step(self._actions)
        ended = terminated | truncated
        reported: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(ended).tolist():
            reported[index] = info_of(infos["final_info"], index)
            reported[index]["terminal_observation"] = infos["final_obs"][index]
            reported[index]["TimeLimit.truncated"] = bool(truncated[index] & ~terminated[index])
        return observations, rewards.astype(np.float32), ended, reported

    def close(self) -> None:
        self._env.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        return list(self._worlds.render() or [None] * self.num_envs)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self._worlds, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise InvalidArgumentError(
            f"set_attr: {attr_name!r} cannot be set, as all worlds share one environment"
        )

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        if method_name == "render":  # in mode "human"
            pictures = self.get_images()
            return [pictures[index] for index in self._get_indices(indices)]
        if method_name == "action_masks":
            return list(self.get_attr(method_name)[0]()[self._get_indices(indices)])
        expected = "'render' or 'action_masks', as all worlds share one environment"
        raise invalid("env_method", expected, repr_of(method_name))

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))
