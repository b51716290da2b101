"""Calls of policies: functions of observations, and models with the `predict` of SB3.

SB3 is Stable-Baselines3. Its models may be recurrent (RecurrentPPO), take action masks
(MaskablePPO), and expect observations that passed through the wrappers of their training.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, Final, Protocol, TypeAlias, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from emberwatch.benchmark.fitting import fits, misfit, shapes
from emberwatch.common.arguments import as_array, repr_of
from emberwatch.errors import InvalidArgumentError, invalid

#: A function from stacked observations to actions, or a model of SB3.
Policy: TypeAlias = Callable[..., Any]

#: Arguments that a policy receives if it has parameters with these names.
_STATE: Final = "state"
_STARTS: Final = "episode_start"
_DETERMINISTIC: Final = "deterministic"
_MASKS: Final = "action_masks"

#: The name of `episode_start` in SB3 before 1.4. A parameter `mask` has this meaning only next to
#: the other parameters of SB3's `predict`.
_OLD_STARTS: Final = "mask"
_OLD: Final = frozenset((_STATE, _OLD_STARTS, _DETERMINISTIC))


class Normalizer(Protocol):
    """The method of SB3's `VecNormalize` that is used here."""

    def normalize_obs(self, obs: Any) -> Any: ...


class Actor:
    """A policy that acts in one batch of worlds after another, with its state in this batch."""

    def __init__(self, policy: object, *, deterministic: bool, is_wrapped: bool) -> None:
        """Determines the parameters of the policy.

        Args:
            policy: A function, or an object with `predict`.
            deterministic: Argument of `predict`.
            is_wrapped: Whether observations pass through the wrappers of the policy's training.
                If False, they are normalized here, provided that the model has a `VecNormalize`.
        """
        predict = getattr(policy, "predict", None)
        self._call: Any = policy if predict is None else predict
        if not callable(self._call):
            expected = "a function of observations, or a model of Stable-Baselines3"
            raise invalid("policy", expected, repr_of(policy))
        # If the policy is a method of a model, this is the model.
        self._model: Any = getattr(policy, "__self__", policy)
        self._begin: Any = getattr(policy, "begin", None)
        self._deterministic: Final = deterministic
        self._takes, self._needs = _parameters(self._call, is_model=predict is not None)
        known = getattr(self._model, "get_vec_normalize_env", None)
        normalizer: Any = known() if callable(known) else None
        has_one = normalizer is not None and getattr(normalizer, "norm_obs", True)
        #: The `VecNormalize` of the model's training, if it normalized observations.
        self.normalizers = cast("list[Normalizer]", [normalizer] if has_one else [])
        self._normalizer: Final = normalizer if has_one and not is_wrapped else None
        self._state: Any = None
        self._starts: NDArray[np.bool_] = np.empty(0, np.bool_)

    def check(self, worlds: Any, seen: Any) -> None:
        """Refuses worlds that the policy cannot act in.

        Args:
            worlds: A vector environment.
            seen: The observation space of the environment, or of its wrappers.
        """
        if _MASKS in self._needs and not hasattr(worlds, _MASKS):
            expected = "an environment with action masks, which the policy needs"
            raise invalid("env", expected, "one without")
        if self._normalizer is not None:
            inner = getattr(getattr(self._normalizer, "venv", None), "observation_space", seen)
            if shapes(inner) != shapes(seen):
                raise misfit(inner, seen)
            seen = getattr(self._normalizer, "observation_space", seen)
        expected: Any = getattr(self._model, "observation_space", None)
        if isinstance(expected, spaces.Space) and not fits(expected, seen):
            raise misfit(expected, seen)

    def begin(self, n_worlds: int, n_rows: int) -> None:
        """Resets the state for a new batch of worlds, and calls the policy's `begin`, if any."""
        if self._begin is not None:
            self._begin(n_worlds)
        self._state, self._starts = None, np.ones(n_rows, np.bool_)

    def act(self, seen: Any, worlds: Any) -> NDArray[Any]:
        """Returns the actions for the observations of some worlds as a new array."""
        if self._normalizer is not None:
            seen = self._normalizer.normalize_obs(seen)
        outcome = self._call(seen, **self._given(worlds)) if self._takes else self._call(seen)
        actions = self._actions(outcome, worlds)
        return np.array(as_array(actions, "policy", "actions"))  # a policy may reuse its array

    def _given(self, worlds: Any) -> dict[str, Any]:
        given: dict[str, Any] = {}
        if _STATE in self._takes:
            given[_STATE] = self._state
        for name in self._takes & {_STARTS, _OLD_STARTS}:
            given[name], self._starts = self._starts, np.zeros_like(self._starts)
        if _DETERMINISTIC in self._takes:
            given[_DETERMINISTIC] = self._deterministic
        if _MASKS in self._takes and hasattr(worlds, _MASKS):
            given[_MASKS] = np.asarray(worlds.action_masks(), np.bool_)
        return given

    def _actions(self, outcome: Any, worlds: Any) -> Any:
        """Extracts the actions from a policy's result: actions, or a pair of actions and state."""
        parts = cast("tuple[Any, ...]", outcome) if isinstance(outcome, tuple) else ()
        if len(parts) != 2 or _shape(parts[0]) != worlds.action_space.shape:
            self._state = None
            return cast("Any", outcome)
        actions, self._state = parts
        if self._state is not None and _STATE not in self._takes:
            raise InvalidArgumentError(
                "policy: it returns a state with its actions, but has no parameter `state` for the "
                "next call: pass the model itself, or return only the actions"
            )
        return actions


def statistics(normalizer: Normalizer) -> dict[str, Any]:
    """Returns the statistics and settings of a normalization."""
    names = ("obs_rms", "clip_obs", "epsilon", "norm_obs", "norm_obs_keys")
    return {name: getattr(normalizer, name, None) for name in names}


def _parameters(call: Callable[..., Any], *, is_model: bool) -> tuple[set[str], set[str]]:
    """Returns the names of the arguments that a policy takes, and which of them have no default."""
    try:
        parameters = list(inspect.signature(call).parameters.values())
    except (TypeError, ValueError):  # written in C
        return set(), set()
    # The first parameter is the observation, whatever its name.
    kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    known = {each.name: each for each in parameters[1:] if each.kind in kinds}
    takes = known.keys() & {_STATE, _STARTS, _DETERMINISTIC, _MASKS}
    if is_model and any(each.kind is each.VAR_KEYWORD for each in parameters):
        takes |= {_STATE, _STARTS, _DETERMINISTIC}
    if is_model and _OLD <= known.keys() and _STARTS not in takes:
        takes.add(_OLD_STARTS)
    needed = {name for name, each in known.items() if each.default is each.empty}
    return takes, takes & needed


def _shape(actions: Any) -> tuple[int, ...] | None:
    try:
        return tuple(np.shape(actions))
    except Exception:  # any type, for example for lists of different lengths
        return None
