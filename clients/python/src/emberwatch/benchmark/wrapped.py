"""Worlds behind the wrappers of Stable-Baselines3, which is imported only here."""

# Stable-Baselines3 need not be installed where types are checked.
# pyright: reportMissingImports=false, reportMissingModuleSource=false, reportUnknownMemberType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportUntypedBaseClass=false, reportUnknownParameterType=false

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize

from emberwatch.common.arguments import told
from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.sb3 import WildfireVecEnv


class Wrapped:
    """Worlds whose observations pass through wrappers. No episode ends before its last step."""

    def __init__(self, worlds: Any, wrap: Callable[[VecEnv], VecEnv]) -> None:
        """Wraps them; the statistics of a `VecNormalize` stay as they are.

        Raises:
            InvalidArgumentError: If `wrap` returns something else, or statistics are missing.
        """
        self._base = _ScoredVecEnv(worlds)
        self._vector: Any = wrap(self._base)
        #: Those that normalize, from the outermost one on.
        self.normalizers: list[VecNormalize] = []
        layer: Any = self._vector
        while layer is not self._base:
            if not isinstance(layer, VecEnvWrapper):
                expected = "a function that returns its argument, a VecEnv of SB3, in wrappers"
                raise invalid("wrap", expected, told(self._vector))
            if isinstance(layer, VecNormalize):
                self.normalizers.append(layer)
                _fix(layer)
            layer = layer.venv
        self.single_observation_space = self._vector.observation_space

    def reset(self, *, seed: list[int]) -> tuple[Any, dict[str, Any]]:
        """Begins the worlds of these seeds, one for each row."""
        self._base.choose(seed)
        return self._vector.reset(), {}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Any, Any, Any, NDArray[np.bool_], dict[str, Any]]:
        """Steps all rows; returns what a vector environment of Gymnasium does."""
        seen, rewards, ends, _ = self._vector.step(actions)
        return seen, rewards, ends, self._base.truncated, {}


class _ScoredVecEnv(WildfireVecEnv):
    """Worlds that no step resets, as their last results are read."""

    def __init__(self, worlds: Any) -> None:
        self._env, self._worlds, self._actions = worlds, worlds.unwrapped, None
        self.render_mode = None
        self.truncated = np.zeros(worlds.num_envs, np.bool_)
        # A copy, as some wrappers write to it.
        space = deepcopy(worlds.single_observation_space)
        VecEnv.__init__(self, worlds.num_envs, space, worlds.single_action_space)

    def choose(self, seeds: Sequence[int]) -> None:
        """Sets the seeds of the next reset."""
        self._seeds = list(seeds)

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        seen, rewards, _, self.truncated, _ = self._env.step(self._actions)
        none = np.zeros(self.num_envs, np.bool_)
        return seen, rewards.astype(np.float32), none, [{} for _ in range(self.num_envs)]


def _fix(normalize: VecNormalize) -> None:
    """Keeps the statistics of a training, as its own evaluation must; refuses to do without."""
    normalize.training = normalize.norm_reward = False
    rms = normalize.obs_rms if normalize.norm_obs else {}
    parts = rms.values() if isinstance(rms, dict) else [rms]
    # It begins with the weight of a small part of an observation.
    if any(part.count < 1.0 for part in parts):
        raise InvalidArgumentError(
            "wrap: VecNormalize has no statistics: save those of the training with its `save`, and "
            "pass wrap=lambda worlds: VecNormalize.load('statistics.pkl', worlds)"
        )
