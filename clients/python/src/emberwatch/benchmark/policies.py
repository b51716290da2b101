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

from emberwatch.common.arguments import as_array, repr_of
from emberwatch.errors import InvalidArgumentError, invalid

#: A function from stacked observations to actions, or a model of SB3.
Policy: TypeAlias = Callable[..., Any]

#: Arguments that a policy receives if it has parameters with these names.
_STATE: Final = "state"
_STARTS: Final = "episode_start"
_DETERMINISTIC: Final = "deterministic"
_MASKS: Final = "action_masks"


class Actor:
    """A policy that acts in one batch of worlds after another, with its state in this batch."""

    def __init__(self, policy: object, *, deterministic: bool) -> None:
        """Determines the parameters of the policy, a function or an object with `predict`."""
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
        #: Normalizes observations as in the training, unless wrappers do so.
        self._normalizer = _normalizer(self._model)
        self._state: Any = None
        self._starts: NDArray[np.bool_] = np.empty(0, np.bool_)

    def check(self, worlds: Any, wrapped: Any) -> None:
        """Refuses worlds that the policy cannot act in.

        Args:
            worlds: A vector environment.
            wrapped: The environment behind the wrappers of the policy's training, or None. If
                given, these normalize the observations.
        """
        if _MASKS in self._needs and not hasattr(worlds, _MASKS):
            expected = "an environment with action masks, which the policy needs"
            raise invalid("env", expected, "one without")
        seen = (worlds if wrapped is None else wrapped).single_observation_space
        normalizer = self._normalizer
        if wrapped is not None:
            if normalizer is not None and not wrapped.is_normalized:
                raise InvalidArgumentError(
                    "wrap: expected a VecNormalize among the wrappers, as the policy was trained "
                    "behind one, got none"
                )
            self._normalizer = None
        elif normalizer is not None:
            inner = getattr(getattr(normalizer, "venv", None), "observation_space", seen)
            if _shapes(inner) != _shapes(seen):  # `VecNormalize` changes bounds of its own space
                raise _misfit(inner, seen)
            seen = getattr(normalizer, "observation_space", seen)
        expected: Any = getattr(self._model, "observation_space", None)
        if isinstance(expected, spaces.Space) and not _fits(expected, seen):
            raise _misfit(expected, seen)

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
        if _STARTS in self._takes:
            given[_STARTS], self._starts = self._starts, np.zeros_like(self._starts)
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


def _normalizer(model: Any) -> Any:
    """Returns the `VecNormalize` of a model's training, if it normalized observations."""
    known = getattr(model, "get_vec_normalize_env", None)
    normalizer: Any = known() if callable(known) else None
    return normalizer if getattr(normalizer, "norm_obs", True) else None


def _misfit(expected: Any, seen: Any) -> InvalidArgumentError:
    return InvalidArgumentError(
        f"policy: expected the observations that it was trained on, {expected}, got {seen}: pass "
        "the observation= of its training, and if the training wrapped its worlds, wrap=, such as "
        "lambda worlds: VecFrameStack(worlds, 4), or "
        "lambda worlds: VecNormalize.load('statistics.pkl', worlds)"
    )


def _shapes(space: Any) -> Any:
    """Returns the shape of a space, or the shapes of its parts by name."""
    if isinstance(space, spaces.Dict):
        return {name: part.shape for name, part in _parts(space).items()}
    return space.shape


def _fits(expected: Any, seen: Any) -> bool:
    if isinstance(expected, spaces.Dict) and isinstance(seen, spaces.Dict):
        parts, others = _parts(expected), _parts(seen)
        return parts.keys() == others.keys() and all(_fits(parts[it], others[it]) for it in parts)
    return bool(expected == seen or expected == _with_channels_first(seen))


def _parts(space: Any) -> dict[str, Any]:
    return dict(space.spaces)


def _with_channels_first(image: Any) -> Any:
    """Returns the space to which SB3 itself transposes images."""
    if len(image.shape or ()) != 3:
        return None
    low, high = np.moveaxis(image.low, 2, 0), np.moveaxis(image.high, 2, 0)
    return spaces.Box(low, high, dtype=image.dtype)


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
    needed = {name for name, each in known.items() if each.default is each.empty}
    return takes, takes & needed


def _shape(actions: Any) -> tuple[int, ...] | None:
    try:
        return tuple(np.shape(actions))
    except Exception:  # any type, for example for lists of different lengths
        return None
