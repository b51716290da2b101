"""Whether the observations of worlds are those that a model was trained on."""

from typing import Any

from gymnasium import spaces

from emberwatch.errors import InvalidArgumentError


def fits(expected: Any, seen: Any) -> bool:
    """Whether a model of Stable-Baselines3 that expects one space takes observations of another.

    The model itself puts the channels of images first.
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
    """Returns the shape of a space, or those of its parts by name."""
    if isinstance(space, spaces.Dict):
        return {name: shapes(part) for name, part in _parts(space).items()}
    return space.shape


def misfit(expected: Any, seen: Any) -> InvalidArgumentError:
    """Returns the error of a model that was trained on other observations."""
    wrap = "lambda worlds: VecFrameStack(worlds, 4)"
    if shapes(expected) == shapes(seen):
        wrap = "lambda worlds: VecNormalize.load('statistics.pkl', worlds)"
    return InvalidArgumentError(
        f"policy: expected observations {expected}, on which it was trained, got {seen}: pass the "
        f"observation= of its training, and if that wrapped its worlds, wrap=, such as {wrap}"
    )


def _parts(space: Any) -> dict[str, Any]:
    return dict(space.spaces)


def _values(box: Any) -> tuple[Any, float, float]:
    return box.dtype, float(box.low.min()), float(box.high.max())
