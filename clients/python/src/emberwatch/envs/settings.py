"""The keywords that all environments share: their names, defaults and checks."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from inspect import Parameter, Signature, signature
from pathlib import Path
from types import NoneType
from typing import Any, Final, TypedDict, TypeVar, cast, get_args, get_type_hints

import numpy as np

import emberwatch._native as _native
from emberwatch.client.client import STEP_TIMEOUT
from emberwatch.client.replies import ServerInfo
from emberwatch.common.arguments import read_settings
from emberwatch.errors import InvalidArgumentError, invalid, repr_of
from emberwatch.model import Description, Model
from emberwatch.model.airspace import Airspace
from emberwatch.model.tasks import Task, built_in_tasks

#: Drawn seeds are below this number, so that every JSON reader represents them exactly (PROTOCOL.md
#: section 2).
SEEDS: Final = 2**53

#: The keywords whose names differ from those of settings in `config/server.toml`, and in errors.
_KEYWORDS: Final = {
    "moves": "n_moves",
    "worlds": "num_envs",
    "worlds times robots": "num_envs",
    "cells times robots": "height times width times robots",
}

_Init = TypeVar("_Init")


class WorldArguments(TypedDict, total=False):
    """The keywords of all environments, with their types."""

    instance: str | None
    world: int
    robot: int | None
    takeover: bool
    task: str | Path | None
    truth: bool
    timeout: float
    render_mode: str | None
    # Settings of worlds.
    robots: int | None
    model: Model | str | Path | None
    states: str | Path | None
    states_symmetries: bool | None
    states_offset: int | None
    height: int | None
    width: int | None
    n_moves: int | None
    burn_in: int | None
    sensor_radius: int | None
    start: str | None


KEYWORDS: Final[dict[str, Any]] = get_type_hints(WorldArguments)

#: The keywords that are settings of worlds: `robots` and those after it.
OF_WORLDS: Final = tuple(KEYWORDS)[tuple(KEYWORDS).index("robots") :]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """The checked values of the keywords that `WildfireEnv` explains."""

    instance: str | None = None
    world: int = 0
    robot: int | None = None
    takeover: bool = False
    task: str | Path | None = None
    truth: bool = False
    timeout: float = STEP_TIMEOUT
    render_mode: str | None = None
    # Settings of worlds. One that is None is left out: the default, or the server's value.
    robots: int | None = None
    model: Model | str | Path | None = None
    states: str | Path | None = None
    states_symmetries: bool | None = None
    states_offset: int | None = None
    height: int | None = None
    width: int | None = None
    n_moves: int | None = None
    burn_in: int | None = None
    sensor_radius: int | None = None
    start: str | None = None
    #: Number of steps whose frames worlds in this process keep; None: the default.
    history: int | None = None
    #: Whether rewards need the hidden states. Only `truth` shows them in infos and pictures.
    needs_truth: bool = False

    @classmethod
    def of(cls, environment: type, world: WorldArguments, *, needs_truth: bool = False) -> Settings:
        """Makes settings from an environment's shared keywords.

        Raises:
            TypeError: If a keyword is unknown. The message names the most similar keyword, and all
                known ones.
            InvalidArgumentError: If a value has the wrong type.
        """
        parameters = signature(environment).parameters.values()
        known = {each.name for each in parameters if each.kind is each.KEYWORD_ONLY}
        for keyword in world.keys() - known:
            alike = get_close_matches(keyword, known, 1)
            hint = f" (did you mean {alike[0]!r}?)" if alike else ""
            # This is Python's own message, which TorchRL parses to find a keyword to leave out.
            raise TypeError(
                f"{environment.__name__}() got an unexpected keyword argument "
                f"{repr_of(keyword)}{hint}; known keywords: {', '.join(sorted(known))}"
            )
        given = {keyword: _checked(keyword, value) for keyword, value in world.items()}
        settings = cls(**given, needs_truth=needs_truth)
        if not settings.timeout > 0:
            raise invalid("timeout", "seconds above 0", settings.timeout)
        if "num_envs" in known and settings.robot is not None:
            raise invalid("robot", "None, as all robots of the worlds are flown", settings.robot)
        return settings

    @property
    def reads_truth(self) -> bool:
        """Whether the hidden states are read."""
        return self.truth or self.needs_truth

    @property
    def worlds(self) -> dict[str, Any]:
        """The settings of worlds that were given."""
        values = {keyword: getattr(self, keyword) for keyword in OF_WORLDS}
        return {keyword: value for keyword, value in values.items() if value is not None}

    def read(self) -> _native.CheckedSettings:
        """Checks the settings of one world, and reads their files. Errors name keywords."""
        worlds = {"moves" if name == "n_moves" else name: it for name, it in self.worlds.items()}
        own = {"task": self.task, "publish_truth": self.reads_truth, "history": self.history}
        with _names_keywords():
            return read_settings({**own, **worlds})


def _checked(keyword: str, value: Any) -> Any:
    """Returns a keyword's value as a plain Python object; checks its type."""
    if isinstance(value, np.generic):
        value = cast("Any", value.item())
    kinds = get_args(KEYWORDS[keyword]) or (KEYWORDS[keyword],)
    is_kind = isinstance(value, (*kinds, int) if float in kinds else kinds)
    if not is_kind or (isinstance(value, bool) and bool not in kinds):
        names = ("None" if kind is NoneType else kind.__name__ for kind in kinds)
        raise invalid(keyword, " | ".join(names), repr_of(value))
    return value


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
    defaults = {each.name: each.default for each in fields(Settings)}
    shared = [
        Parameter(name, Parameter.KEYWORD_ONLY, default=defaults[name], annotation=kind)
        for name, kind in KEYWORDS.items()
    ]
    plain.__signature__ = Signature(
        [*(each for each in own if each.kind is not each.VAR_KEYWORD), *shared]
    )
    return init


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldSpec:
    """What is known of an environment's worlds before they exist; see also `ServerInfo`."""

    #: The model; None if a running server hides it, or the worlds are recorded.
    model: Model | None
    height: int
    width: int
    n_moves: int
    n_observations: int
    burn_in: int
    airspace: Airspace
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

    @classmethod
    def of(cls, info: ServerInfo, task: Task | None) -> WorldSpec:
        """Returns the spec of the worlds of a server, or of a server with the same settings."""
        description = info.recorded_states
        if description is not None:
            description = description.with_radius(info.airspace.radius)
        shared = "height width n_moves n_observations burn_in airspace n_robots".split()
        return cls(
            model=None if info.model is None else Model.from_toml(info.model),
            is_recorded=info.recorded_world is not None,
            description=description,
            task=task,
            **{name: getattr(info, name) for name in shared},
        )


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
    spec = WorldSpec.of(read.info, Task.of(read))
    robots = _robots(settings, n_rows, spec.n_robots)
    with _names_keywords():
        return spec, robots, read.with_worlds(len(robots) // spec.n_robots)


def running_spec(
    settings: Settings, n_rows: int | None, info: ServerInfo
) -> tuple[WorldSpec, range]:
    """Returns the spec of a running server's worlds, and the numbers of the robots to fly.

    Raises:
        InvalidArgumentError: If the settings do not match the server.
    """
    task = built_in_tasks().get(info.task or "")
    if settings.task is not None:
        task = _check_task(settings.task, info)
    served = {name: getattr(info, name) for name in ("height", "width", "n_moves", "burn_in")}
    served |= {"robots": info.n_robots, "sensor_radius": info.airspace.radius}
    for keyword, asked in settings.worlds.items():
        if keyword == "model":
            if info.model is not None:
                raise invalid(keyword, "None, as the running server reveals its model", asked)
        elif keyword not in served:
            raise invalid(keyword, "None, as the running server determines it", repr_of(asked))
        elif asked != served[keyword]:
            raise invalid(keyword, f"the server's {served[keyword]}, or None", repr_of(asked))
    robots = _robots(settings, n_rows, info.n_robots)
    first, last = settings.world, (robots.stop - 1) // info.n_robots
    if not 0 <= first <= last < info.n_worlds:
        got = f"{first} to {last}; start the server with --worlds N for more"
        raise invalid("world", f"worlds within 0 to {info.n_worlds - 1}", got)
    if settings.reads_truth and not info.publish_truth:
        raise invalid("truth", "a server started with --publish-truth", "one without")
    spec = WorldSpec.of(info, task)
    if "model" in settings.worlds:
        model = Model.named(settings.worlds["model"]).with_radius(info.airspace.radius)
        has, got = (info.n_observations, info.airspace), (model.n_observations, model.airspace)
        if has != got:
            raise invalid("model", f"the server's sensor and no-fly cells, {has}", f"{got}")
        spec = replace(spec, model=model)
    return spec, robots


def _check_task(asked: str | Path, info: ServerInfo) -> Task:
    """Returns the task; refuses a server of another task, or with worlds that differ from it."""
    read = read_settings({"task": asked})
    task = Task.of(read)
    assert task is not None
    if task.name != info.task:
        raise invalid("task", f"the server's {info.task!r}, or None", repr_of(task.name))
    if (task.max_steps, read.worlds_fingerprint) != (info.max_steps, info.worlds_fingerprint):
        raise invalid(
            f"task {task.name!r}",
            f"the server's worlds, {info.worlds_fingerprint}, and {info.max_steps} steps",
            f"{read.worlds_fingerprint} and {task.max_steps}: the server has another file or flags",
        )
    return task


def _robots(settings: Settings, n_rows: int | None, n_robots: int) -> range:
    """Returns the numbers of the robots to fly: one robot, or all robots of some worlds."""
    first = settings.world * n_robots
    if settings.robot is not None:
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
