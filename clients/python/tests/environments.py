"""What the tests of the environments share: small worlds, servers, comparisons."""

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

#: Of its worlds every seed and every step looks different.
LIVELY = str(Path(__file__).with_name("lively.toml"))

#: A description of recorded worlds.
RECORDED = Path(__file__).with_name("recorded.toml")

#: Keywords of a small world.
SMALL: dict[str, Any] = {"height": 7, "width": 5, "n_moves": 4, "burn_in": 50, "model": LIVELY}

#: The same as a server names them.
FLAGS: dict[str, Any] = {"height": 7, "width": 5, "moves": 4, "burn_in": 50, "model": LIVELY}


@contextlib.contextmanager
def serving(**flags: object) -> Iterator[str]:
    """The instance name of a server of `SMALL` worlds; `flags` as on its command line."""
    with contextlib.closing(Server(**{**FLAGS, **flags}, ready=False)) as started:
        yield started.instance


def small_server(**flags: object) -> Server:
    return server(**{**FLAGS, **flags}, ready=False)


def closed_later(env: Any) -> Any:
    at_the_end.callback(env.close)
    return env


def make(name: str = WILDFIRE, **keywords: Any) -> Any:
    """`gymnasium.make` of a small world, or with `instance` of a running server's."""
    return closed_later(gymnasium.make(name, **_usual(name, keywords)))


def make_vec(n_worlds: int, name: str = WILDFIRE, **keywords: Any) -> Any:
    """`gymnasium.make_vec` of small worlds, or with `instance` of a running server's."""
    return closed_later(gymnasium.make_vec(name, num_envs=n_worlds, **_usual(name, keywords)))


@contextlib.contextmanager
def impatient(env: Any, seconds: float = 0.2) -> Iterator[None]:
    """Calls of an environment wait no longer than that."""
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
    """Warnings are errors; Gymnasium's logger warns that way too."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Not what these tests are about: the smallest worlds may hold nothing to find.
        warnings.filterwarnings("ignore", "no cell of world")
        # Rewards, and so features of plans, have no bounds; plans side by side are no picture.
        warnings.filterwarnings("ignore", ".*Box observation space (min|max)imum value is")
        warnings.filterwarnings("ignore", "Your observation  has an unconventional shape")
        yield


def actions(env: Any, n_steps: int, seed: int = 0) -> list[Any]:
    """Random actions of an environment, the same for the same seed."""
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(n_steps)]


def rollout(env: Any, n_steps: int, *, seed: int | None, actions_seed: int = 0) -> list[Any]:
    """What a reset and so many random steps return."""
    return [env.reset(seed=seed), *map(env.step, actions(env, n_steps, actions_seed))]


def assert_same(left: object, right: object, where: str = "") -> None:
    """Equal in every field: types, keys, dtypes, shapes and values."""
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
