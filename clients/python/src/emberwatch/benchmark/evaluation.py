"""Evaluation of Python policies on the benchmark's worlds."""

from __future__ import annotations

import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, TextIO, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

import emberwatch._native as _native
from emberwatch._native import VERSION
from emberwatch.belief.merit import RECENT_STEPS
from emberwatch.benchmark.digest import digest
from emberwatch.benchmark.policies import Actor, Policy, statistics
from emberwatch.benchmark.report import Progress
from emberwatch.benchmark.row_file import Kind, Mark, RowFile
from emberwatch.benchmark.rows import Row
from emberwatch.benchmark.tally import Tally
from emberwatch.client import wire
from emberwatch.client.client import Client
from emberwatch.client.replies import ServerInfo
from emberwatch.common.arguments import as_integer, as_seed, repr_of
from emberwatch.envs.observations import OF_BELIEF, OF_TEAM, names_of
from emberwatch.envs.settings import Settings, WorldArguments
from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.model import Model
from emberwatch.model.tasks import Task, built_in_tasks

_MOVES: Final = "emberwatch/WildfireMoves-v0"
_PATHS: Final = "emberwatch/Wildfire-v0"

#: Defaults of `emberwatch-agent compare`.
_BURN_IN: Final = 25_000
_SEEDS: Final = range(8)
_STEPS: Final = 1500

#: Default timeout, seconds. Longer than the default for learners, because hidden states can arrive
#: late on a busy machine.
_TIMEOUT: Final = 30.0

#: Keywords of the environment that an evaluation sets itself.
_SET: Final = ("reward", "num_envs", "max_episode_steps", "autoreset_mode")


def evaluate(
    policy: Policy | Any,
    *,
    name: str,
    seeds: Iterable[int] | None = None,
    steps: int | None = None,
    burn_in: int | None = None,
    env: str = _MOVES,
    estimator: str | None = None,
    deterministic: bool = True,
    batch: int = 32,
    recent_steps: int = RECENT_STEPS,
    wrap: Callable[[Any], Any] | None = None,
    csv: str | os.PathLike[str] | RowFile | None = None,
    progress: TextIO | None = sys.stderr,
    **keywords: Any,
) -> list[Row]:
    """Scores a policy on several worlds, by default as `emberwatch-agent compare` does.

    Args:
        policy: A function that maps stacked observations of several worlds to their actions, or a
            model of Stable-Baselines3 or another object with the same `predict`. Recurrent models
            receive the state that they last returned, and `episode_start` is true in the first step
            of each world. A function or `predict` with a parameter `action_masks` receives the
            masks of the worlds, `(n_worlds, 4)` booleans. If a model was trained behind
            `VecNormalize` and still refers to it (`get_vec_normalize_env`), its observations are
            normalized in the same way. If the policy has a method `begin(n_worlds)`, it is called
            before each batch of worlds.
        name: The policy's name in the table.
        seeds: The seeds of the worlds; None: the test seeds of the task, or 0 to 7. Seeds below
            1000 are test worlds.
        steps: Number of scored steps, each a path, in each world; None: the task's, or 1,500.
        burn_in: Number of steps before the first scored one; None: the value of the task or the
            running server, or 25,000. Recorded worlds have no burn-in.
        env: The environment: `"emberwatch/WildfireMoves-v0"` or `"emberwatch/Wildfire-v0"`.
        estimator: The name of the policy's belief in the table; None: `known_model` if
            `observation` has a belief, otherwise `none`.
        deterministic: Argument of `predict`.
        batch: Number of worlds to simulate at the same time, in the order of the seeds.
        recent_steps: Number of steps for which a cell counts as seen after a visit, in the figures
            of merit. Figures that need the hidden states are None with `truth=False`. These figures
            are also None if a running server does not publish the states, or hides its model or its
            description of recorded worlds.
        wrap: A function that wraps the worlds (a `VecEnv` of Stable-Baselines3) as in the training,
            for example `lambda worlds: VecFrameStack(worlds, 4)`. For a saved model with normalized
            observations: `lambda worlds: VecNormalize.load("statistics.pkl", worlds)`. The
            evaluation does not change the statistics of the normalization.
        csv: A file to write rows to. Several processes may write to it. Rows of this policy in the
            file are reused if worlds, settings and policy are the same. Models are compared by
            their weights, functions by their code and the values that they refer to. Rows of this
            policy with other settings are computed again and replaced. Rows of other policies are
            kept. A file with rows of other worlds is refused.
        progress: The stream for progress and for notes on reused rows; None: no output.
        keywords: Keywords of the environment, such as `task`, `model`, `height`, `n_moves` and
            `observation`. With several `robots`, the policy acts for all robots of each world, and
            each row of its observations and actions belongs to one robot.

    Returns:
        One row for each seed, in order.
    """
    task = None if keywords.get("task") is None else Task.named(keywords["task"])
    seeds = (task.test_seeds if task else _SEEDS) if seeds is None else seeds
    steps = (task.max_steps if task else _STEPS) if steps is None else steps
    chosen = _check(name, estimator, seeds, steps, batch, recent_steps, env, keywords)
    actor = Actor(policy, deterministic=deterministic, is_wrapped=wrap is not None)
    if burn_in is None and all(keywords.get(it) is None for it in ("task", "instance", "states")):
        burn_in = _BURN_IN
    keywords["burn_in"] = burn_in
    keywords.setdefault("timeout", _TIMEOUT)
    served = _served(keywords.get("instance"))
    # Worlds in this process can always reveal their hidden states.
    if keywords.setdefault("truth", served is None or served.publish_truth):
        batch = min(batch, wire.TRUTH_BUFFER)
    parts = set(names_of(keywords.get("observation")))
    if estimator is None:
        estimator = "known_model" if OF_BELIEF & parts else "none"
    robots = task.robots if task else keywords.get("robots") or 1
    if served is not None and served.n_robots != robots:
        raise invalid("robots", f"the server's {served.n_robots}", robots)
    setting = _Setting(env, keywords, robots, wrap)
    normalizers = _check_policy(setting, actor)
    fingerprint = _policy_fingerprint(setting, policy, estimator, deterministic, normalizers)
    common: dict[str, Any] = {
        "policy": name,
        "estimator": estimator,
        "robots": robots,
        "team": "shared" if robots > 1 and OF_TEAM & parts else "alone",
        "steps": steps,
        "recent_steps": recent_steps,
        "policy_fingerprint": fingerprint,
    }
    report = Progress(progress, name, chosen)
    if csv is None:
        return _score(setting, actor, chosen, batch, common, report)
    with csv if isinstance(csv, RowFile) else RowFile(csv) as file:
        setting = replace(setting, fingerprint=_worlds_fingerprint(keywords, served))
        done = _kept(file, setting, common, chosen, report)
        missing = [seed for seed in chosen if seed not in done]
        made = _score(setting, actor, missing, batch, common, report, file)
        done |= {row.world_seed: row for row in made}
    return [done[seed] for seed in chosen]


def suite(
    policy: Policy | Any,
    *,
    name: str,
    folder: str | os.PathLike[str] = "suite",
    tasks: Iterable[str | os.PathLike[str]] | None = None,
    worlds: int | None = None,
    **keywords: Any,
) -> dict[str, list[Row]]:
    """Scores a policy on the test worlds of tasks, for `emberwatch-agent suite --out FOLDER`.

    Args:
        policy: A policy as in `evaluate`, for all tasks; or a mapping from the name of each task to
            its policy.
        name: The policy's name in tables.
        folder: The folder of the rows, with a CSV file for each task. Rows of this policy are
            reused as in `evaluate`. If the worlds of a task have changed, this policy's rows of
            the old worlds are replaced. Rows of other policies on the old worlds stay in the file,
            but do not count; a warning names them.
        tasks: Names of tasks or task files; None: all built-in tasks, or the tasks of the mapping.
        worlds: Number of worlds of each task, from its first test seed on; None: all of them.
        keywords: Keywords of `evaluate`, except `task`, `seeds`, `steps` and `csv`.

    Returns:
        The rows of each task, one for each world, by the task's name.
    """
    for keyword in ("task", "seeds", "steps", "csv"):
        if keyword in keywords:
            raise InvalidArgumentError(f"{keyword}: suite sets it; leave it out")
    if worlds is not None and (as_integer(worlds) or 0) < 1:
        raise invalid("worlds", "at least 1", repr_of(worlds))
    by_task = cast("Mapping[str, Any]", policy) if isinstance(policy, Mapping) else None
    sources = list(tasks or by_task or built_in_tasks())
    chosen = [(source, Task.named(source)) for source in sources]
    names = [task.name for _, task in chosen]
    if len(set(names)) < len(names):
        raise invalid("tasks", "tasks with different names", ", ".join(names))
    for task_name in names:
        if by_task is not None and task_name not in by_task:
            raise invalid("policy", f"one for the task {task_name}", ", ".join(by_task))
    rows: dict[str, list[Row]] = {}
    for source, task in chosen:
        rows[task.name] = evaluate(
            cast("Any", policy) if by_task is None else by_task[task.name],
            name=name,
            task=source,
            seeds=task.test_seeds[:worlds],
            csv=RowFile(Path(folder) / f"{task.name}.csv", is_cache=True),
            **keywords,
        )
    return rows


@dataclass(frozen=True, slots=True)
class _Setting:
    """The worlds that a policy acts in, and their wrappers."""

    env: str
    keywords: dict[str, Any]
    n_robots: int
    wrap: Callable[[Any], Any] | None
    #: Identifies the worlds. None if no rows are written to a file, because only rows in files need
    #: it.
    fingerprint: str | None = None

    @contextmanager
    def made(self, n_worlds: int) -> Generator[tuple[Any, Any]]:
        """Makes the worlds; yields the plain worlds, and the wrapped ones that the policy sees."""
        worlds = _make(self.env, self.keywords, self.n_robots, n_worlds)
        worlds.unwrapped.allow_test_worlds()
        try:
            yield worlds.unwrapped, worlds if self.wrap is None else _wrapped(worlds, self.wrap)
        finally:
            worlds.close()


def _make(env: str, keywords: dict[str, Any], n_robots: int, n_worlds: int) -> Any:
    make: Any = {"num_envs": n_worlds * n_robots, "max_episode_steps": -1, **keywords}
    return gymnasium.make_vec(env, autoreset_mode=AutoresetMode.DISABLED, **make)


def _wrapped(worlds: Any, wrap: Callable[[Any], Any]) -> Any:
    try:
        from emberwatch.benchmark.wrapped import Wrapped
    except ModuleNotFoundError as error:
        needed = "expected Stable-Baselines3: pip install stable-baselines3"
        raise ModuleNotFoundError(f"wrap: {needed}; got: {error}") from None
    return Wrapped(worlds, wrap)


def _served(instance: str | None) -> ServerInfo | None:
    """Returns the description of a running server."""
    if instance is None:
        return None
    with Client(instance) as client:
        return client.info


def _check_policy(setting: _Setting, actor: Actor) -> list[Any]:
    """Refuses worlds that a policy cannot act in. Does not reset the worlds.

    Returns:
        The statistics with which observations are normalized.
    """
    with setting.made(1) as (worlds, shown):
        normalizers = actor.normalizers if setting.wrap is None else shown.normalizers
        if actor.normalizers and not normalizers:
            raise InvalidArgumentError(
                "wrap: expected a VecNormalize among the wrappers, as the policy was trained "
                "behind one, got none"
            )
        actor.check(worlds, shown.single_observation_space)
        return [statistics(normalizer) for normalizer in normalizers]


def _policy_fingerprint(setting: _Setting, *acts_on: object) -> str:
    """Returns a hash of everything that the actions depend on, except the worlds."""
    keywords = setting.keywords
    others = {it: keywords[it] for it in keywords if it not in WorldArguments.__annotations__}
    # If the server hides its model, `model` is the model that the belief uses.
    model = keywords.get("model") if keywords.get("instance") is not None else None
    known = None if model is None else Model.named(model).toml
    return digest((VERSION, setting.env, others, known, setting.wrap, acts_on))


def _worlds_fingerprint(keywords: Mapping[str, Any], served: ServerInfo | None) -> str:
    """Returns the fingerprint of the worlds, the same for all seeds, without simulating them."""
    if served is None:
        world = {it: keywords[it] for it in WorldArguments.__annotations__ if it in keywords}
        return _native.worlds_fingerprint(json.dumps(Settings(**world).of_server(1)))
    if served.worlds_fingerprint is None:
        got = f"release {served.build}"
        raise invalid("instance", f"a server of release {VERSION} for csv", got)
    return served.worlds_fingerprint


def _kept(
    file: RowFile,
    setting: _Setting,
    common: Mapping[str, Any],
    chosen: Sequence[int],
    report: Progress,
) -> dict[int, Row]:
    """Returns the rows of a file that can be reused, by seed."""
    mark = Mark(
        setting.fingerprint or "",
        common["policy_fingerprint"],
        common["steps"],
        common["recent_steps"],
    )
    kind = Kind(*(common[name] for name in Kind._fields))
    found = file.find(kind, mark)
    if found.elsewhere:
        warnings.warn(
            f"{file.path} has rows of {', '.join(found.elsewhere)} on other worlds, or from an "
            "older release, which did not identify the worlds: they stay in the file, but do not "
            "count",
            stacklevel=4,
        )
    kept = {seed: row for seed, row in found.kept.items() if seed in chosen}
    n_again = sum(row.world_seed in chosen for row in found.stale)
    n_dropped = len(found.stale) - n_again
    report.found(file.path, n_kept=len(kept), n_again=n_again, n_dropped=n_dropped)
    return kept


def _score(
    setting: _Setting,
    actor: Actor,
    seeds: Sequence[int],
    batch: int,
    common: Mapping[str, Any],
    report: Progress,
    file: RowFile | None = None,
) -> list[Row]:
    """Scores a policy on the worlds of some seeds, and adds their rows to a file."""
    report.begin(len(seeds) * common["steps"])
    rows: list[Row] = []
    for first in range(0, len(seeds), batch):
        part = seeds[first : first + batch]
        made = _play(setting, actor, part, common, report)
        rows += made
        if file is not None:
            file.add(made)
    report.end()
    return rows


def _play(
    setting: _Setting,
    actor: Actor,
    seeds: Sequence[int],
    common: Mapping[str, Any],
    report: Progress,
) -> list[Row]:
    """Scores a policy on the worlds of some seeds, all at the same time."""
    steps, n_robots = common["steps"], setting.n_robots
    with setting.made(len(seeds)) as (worlds, shown):
        tally = Tally(worlds.world_spec, len(seeds), common["recent_steps"])
        actor.begin(len(seeds), worlds.num_envs)
        seen, _ = shown.reset(seed=np.repeat(seeds, n_robots).tolist())
        fingerprint = worlds.lease.client.info.worlds_fingerprint
        if setting.fingerprint not in (None, fingerprint):
            raise InvalidArgumentError(
                "worlds: changed since the evaluation began; either the file of their task, model "
                "or states has changed, or another server uses the instance"
            )
        n_actions = tally.n_moves if setting.env == _MOVES else 1
        truncated = np.zeros(worlds.num_envs, np.bool_)
        for step in range(1, steps + 1):
            flown: list[NDArray[np.integer]] = []
            for _ in range(n_actions):
                begin = time.perf_counter()
                flown.append(actor.act(seen, worlds))
                tally.seconds += time.perf_counter() - begin
                seen, _, _, truncated, _ = shown.step(flown[-1])
            if truncated.any() and step < steps:
                raise invalid("steps", f"at most {step}, the length of these episodes", steps)
            paths = np.stack(flown, axis=1).reshape(len(truncated), -1)
            tally.add(worlds.results, paths, worlds.truths)
            report.add(len(seeds))
    return _rows(tally, seeds, {**common, "worlds_fingerprint": fingerprint or ""})


def _rows(tally: Tally, seeds: Sequence[int], common: Mapping[str, Any]) -> list[Row]:
    steps = common["steps"]
    return [
        Row(
            **common,
            world_seed=seed,
            mean_reward=float(tally.reward[index]) / steps,
            mean_distinct_cells=int(tally.n_visited[index]) / steps,
            hit_rate=int(tally.n_hits[index]) / max(int(tally.n_visited[index]), 1),
            mean_fire_cells=int(tally.n_fire[index]) / steps,
            mean_plan_millis=1e3 * tally.seconds / steps / len(seeds),
            brier="",
            moves=tally.n_moves,
            mean_repeated=1.0 - int(tally.n_visited[index]) / int(tally.n_visits[index]),
            **asdict(tally.merit.merit(index)),
        )
        for index, seed in enumerate(seeds)
    ]


def _check(
    name: str,
    estimator: str | None,
    seeds: Iterable[int],
    steps: int,
    batch: int,
    recent_steps: int,
    env: str,
    keywords: dict[str, Any],
) -> list[int]:
    """Checks the arguments of an evaluation; returns the seeds as a list."""
    if not isinstance(name, str) or not name or not name.isprintable():  # pyright: ignore[reportUnnecessaryIsInstance]
        raise invalid("name", "a name for the table", repr(name))
    if estimator is not None and (not isinstance(estimator, str) or not estimator.isprintable()):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise invalid("estimator", "a name for the table, or None", repr(estimator))
    if env not in (_MOVES, _PATHS):
        raise invalid("env", f"{_MOVES!r} or {_PATHS!r}", repr(env))
    numbers = {"steps": steps, "batch": batch, "recent_steps": recent_steps}
    for what, number in numbers.items():
        if not isinstance(number, int | np.integer) or number < 1:  # pyright: ignore[reportUnnecessaryIsInstance]
            raise invalid(what, "at least 1", repr(number))
    for what in _SET:
        if what in keywords:
            raise InvalidArgumentError(f"{what}: evaluate sets it; leave it out")
    if not isinstance(seeds, Iterable):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise invalid("seeds", "several seeds, such as range(8)", repr(seeds))
    chosen = [as_seed(seed) for seed in seeds]
    if not chosen or len(set(chosen)) < len(chosen):
        raise invalid("seeds", "at least one seed, without duplicates", chosen)
    return chosen
