"""Which worlds an environment acts on: its keywords, their defaults and checks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypedDict

import numpy as np

from emberwatch.client import STEP_TIMEOUT
from emberwatch.errors import SettingError
from emberwatch.model import Model
from emberwatch.replies import ServerInfo

#: Longest side of a grid and longest path of any server (PROTOCOL.md section 1).
_MAX_SIDE: Final = 4096
_MAX_MOVES: Final = 4096

#: Seeds drawn for resets stay below this, which every JSON reader holds (PROTOCOL.md section 2).
SEEDS: Final = 2**53


class WorldArguments(TypedDict, total=False):
    """The keywords that say which worlds to act on, the same for every environment."""

    instance: str | None
    world: int
    takeover: bool
    model: str | os.PathLike[str] | None
    height: int | None
    width: int | None
    n_moves: int | None
    burn_in: int | None
    start: str | None
    truth: bool
    timeout: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """The same with defaults. None: the default, or for a running server whatever it has."""

    instance: str | None = None
    world: int = 0
    takeover: bool = False
    model: str | os.PathLike[str] | None = None
    height: int | None = None
    width: int | None = None
    n_moves: int | None = None
    burn_in: int | None = None
    start: str | None = None
    truth: bool = False
    timeout: float = STEP_TIMEOUT

    @property
    def model_argument(self) -> str:
        """The model as the programs take it."""
        return "wildfire" if self.model is None else os.fspath(self.model)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """What decides the spaces."""

    height: int
    width: int
    n_moves: int
    n_observations: int


def check_seeds(seeds: Sequence[int]) -> None:
    """Refuses seeds that do not fit into the wire's 64 bits.

    Raises:
        SettingError: Naming one.
    """
    for seed in seeds:
        if not 0 <= seed < 2**64:
            raise SettingError(f"seed: expected 0 to 2**64 - 1, got {seed}")


def draw_seed(generator: np.random.Generator) -> int:
    """The world's seed of a reset without one: the environment's own generator goes on."""
    return int(generator.integers(SEEDS))


def private_world(settings: Settings) -> tuple[Model, Shape, int]:
    """Model, shape and burn-in of the worlds that a private server will have.

    Raises:
        SettingError: Naming an impossible value.
        ModelError: If the model file makes no sense.
    """
    if settings.takeover or settings.world != 0:
        raise SettingError(
            "takeover, world: expected instance=..., a running server to attach to; a private "
            f"server has its own worlds, got world {settings.world}"
        )
    named = settings.model_argument
    model = Model.wildfire() if named == "wildfire" else Model.read(Path(named))
    shape = Shape(
        height=check_count("height", settings.height, 64, _MAX_SIDE),
        width=check_count("width", settings.width, 64, _MAX_SIDE),
        n_moves=check_count("n_moves", settings.n_moves, 64, _MAX_MOVES),
        n_observations=len(model.observation_names),
    )
    burn_in = 10_000 if settings.burn_in is None else settings.burn_in
    if burn_in < 0:
        raise SettingError(f"burn_in: expected steps, at least 0, got {burn_in}")
    return model, shape, burn_in


def running_world(
    settings: Settings, n_worlds: int, info: ServerInfo
) -> tuple[Model | None, Shape, int]:
    """Model (if revealed), shape and burn-in of a running server's worlds.

    Raises:
        SettingError: Naming what the settings want otherwise.
    """
    for name in ("model", "start"):
        if getattr(settings, name) is not None:
            raise SettingError(f"{name}: expected None, as the running server has its own")
    for name in ("height", "width", "n_moves", "burn_in"):
        asked, has = getattr(settings, name), getattr(info, name)
        if asked is not None and asked != has:
            raise SettingError(f"{name}: expected {has}, as the server has, or None, got {asked}")
    last = settings.world + n_worlds - 1
    if settings.world < 0 or last >= info.n_worlds:
        raise SettingError(
            f"world: expected worlds within 0 to {info.n_worlds - 1}, "
            f"got {settings.world} to {last}"
        )
    if settings.truth and not info.publish_truth:
        raise SettingError("truth: expected a server started with --publish-truth, got one without")
    shape = Shape(
        height=info.height,
        width=info.width,
        n_moves=info.n_moves,
        n_observations=info.n_observations,
    )
    model = None if info.model is None else Model.from_toml(info.model)
    return model, shape, info.burn_in


def check_count(name: str, value: int | None, default: int, highest: int) -> int:
    """A keyword that counts something, or its default.

    Raises:
        SettingError: If it is not within 1 to `highest`.
    """
    if value is None:
        return default
    if not 1 <= value <= highest or int(value) != value:
        raise SettingError(f"{name}: expected an integer within 1 to {highest}, got {value}")
    return value
