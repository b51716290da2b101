"""Worlds behind wrappers of Stable-Baselines3, which this module imports."""

# Stable-Baselines3 need not be installed where types are checked.
# pyright: reportMissingImports=false, reportMissingModuleSource=false, reportUnknownMemberType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportUntypedBaseClass=false, reportUnknownParameterType=false

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize

from emberwatch.errors import InvalidArgumentError, invalid, repr_of
from emberwatch.sb3 import WildfireVecEnv


class Wrapped:
    """Worlds whose observations pass through wrappers. The wrappers never see an episode end."""

    def __init__(self, worlds: Any, wrap: Callable[[VecEnv], VecEnv]) -> None:
        """Wraps the worlds, and freezes the statistics of each `VecNormalize`."""
        self._base = _ScoredVecEnv(worlds)
        self._vector: Any = wrap(self._base)
        layer: Any = self._vector
        while layer is not self._base:
            if not isinstance(layer, VecEnvWrapper):
                expected = "a function that returns its argument in VecEnvWrappers of SB3"
                raise invalid("wrap", expected, repr_of(self._vector))
            if isinstance(layer, VecNormalize):
                _freeze(layer)
            layer = layer.venv
        self.single_observation_space = self._vector.observation_space

    def reset(self, *, seed: list[int]) -> tuple[Any, dict[str, Any]]:
        """Begins episodes with these seeds, one for each row."""
        self._base.choose(seed)
        return self._vector.reset(), {}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Any, Any, Any, NDArray[np.bool_], dict[str, Any]]:
        """Steps all rows, with the return values of Gymnasium's vector environments."""
        seen, rewards, ends, _ = self._vector.step(actions)
        return seen, rewards, ends, self._base.truncated, {}


class _ScoredVecEnv(WildfireVecEnv):
    """Worlds that never reset by themselves, so that their last results can be read."""

    def __init__(self, worlds: Any) -> None:
        self._env, self._worlds, self._actions = worlds, worlds.unwrapped, None
        self.render_mode = None
        self.truncated = np.zeros(worlds.num_envs, np.bool_)
        # A copy, as some wrappers change their space.
        space = deepcopy(worlds.single_observation_space)
        VecEnv.__init__(self, worlds.num_envs, space, worlds.single_action_space)

    def choose(self, seeds: list[int]) -> None:
        """Sets the seeds of the next reset."""
        self._seeds = seeds

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        seen, rewards, _, self.truncated, _ = self._env.step(self._actions)
        none = np.zeros(self.num_envs, np.bool_)
        return seen, rewards.astype(np.float32), none, [{} for _ in range(self.num_envs)]


def _freeze(normalize: VecNormalize) -> None:
    """Freezes the statistics of the training; refuses a `VecNormalize` without statistics."""
    normalize.training = normalize.norm_reward = False
    rms = normalize.obs_rms if normalize.norm_obs else {}
    # The count of a new `VecNormalize` is far below 1.
    if any(part.count < 1.0 for part in (rms.values() if isinstance(rms, dict) else [rms])):
        raise InvalidArgumentError(
            "wrap: VecNormalize has no statistics: save the training's statistics with its `save`, "
            "and pass wrap=lambda worlds: VecNormalize.load('statistics.pkl', worlds)"
        )
