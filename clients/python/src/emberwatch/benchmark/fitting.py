"""Checks that worlds have the observations that a model was trained on."""

from typing import Any

from gymnasium import spaces

from emberwatch.errors import InvalidArgumentError


def fits(expected: Any, seen: Any) -> bool:
    """Returns whether a Stable-Baselines3 model for the space `expected` accepts the space `seen`.

    Images may have their channels last in `seen`, because the model itself moves them to the front.
    """
    if isinstance(expected, spaces.Dict) and isinstance(seen, spaces.Dict):
        parts, others = _parts(expected), _parts(seen)
        return parts.keys() == others.keys() and all(fits(parts[it], others[it]) for it in parts)
    if isinstance(expected, spaces.Box) and isinstance(seen, spaces.Box) and len(seen.shape) == 3:
        height, width, n_channels = seen.shape
        if expected.shape == (n_channels, height, width):
            return _values(expected) == _values(seen)
    return bool(expected == seen)


def shapes(space: Any) -> Any:
    """Returns the shape of a space, or the shapes of its parts by name."""
    if isinstance(space, spaces.Dict):
        return {name: shapes(part) for name, part in _parts(space).items()}
    return space.shape


def misfit(expected: Any, seen: Any) -> InvalidArgumentError:
    """Returns the error for a model that was trained on other observations."""
    wrap = "lambda worlds: VecFrameStack(worlds, 4)"
    if shapes(expected) == shapes(seen):
        wrap = "lambda worlds: VecNormalize.load('statistics.pkl', worlds)"
    return InvalidArgumentError(
        f"policy: expected the observations that it was trained on, {expected}, got {seen}: pass "
        f"the observation= of its training, and if the training wrapped its worlds, wrap=, such as "
        f"{wrap}"
    )


def _parts(space: Any) -> dict[str, Any]:
    return dict(space.spaces)


def _values(box: Any) -> tuple[Any, float, float]:
    return box.dtype, float(box.low.min()), float(box.high.max())
