"""Digests of policies: rows of a file belong to the same policy only if its digest is equal."""

import functools
import logging
import random
import subprocess
import sys
import threading
from argparse import Namespace
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emberwatch.benchmark.digest import digest

BIAS = 3


class Move(Enum):
    UP = 0
    DOWN = 1


@dataclass
class Greedy:
    weights: Any
    temperature: float = 1.0

    def __call__(self, frames: Any) -> Any:
        return frames @ self.weights

    def other(self, frames: Any) -> Any:
        return -(frames @ self.weights)


class Slotted:
    __slots__ = ("weights",)

    def __init__(self, weights: Any) -> None:
        self.weights = weights


class Learned:
    """Imitates a model of Stable-Baselines3."""

    exploration_rate = 0.1

    def __init__(self, weight: float, moments: float = 0.0) -> None:
        self.started = object()
        self.moments, self.weight = moments, weight

    def get_parameters(self) -> dict[str, Any]:
        tensors = {"net.weight": np.full(3, self.weight)}
        return {"policy": tensors, "policy.optimizer": {"state": self.moments}}


class Broken:
    """An object whose attributes cannot be read."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __getstate__(self) -> Any:
        raise RuntimeError("no state")

    def state_dict(self) -> Any:
        raise RuntimeError("no weights")


def closing(value: Any) -> Callable[[Any], Any]:
    return lambda frames: value


def defaulting(value: Any) -> Callable[[Any], Any]:
    return lambda frames, value=value: value


def keyword(value: Any) -> Callable[[Any], Any]:
    def act(frames: Any, *, value: Any = value) -> Any:
        return value

    return act


def decorated(value: Any) -> Callable[[Any], Any]:
    @functools.lru_cache
    def act(frames: Any) -> Any:
        return value

    return act


def deep(value: Any) -> Any:
    for _ in range(500):
        value = [value]
    return value


def circle(value: Any) -> Any:
    parts: list[Any] = [value]
    parts.append(parts)
    return parts


def compiled(text: str, **names: Any) -> Any:
    """Returns a function as if the user's script defined it."""
    exec(text, names)
    return names["act"]


ADDS = "def act(frames):\n return inner(frames) + 1\ndef inner(frames):\n return frames * {}"
READS = "import math\ndef act(frames):\n return [bias for _ in frames]"

DIFFERENT = {
    "closures": (closing(1), closing(2)),
    "types of numbers": (closing(1), closing(1.0)),
    "defaults": (defaulting(1), defaulting(2)),
    "keywords": (keyword(1), keyword(2)),
    "code": (lambda frames: frames + 1, lambda frames: frames - 1),
    "names": (lambda frames: frames.min(), lambda frames: frames.max()),
    "inner functions": (lambda x: [y + 1 for y in x], lambda x: [y + 2 for y in x]),
    "arrays": (closing(np.zeros(9)), closing(np.ones(9))),
    "shapes": (closing(np.zeros((3, 2))), closing(np.zeros((2, 3)))),
    "kinds of arrays": (closing(np.zeros(3)), closing(np.zeros(3, np.float32))),
    "lists": (closing([1, [2, 3]]), closing([1, [2, 4]])),
    "long lists": (closing([0.0] * 10**6), closing([0.0] * 10**6 + [1.0])),
    "mappings": (closing({"a": 1}), closing({"a": 2})),
    "sets": (closing({1, 2}), closing({1, 3})),
    "options": (closing(Move.UP), closing(Move.DOWN)),
    "namespaces": (closing(Namespace(beam=3)), closing(Namespace(beam=4))),
    "globals": (compiled(READS, bias=1), compiled(READS, bias=2)),
    "functions called": (compiled(ADDS.format(1)), compiled(ADDS.format(2))),
    "partials": (functools.partial(max, 1), functools.partial(max, 2)),
    "functions of partials": (functools.partial(max, 1), functools.partial(min, 1)),
    "decorated": (decorated(1), decorated(2)),
    "objects": (Greedy(np.zeros(3)), Greedy(np.ones(3))),
    "methods": (Greedy(None).__call__, Greedy(None).other),
    "objects of methods": (Greedy(1).other, Greedy(2).other),
    "slots": (Slotted(1), Slotted(2)),
    "types": (Greedy(None), Slotted(None)),
    "functions of modules": (np.argmax, np.argmin),
    "models": (Learned(1.0), Learned(2.0)),
    "models within": (closing({"net": Learned(1.0)}), closing({"net": Learned(2.0)})),
    "values that contain themselves": (circle(1), circle(2)),
    "keys": (closing({1: "a"}), closing({"1": "a"})),
}

SAME = {
    "functions": (closing(1), closing(1)),
    "arrays": (closing(np.arange(9)), closing(np.arange(9))),
    "strides": (closing(np.arange(6)[::2]), closing(np.array([0, 2, 4]))),
    "lists and tuples": (closing([1, 2]), closing((1, 2))),
    "order of keys": (closing({"a": 1, "b": 2}), closing({"b": 2, "a": 1})),
    "generators, which advance": (
        closing(np.random.default_rng(1)),
        closing(np.random.default_rng(2)),
    ),
    "generators of Python": (closing(random.Random(1)), closing(random.Random(2))),
    "queues": (closing(deque([1])), closing(deque([2]))),
    "optimizers": (Learned(1.0, 0.0), Learned(1.0, 9.0)),
    "locks": (closing(threading.Lock()), closing(threading.Lock())),
    "values that cannot be read": (Broken(1), Broken(2)),
    "values nested beyond the limit": (deep(1), deep(2)),
}


def test_digests_are_equal_only_for_equal_policies() -> None:
    for name, pair in DIFFERENT.items():
        assert digest(pair[0]) != digest(pair[1]), name
        assert [digest(each) for each in pair] == [digest(each) for each in pair], name
    for name, pair in SAME.items():
        assert digest(pair[0]) == digest(pair[1]), name


def test_loggers_and_modules_are_hashed_by_name() -> None:
    def act(frames: Any) -> Any:
        logging.getLogger(__name__).debug(BIAS)
        return np.argmax(frames) + sys.maxsize

    before = digest(act)
    logging.getLogger("another").addHandler(logging.NullHandler())
    assert digest(act) == before


def test_a_digest_is_the_same_in_another_process(tmp_path: Path) -> None:
    program = tmp_path / "policy.py"
    program.write_text(
        "import numpy as np\n"
        "from emberwatch.benchmark.digest import digest\n"
        "WORDS = {'ab', 'cd', 'ef'}\n"
        "class Net:\n"
        "    rate = 0.5\n"
        "    def __init__(self): self.weights, self.parent = np.ones(4), self\n"
        "    def act(self, frames): return helper(self, frames) if 'ab' in WORDS else act\n"
        "def helper(net, frames): return net.act(frames)\n"
        "print(digest(Net().act))\n"
    )
    runs = [
        subprocess.run(
            [sys.executable, program], capture_output=True, text=True, check=True, timeout=60
        ).stdout
        for _ in range(3)
    ]
    assert len(set(runs)) == 1 and len(runs[0].strip()) == 16


def test_tensors_are_hashed_by_value_and_networks_by_code() -> None:
    torch = pytest.importorskip("torch")
    for kind in (torch.float32, torch.bfloat16):
        weights = torch.ones(3, dtype=kind, requires_grad=True)
        other = torch.full((3,), 2, dtype=kind)
        assert digest(closing(weights)) == digest(closing(weights.detach().clone()))
        assert digest(closing(weights)) != digest(closing(other))

    class Net(torch.nn.Module):
        def __init__(self, temperature: float = 1.0) -> None:
            super().__init__()
            torch.manual_seed(0)
            self.layer, self.temperature = torch.nn.Linear(3, 2), temperature

        def forward(self, frames: Any) -> Any:
            return self.layer(frames) / self.temperature

    net = Net()
    before = digest(net)
    net.eval()(torch.zeros(1, 3)).sum().backward()
    assert digest(net) == before == digest(Net())
    assert digest(Net(0.5)) != before

    @torch.no_grad()
    def act(frames: Any) -> Any:
        return net(frames)

    acting = digest(act)
    with torch.no_grad():
        net.layer.weight += 1
    assert digest(net) != before and digest(act) != acting
