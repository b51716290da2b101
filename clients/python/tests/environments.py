"""Helpers for the tests of the environments: small worlds, servers, comparisons."""

import contextlib
import dataclasses
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from processes import Server, at_the_end, server

WILDFIRE = "emberwatch/Wildfire-v0"
MOVES = "emberwatch/WildfireMoves-v0"
OBJECTIVE = "emberwatch/WildfireObjective-v1"

#: A model whose worlds look different at every seed and every step.
LIVELY = str(Path(__file__).with_name("lively.toml"))

#: A description of recorded worlds.
RECORDED = Path(__file__).with_name("recorded.toml")

#: Keyword arguments of a small world.
SMALL: dict[str, Any] = {"height": 7, "width": 5, "n_moves": 4, "burn_in": 50, "model": LIVELY}

#: The same settings by the names of a server's flags.
FLAGS: dict[str, Any] = {"height": 7, "width": 5, "moves": 4, "burn_in": 50, "model": LIVELY}


@contextlib.contextmanager
def serving(**flags: object) -> Iterator[str]:
    """Starts a server of `SMALL` worlds with `flags`. Yields its instance name."""
    with contextlib.closing(Server(**{**FLAGS, **flags}, ready=False)) as started:
        yield started.instance


def small_server(**flags: object) -> Server:
    return server(**{**FLAGS, **flags}, ready=False)


def closed_later(env: Any) -> Any:
    at_the_end.callback(env.close)
    return env


def make(name: str = WILDFIRE, **keywords: Any) -> Any:
    """Calls `gymnasium.make` for a small world, or with `instance` for a server's world."""
    return closed_later(gymnasium.make(name, **_usual(name, keywords)))


def make_vec(n_worlds: int, name: str = WILDFIRE, **keywords: Any) -> Any:
    """Calls `gymnasium.make_vec` for small worlds, or with `instance` for a server's worlds."""
    return closed_later(gymnasium.make_vec(name, num_envs=n_worlds, **_usual(name, keywords)))


@contextlib.contextmanager
def impatient(env: Any, seconds: float = 0.2) -> Iterator[None]:
    """Limits how long calls of an environment wait."""
    session = env.unwrapped._session
    kept = session.settings
    session.settings = dataclasses.replace(kept, timeout=seconds)
    yield
    session.settings = kept


def _usual(name: str, keywords: dict[str, Any]) -> dict[str, Any]:
    usual = {} if keywords.get("instance") is not None else SMALL
    return {**usual, **({"prior": "initial"} if name == OBJECTIVE else {}), **keywords}


@contextlib.contextmanager
def no_warnings() -> Iterator[None]:
    """Turns warnings into errors, including those of Gymnasium's logger."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Irrelevant to these tests: the smallest worlds may contain nothing to find.
        warnings.filterwarnings("ignore", "no cell of world")
        # Rewards and features of plans are unbounded, and a table of plans is not an image.
        warnings.filterwarnings("ignore", ".*Box observation space (min|max)imum value is")
        warnings.filterwarnings("ignore", "Your observation  has an unconventional shape")
        yield


def actions(env: Any, n_steps: int, seed: int = 0) -> list[Any]:
    """Returns random actions of an environment, which depend only on the seed."""
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(n_steps)]


def rollout(env: Any, n_steps: int, *, seed: int | None, actions_seed: int = 0) -> list[Any]:
    """Returns the results of a reset and `n_steps` random steps."""
    return [env.reset(seed=seed), *map(env.step, actions(env, n_steps, actions_seed))]


def assert_same(left: object, right: object, where: str = "") -> None:
    """Asserts that two values have the same types, keys, dtypes, shapes and values."""
    assert type(left) is type(right), f"{where}: {type(left)} and {type(right)}"
    if isinstance(left, Mapping) and isinstance(right, Mapping):
        assert set(left) == set(right), f"{where}: {sorted(left)} and {sorted(right)}"
        for key in left:
            assert_same(left[key], right[key], f"{where}[{key!r}]")
    elif isinstance(left, np.ndarray) and isinstance(right, np.ndarray):
        assert left.dtype == right.dtype, f"{where}: {left.dtype} and {right.dtype}"
        assert left.shape == right.shape, f"{where}: {left.shape} and {right.shape}"
        if left.dtype == object:
            assert_same(list(left.flat), list(right.flat), where)
        else:
            assert np.array_equal(left, right), f"{where}:\n{left}\nand\n{right}"
    elif isinstance(left, Sequence) and isinstance(right, Sequence) and not isinstance(left, str):
        assert len(left) == len(right), f"{where}: {len(left)} and {len(right)} items"
        for index, (one, other) in enumerate(zip(left, right, strict=True)):
            assert_same(one, other, f"{where}[{index}]")
    else:
        assert left == right, f"{where}: {left} and {right}"
