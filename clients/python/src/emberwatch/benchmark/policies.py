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
    """A policy that acts in one batch of worlds after another, with its state in this batch."""

    def __init__(self, policy: Any, *, deterministic: bool) -> None:
        """Determines the parameters of the policy, a function or an object with `predict`."""
        self._call: Any = getattr(policy, "predict", policy)
        if not callable(self._call):
            expected = "a function of observations, or a model of Stable-Baselines3"
            raise invalid("policy", expected, repr_of(policy))
        # If the policy is a method of a model, this is the model.
        self._model: Any = getattr(policy, "__self__", policy)
        self._begin: Any = getattr(policy, "begin", None)
        self._deterministic: Final = deterministic
        try:
            # The first parameter is the observation, whatever its name.
            parameters = list(inspect.signature(self._call).parameters.values())[1:]
        except (TypeError, ValueError):  # written in C
            parameters = []
        self._takes = {each.name for each in parameters}
        if self._call is not policy and any(it.kind is it.VAR_KEYWORD for it in parameters):
            self._takes |= {"state", "episode_start", "deterministic"}
        self._needs = {each.name for each in parameters if each.default is each.empty}
        #: The `VecNormalize` of the training, unless wrappers normalize the observations.
        self._normalizer: Any = getattr(self._model, "get_vec_normalize_env", lambda: None)()
        if not getattr(self._normalizer, "norm_obs", True):
            self._normalizer = None
        self._state: Any = None
        self._starts: NDArray[np.bool_] = np.empty(0, np.bool_)

    def check(self, worlds: Any, shown: Any) -> None:
        """Refuses worlds that the policy cannot act in, without or with wrappers (`shown`)."""
        if "action_masks" in self._needs and not hasattr(worlds, "action_masks"):
            expected = "an environment with action masks, which the policy needs"
            raise invalid("env", expected, "one without")
        if shown is not worlds:  # wrappers normalize the observations
            self._normalizer = None
        seen = shown.single_observation_space
        expected = getattr(self._model, "observation_space", seen)
        # Normalization changes the bounds.
        content: Any = _content if self._normalizer is None else spaces.flatdim
        if content(expected) != content(seen):
            raise InvalidArgumentError(
                f"policy: expected the observations that it was trained on, {expected}, got "
                f"{seen}: pass the observation= of its training, and if the training wrapped its "
                "worlds, wrap=, such as lambda worlds: VecFrameStack(worlds, 4), or "
                "lambda worlds: VecNormalize.load('statistics.pkl', worlds)"
            )

    def begin(self, n_worlds: int, n_rows: int) -> None:
        """Resets the state for a new batch of worlds, and calls the policy's `begin`, if any."""
        if self._begin is not None:
            self._begin(n_worlds)
        self._state, self._starts = None, np.ones(n_rows, np.bool_)

    def act(self, seen: Any, worlds: Any) -> NDArray[Any]:
        """Returns the actions for the observations of some worlds as a new array."""
        if self._normalizer is not None:
            seen = self._normalizer.normalize_obs(seen)
        offered = {
            "state": self._state,
            "episode_start": self._starts,
            "deterministic": self._deterministic,
        }
        if "action_masks" in self._takes and hasattr(worlds, "action_masks"):
            offered["action_masks"] = np.asarray(worlds.action_masks(), np.bool_)
        result: Any = self._call(seen, **{it: offered[it] for it in offered if it in self._takes})
        self._state, self._starts = None, np.zeros_like(self._starts)
        if _is_pair(result, worlds.action_space.shape):
            result, self._state = result
        if self._state is not None and "state" not in self._takes:
            raise InvalidArgumentError(
                "policy: it returns a state with its actions, but has no parameter `state` for the "
                "next call: pass the model itself, or return only the actions"
            )
        return np.array(as_array(result, "policy", "actions"))  # a policy may reuse its array


def _is_pair(result: Any, shape: tuple[int, ...]) -> bool:
    """Returns whether a result has actions and a state, instead of the actions of two rows."""
    parts = cast("tuple[Any, ...]", result) if isinstance(result, tuple) else ()
    return len(parts) == 2 and as_array(parts[0], "policy", "actions").shape == shape


def _content(space: Any) -> Any:
    """Returns what a space and the space of its images with channels first, as in SB3, share."""
    if isinstance(space, spaces.Dict):
        return {name: _content(part) for name, part in cast("Any", space).items()}
    if isinstance(space, spaces.Box):
        box = cast("Any", space)
        return sorted(box.shape), box.dtype, box.low.min(), box.high.max()
    return space
