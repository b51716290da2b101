"""The keywords that all environments share: their names, defaults and checks."""

from __future__ import annotations

import json
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Any, Final, TypedDict, TypeVar, cast, get_type_hints

import numpy as np

import emberwatch._native as _native
from emberwatch.client.connection import STEP_TIMEOUT
from emberwatch.client.replies import ServerInfo
from emberwatch.client.wire import Shape
from emberwatch.common.arguments import read_settings
from emberwatch.common.paths import utf8
from emberwatch.errors import InvalidArgumentError, invalid, repr_of
from emberwatch.model import Description, Model
from emberwatch.model.airspace import Airspace
from emberwatch.model.tasks import Task, built_in_tasks

#: Drawn seeds are below this number, so that every JSON reader represents them exactly (PROTOCOL.md
#: section 2).
SEEDS: Final = 2**53

#: Maps names of settings, as in error messages, to the keywords whose names differ.
_KEYWORDS: Final = {
    "moves": "n_moves",
    "worlds": "num_envs",
    "worlds times robots": "num_envs",
    "cells times robots": "height times width times robots",
}

#: Hints about keywords that were removed.
_REMOVED: Final = {
    "backend": " (removed: worlds are simulated in this process; instance=... attaches to a server)"
}

_Init = TypeVar("_Init")


class WorldArguments(TypedDict, total=False):
    """The types of the keywords, for type checkers; `Settings` has the defaults."""

    instance: str | None
    world: int
    robot: int | None
    robots: int | None
    takeover: bool
    task: str | Path | None
    model: Model | str | Path | None
    states: str | Path | None
    states_symmetries: bool
    states_offset: int
    height: int | None
    width: int | None
    n_moves: int | None
    burn_in: int | None
    sensor_radius: int | None
    start: str | None
    truth: bool
    timeout: float
    render_mode: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """The keywords that `WildfireEnv` explains. None means the default, or the server's value."""

    instance: str | None = None
    world: int = 0
    robot: int | None = None
    robots: int | None = None
    takeover: bool = False
    task: str | Path | None = None
    model: Model | str | Path | None = None
    states: str | Path | None = None
    states_symmetries: bool = False
    states_offset: int = 0
    height: int | None = None
    width: int | None = None
    n_moves: int | None = None
    burn_in: int | None = None
    sensor_radius: int | None = None
    start: str | None = None
    truth: bool = False
    timeout: float = STEP_TIMEOUT
    render_mode: str | None = None
    #: Whether infos and pictures show the hidden states. Even if False, `truth` may be set, for
    #: rewards that need the hidden states.
    reveals: bool = False

    def __post_init__(self) -> None:
        kinds = get_type_hints(Settings)
        for each in fields(self):
            value: Any = getattr(self, each.name)
            kind = kinds[each.name]
            if isinstance(value, np.generic):
                value = cast("Any", value.item())
                object.__setattr__(self, each.name, value)
            is_kind = isinstance(value, int | float if kind is float else kind)
            if not is_kind or (isinstance(value, bool) and kind is not bool):
                raise invalid(each.name, each.type, repr_of(value))
        for name in ("task", "model", "states", "start"):
            value = getattr(self, name)
            if isinstance(value, str | Path):
                utf8(name, value)
        if self.sensor_radius is not None and not 0 <= self.sensor_radius <= _native.MAX_RADIUS:
            expected = f"0 to {_native.MAX_RADIUS}, or None"
            raise invalid("sensor_radius", expected, self.sensor_radius)
        if self.robots is not None and self.robots < 1:
            raise invalid("robots", "at least 1", self.robots)
        if not self.timeout > 0:
            raise invalid("timeout", "seconds above 0", self.timeout)

    @classmethod
    def of(cls, environment: type, world: WorldArguments, *, needs_truth: bool = False) -> Settings:
        """Makes settings from an environment's shared keywords.

        Raises:
            TypeError: If a keyword is unknown. The message names the most similar keyword, and all
                known ones.
        """
        parameters = signature(environment).parameters.values()
        known = {each.name for each in parameters if each.kind is each.KEYWORD_ONLY}
        for name in world:
            if name not in known:
                alike = get_close_matches(name, known, 1)
                hint = f" (did you mean {alike[0]!r}?)" if alike else ""
                hint = _REMOVED.get(name, hint)
                # This is Python's own message, which TorchRL parses to find a keyword to leave out.
                raise TypeError(
                    f"{environment.__name__}() got an unexpected keyword argument "
                    f"{repr_of(name)}{hint}; known keywords: {', '.join(sorted(known))}"
                )
        asked = cls(**world)
        return replace(asked, truth=asked.truth or needs_truth, reveals=asked.truth)

    def read(self) -> _native.CheckedSettings:
        """Checks the settings of one world, and reads their files. Errors name keywords."""
        given = {
            "robots": self.robots,
            "task": self.task,
            "model": self.model,
            "states": self.states,
            "height": self.height,
            "width": self.width,
            "moves": self.n_moves,
            "burn_in": self.burn_in,
            "sensor_radius": self.sensor_radius,
            "start": self.start,
            "publish_truth": self.truth,
            # Default values are left out, because a server refuses these settings without recorded
            # states.
            "states_symmetries": self.states_symmetries or None,
            "states_offset": self.states_offset or None,
        }
        with _names_keywords():
            return read_settings(given)


@contextmanager
def _names_keywords() -> Generator[None]:
    """Replaces the setting that an error names by its keyword."""
    try:
        yield
    except InvalidArgumentError as error:
        setting, colon, words = str(error).partition(":")
        words = f"{_KEYWORDS.get(setting, setting)}{colon}{words}"
        raise InvalidArgumentError(words) from None


def shows_keywords(init: _Init) -> _Init:
    """Replaces ``**world`` in a signature with keywords and defaults, for `help` and editors."""
    plain: Any = init
    own = signature(plain).parameters.values()
    kinds = get_type_hints(Settings)
    shared = [
        Parameter(
            each.name, Parameter.KEYWORD_ONLY, default=each.default, annotation=kinds[each.name]
        )
        for each in fields(Settings)
        if each.name in WorldArguments.__annotations__
    ]
    plain.__signature__ = Signature(
        [*(each for each in own if each.kind is not each.VAR_KEYWORD), *shared]
    )
    return init


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldSpec:
    """The properties of an environment's worlds that are known before the worlds exist."""

    #: The model; None if a running server hides it, or the worlds are recorded.
    model: Model | None
    #: Rows of the grid.
    height: int
    #: Columns of the grid.
    width: int
    #: Number of moves in a path, T.
    n_moves: int
    #: Number of observed values, O.
    n_observations: int
    #: Number of steps that the worlds are simulated before k = 0.
    burn_in: int
    #: Where robots may fly and what they see.
    airspace: Airspace
    #: Number of robots in each world.
    n_robots: int
    #: Whether the hidden states come from recorded states instead of a model.
    is_recorded: bool
    #: The description of recorded states; None if worlds are simulated, or the server hides it.
    description: Description | None = None
    #: The task that defines the worlds, if it is known.
    task: Task | None = field(default=None, compare=False, repr=False)

    @property
    def described(self) -> Description | None:
        """The model or description, for names and rewards of states; None if it is hidden."""
        return self.description or self.model

    @property
    def shape(self) -> Shape:
        return Shape(self.n_robots, self.height, self.width)


def draw_seed(generator: np.random.Generator) -> int:
    """Draws a world's seed from the environment's generator, for a reset without a seed."""
    return int(generator.integers(SEEDS))


def own_spec(
    settings: Settings, n_rows: int | None
) -> tuple[WorldSpec, range, _native.CheckedSettings]:
    """Returns the spec, the robots' numbers and the settings of worlds in this process.

    `n_rows` is the number of robots; None: all robots of one world.
    """
    shared = ("takeover", False), ("world", 0), ("robot", None)
    for name, default in shared:
        if getattr(settings, name) != default:
            raise InvalidArgumentError(
                f"{name}: applies only with instance=..., the name of a running server; without "
                "it, the environment simulates its own worlds"
            )
    read = settings.read()
    checked: dict[str, Any] = json.loads(read.settings)
    n_robots: int = checked["robots"]
    robots = _robots(settings, n_rows, n_robots)
    with _names_keywords():
        read = read.with_worlds(len(robots) // n_robots)
    described = _described(read, checked)
    spec = WorldSpec(
        model=described if isinstance(described, Model) else None,
        height=checked["height"],
        width=checked["width"],
        n_moves=checked["moves"],
        n_observations=described.n_observations,
        burn_in=checked["burn_in"],
        airspace=described.airspace,
        n_robots=n_robots,
        is_recorded=bool(checked["states"]),
        description=described if checked["states"] else None,
        task=Task.of(read),
    )
    return spec, robots, read


def running_spec(
    settings: Settings, n_rows: int | None, info: ServerInfo
) -> tuple[WorldSpec, range]:
    """Returns the spec of a running server's worlds, and the numbers of the robots to fly.

    Raises:
        InvalidArgumentError: If the settings do not match the server.
    """
    own = ("start", None), ("states", None), ("states_symmetries", False), ("states_offset", 0)
    for name, default in own:
        if getattr(settings, name) != default:
            raise InvalidArgumentError(
                f"{name}: expected {default} (the default), as the running server determines it"
            )
    task = built_in_tasks().get(info.task or "")
    if settings.task is not None:
        task = _check_task(settings.task, info)
    if settings.model is not None and info.model is not None:
        raise InvalidArgumentError("model: expected None, as the running server reveals its model")
    known = {name: getattr(info, name) for name in ("height", "width", "n_moves", "burn_in")}
    known |= {"robots": info.n_robots, "sensor_radius": info.airspace.radius}
    for name, has in known.items():
        asked = getattr(settings, name)
        if asked not in (None, has):
            raise invalid(name, f"the server's {has}, or None", asked)
    robots = _robots(settings, n_rows, info.n_robots)
    first, last = settings.world, (robots.stop - 1) // info.n_robots
    if not 0 <= first <= last < info.n_worlds:
        got = f"{first} to {last}; start the server with --worlds N for more"
        raise invalid("world", f"worlds within 0 to {info.n_worlds - 1}", got)
    if settings.truth and not info.publish_truth:
        raise invalid("truth", "a server started with --publish-truth", "one without")
    model = None if info.model is None else Model.from_toml(info.model)
    if settings.model is not None:
        model = Model.named(settings.model).with_radius(info.airspace.radius)
        has, got = (info.n_observations, info.airspace), (model.n_observations, model.airspace)
        if has != got:
            raise invalid("model", f"the server's sensor and no-fly cells, {has}", f"{got}")
    description = info.recorded_states
    if description is not None:
        description = description.with_radius(info.airspace.radius)
    spec = WorldSpec(
        model=model,
        height=info.height,
        width=info.width,
        n_moves=info.n_moves,
        n_observations=info.n_observations,
        burn_in=info.burn_in,
        airspace=info.airspace,
        n_robots=info.n_robots,
        is_recorded=info.recorded_world is not None,
        description=description,
        task=task,
    )
    return spec, robots


def _check_task(asked: str | Path, info: ServerInfo) -> Task:
    """Returns the task; refuses a server of another task, or with worlds that differ from it."""
    read = read_settings({"task": asked})
    task = Task.of(read)
    assert task is not None
    if task.name != info.task:
        raise invalid("task", f"the server's {info.task!r}, or None", repr_of(task.name))
    own: dict[str, Any] = json.loads(read.settings)
    has = {"moves": info.n_moves, "robots": info.n_robots, "max_steps": info.max_steps}
    has |= {"height": info.height, "width": info.width, "burn_in": info.burn_in}
    for name, got in has.items():
        if own[name] != got:
            raise invalid(f"{name} of task {task.name!r}", f"the server's {got}", own[name])
    described = _described(read, own)
    if described.sensor_radius != info.airspace.radius:
        expected = f"the server's {info.airspace.radius}"
        name = f"sensor_radius of task {task.name!r}"
        raise invalid(name, expected, described.sensor_radius)
    served: Description | None = info.recorded_states
    if served is not None:
        served = served.with_radius(info.airspace.radius)
    elif info.model is not None:
        served = Model.from_toml(info.model)
    if served not in (None, described):
        raise invalid(f"states of task {task.name!r}", "the server's states", described.name)
    return task


def _described(read: _native.CheckedSettings, checked: dict[str, Any]) -> Description:
    """Returns the model of settings, or the description of their recorded states."""
    if not checked["states"]:
        return Model.from_toml(read.description)
    described, radius = Description.from_toml(read.description), checked["sensor_radius"]
    return described.with_radius(radius) if radius >= 0 else described


def _robots(settings: Settings, n_rows: int | None, n_robots: int) -> range:
    """Returns the numbers of the robots to fly: one robot, or all robots of some worlds."""
    first = settings.world * n_robots
    if settings.robot is not None:
        if n_rows != 1:
            raise InvalidArgumentError("robot: expected None, as all robots of a world are flown")
        if not 0 <= settings.robot < n_robots:
            raise invalid("robot", f"0 to {n_robots - 1}" if n_robots > 1 else "0", settings.robot)
        return range(first + settings.robot, first + settings.robot + 1)
    n_rows = n_robots if n_rows is None else n_rows
    if n_rows // n_robots * n_robots != n_rows:
        raise InvalidArgumentError(
            f"robots: expected one robot in a world, got {n_robots}: fly one of them with "
            "robot=..., all robots of a world with emberwatch.parallel_env, or all robots of "
            f"several worlds with num_envs, a multiple of {n_robots}, got {n_rows}"
        )
    return range(first, first + n_rows)
