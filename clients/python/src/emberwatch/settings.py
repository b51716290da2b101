"""Which worlds an environment acts on: its keywords, their defaults and checks."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from difflib import get_close_matches
from inspect import signature
from typing import Any, Final, TypedDict

import numpy as np

from emberwatch.errors import SettingError
from emberwatch.model import Model
from emberwatch.ports import STEP_TIMEOUT
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

    def __post_init__(self) -> None:
        """Checks what does not depend on a server.

        Raises:
            SettingError: Naming a keyword, what it expects, and what it got.
        """
        self._check("instance", "a name or None", _is(self.instance, str, type(None)))
        is_model = _is(self.model, str, os.PathLike, type(None))
        self._check("model", "a name, a path or None", is_model)
        self._check("start", "a text or None", _is(self.start, str, type(None)))
        self._check("takeover", "True or False", _is(self.takeover, bool))
        self._check("truth", "True or False", _is(self.truth, bool))
        self._check("world", "an integer, at least 0", _is_integer(self.world) and self.world >= 0)
        burn_in = 0 if self.burn_in is None else self.burn_in
        is_steps = _is_integer(burn_in) and 0 <= burn_in < 2**63
        self._check("burn_in", "a number of steps, at least 0, or None", is_steps)
        is_time = _is_number(self.timeout) and self.timeout > 0
        self._check("timeout", "seconds above 0", is_time)

    @classmethod
    def of(cls, environment: type, world: WorldArguments) -> Settings:
        """The settings of an environment, from what is left of its keywords.

        Raises:
            SettingError: Naming a keyword that is none, the one most alike, and all there are.
        """
        known = {
            name
            for name, parameter in signature(environment.__init__).parameters.items()
            if parameter.kind is parameter.KEYWORD_ONLY
        }
        known |= set(WorldArguments.__annotations__)
        for name in world:
            if name not in known:
                alike = get_close_matches(name, known, 1)
                hint = f" (did you mean {alike[0]!r}?)" if alike else ""
                expected = ", ".join(sorted(known))
                raise SettingError(f"keywords: expected some of {expected}, got {name!r}{hint}")
        return cls(**world)

    def _check(self, name: str, expected: str, is_right: bool) -> None:
        if not is_right:
            raise SettingError(f"{name}: expected {expected}, got {getattr(self, name)!r}")

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
    model = Model.named(settings.model_argument)
    shape = Shape(
        height=check_count("height", settings.height, 64, _MAX_SIDE),
        width=check_count("width", settings.width, 64, _MAX_SIDE),
        n_moves=check_count("n_moves", settings.n_moves, 64, _MAX_MOVES),
        n_observations=len(model.observation_names),
    )
    if settings.start is not None:
        _check_start(settings.start, shape)
    return model, shape, 10_000 if settings.burn_in is None else settings.burn_in


def _check_start(start: str, shape: Shape) -> None:
    cell = re.fullmatch(r"(\d{1,9}),(\d{1,9})", start)
    is_cell = cell is not None and int(cell[1]) < shape.height and int(cell[2]) < shape.width
    if start not in ("corner", "centre", "random") and not is_cell:
        raise SettingError(
            "start: expected corner, centre, random or ROW,COL within "
            f"{shape.height} x {shape.width} cells, got {start!r}"
        )


def running_world(
    settings: Settings, n_worlds: int, info: ServerInfo
) -> tuple[Model | None, Shape, int]:
    """Model (if revealed), shape and burn-in of a running server's worlds.

    Raises:
        SettingError: Naming what the settings want otherwise.
    """
    if settings.start is not None:
        raise SettingError("start: expected None, as the running server has its own")
    if settings.model is not None and info.model is not None:
        raise SettingError("model: expected None, as the running server reveals its own")
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
    if settings.model is not None:
        return Model.named(settings.model_argument), shape, info.burn_in
    return None if info.model is None else Model.from_toml(info.model), shape, info.burn_in


def check_count(name: str, value: int | None, default: int, highest: int) -> int:
    """A keyword that counts something, or its default.

    Raises:
        SettingError: If it is not within 1 to `highest`.
    """
    if value is None:
        return default
    if not _is_integer(value) or not 1 <= value <= highest:
        raise SettingError(f"{name}: expected an integer within 1 to {highest}, got {value!r}")
    return int(value)


def _is(value: object, *kinds: type[Any]) -> bool:
    return isinstance(value, kinds)


def _is_integer(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _is_number(value: object) -> bool:
    return isinstance(value, float | np.floating) or _is_integer(value)
