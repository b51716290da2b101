"""Calls of policies: functions of observations, and models with the `predict` of SB3.

SB3 is Stable-Baselines3. Its models may be recurrent (RecurrentPPO), take action masks
(MaskablePPO), and expect observations that passed through the wrappers of their training.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, Final, TypeAlias, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from emberwatch.common.arguments import as_array
from emberwatch.errors import InvalidArgumentError, invalid, repr_of

#: A function from stacked observations to actions, or a model of SB3.
Policy: TypeAlias = Callable[..., Any]


class Actor:
    """A policy that acts in one batch of worlds, with its state there."""

    def __init__(self, policy: Any, worlds: Any, shown: Any, *, deterministic: bool) -> None:
        """Refuses worlds that the policy cannot act in, without or with wrappers (`shown`)."""
        self._policy, self._worlds, self._deterministic = policy, worlds, deterministic
        self._predict: Final[Any] = getattr(policy, "predict", None)
        if self._predict is None and not callable(policy):
            expected = "a function of observations, or a model of Stable-Baselines3"
            raise invalid("policy", expected, repr_of(policy))
        is_masked = self._predict and "action_masks" in inspect.signature(self._predict).parameters
        self._is_masked: Final = bool(is_masked)
        if self._is_masked and not hasattr(worlds, "action_masks"):
            expected = "an environment with action masks, which the policy needs"
            raise invalid("env", expected, "one without")
        seen = shown.single_observation_space
        expected = getattr(policy, "observation_space", seen)
        # A loaded model no longer refers to its `VecNormalize`, but expects other observations.
        is_normalized = getattr(policy, "get_vec_normalize_env", lambda: None)() is not None
        if _content(expected) != _content(seen) or (is_normalized and shown is worlds):
            raise InvalidArgumentError(
                f"policy: expected the observations that it was trained on, {expected}, got "
                f"{seen}: pass the observation= of its training, and if the training wrapped its "
                "worlds, wrap=, such as lambda worlds: VecFrameStack(worlds, 4), or "
                "lambda worlds: VecNormalize.load('statistics.pkl', worlds)"
            )
        begin: Any = getattr(policy, "begin", None)
        if begin is not None:
            begin(worlds.num_envs // worlds.world_spec.n_robots)
        self._state: Any = None
        self._starts: NDArray[np.bool_] = np.ones(worlds.num_envs, np.bool_)

    def act(self, seen: Any) -> NDArray[Any]:
        """Returns the actions for the observations of the worlds as a new array."""
        if self._predict is None:
            actions = self._policy(seen)
        else:
            given: dict[str, Any] = {"state": self._state, "episode_start": self._starts}
            if self._is_masked:
                given["action_masks"] = np.asarray(self._worlds.action_masks(), np.bool_)
            actions, self._state = self._predict(seen, **given, deterministic=self._deterministic)
            self._starts = np.zeros_like(self._starts)
        # A copy, as a policy may reuse its array.
        return np.array(as_array(actions, "policy", "actions, without a state"))


def _content(space: Any) -> Any:
    """Returns what a space and the space of its images with channels first, as in SB3, share."""
    if isinstance(space, spaces.Dict):
        return {name: _content(part) for name, part in cast("Any", space).items()}
    if isinstance(space, spaces.Box):
        box = cast("Any", space)
        return sorted(box.shape), box.dtype, box.low.min(), box.high.max()
    return space
