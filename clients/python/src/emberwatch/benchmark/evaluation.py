"""Evaluation of Python policies on the benchmark's worlds."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, TextIO

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

import emberwatch._native as _native
from emberwatch.belief.merit import RECENT_STEPS
from emberwatch.benchmark.policies import Actor, Policy
from emberwatch.benchmark.report import Progress
from emberwatch.benchmark.row_file import RowFile
from emberwatch.benchmark.rows import Row, text_of
from emberwatch.benchmark.tally import Tally
from emberwatch.client import wire
from emberwatch.client.client import Client
from emberwatch.common.arguments import as_count, as_seed, repr_of
from emberwatch.envs.observations import OF_BELIEF, OF_TEAM, names_of
from emberwatch.envs.settings import Settings, WorldArguments
from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.model.tasks import Task

_MOVES: Final = "emberwatch/WildfireMoves-v0"
_PATHS: Final = "emberwatch/Wildfire-v0"

#: Defaults of `emberwatch-agent compare`.
_BURN_IN: Final = 25_000
_SEEDS: Final = range(8)
_STEPS: Final = 1500

#: Default timeout, seconds. Longer than the default for learners, because hidden states can arrive
#: late on a busy machine.
_TIMEOUT: Final = 30.0


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
    csv: str | os.PathLike[str] | None = None,
    append: bool = False,
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
        csv: The file for the rows, written after the last world. If the evaluation ends early, the
            rows of the finished worlds replace the file with `.partial` after this path, until the
            next evaluation that does not end early removes it.
        append: Whether `csv` may exist. The rows are added to its rows, which must be of other
            policies on the same worlds.
        progress: The stream for progress; None: no output.
        keywords: Keywords of the environment, such as `task`, `model`, `height`, `n_moves` and
            `observation`. With several `robots`, the policy acts for all robots of each world, and
            each row of its observations and actions belongs to one robot.

    Returns:
        One row for each seed, in order.

    Raises:
        ExistingFileError: If `csv` exists, unless `append` is true.
        InvalidArgumentError: If an argument is invalid, the policy does not fit the worlds, or the
            file cannot be written.
    """
    if append and csv is None:
        raise invalid("append", "a file in csv", "none")
    task = None if keywords.get("task") is None else Task.named(keywords["task"])
    seeds = (task.test_seeds if task else _SEEDS) if seeds is None else seeds
    steps = (task.max_steps if task else _STEPS) if steps is None else steps
    numbers = {"steps": steps, "batch": batch, "recent_steps": recent_steps}
    chosen = _check(name, estimator, env, seeds, **numbers)
    actor = Actor(policy, deterministic=deterministic)
    setting = _setting(env, task, burn_in, wrap, keywords)
    with setting.made(1) as (worlds, wrapped):
        actor.check(worlds, wrapped)
    if setting.keywords["truth"]:
        batch = min(batch, wire.TRUTH_BUFFER)
    parts = set(names_of(keywords.get("observation")))
    columns = {
        "policy": name,
        "estimator": estimator or ("known_model" if OF_BELIEF & parts else "none"),
        "robots": setting.n_robots,
        "team": "shared" if setting.n_robots > 1 and OF_TEAM & parts else "alone",
        "steps": steps,
        "recent_steps": recent_steps,
        "worlds_fingerprint": setting.fingerprint,
    }
    played = {(setting.fingerprint, seed, steps) for seed in chosen}
    file = None if csv is None else RowFile(csv, append=append, policy=name, worlds=played)
    report = Progress(progress, name, chosen, steps)
    rows: list[Row] = []
    try:
        for first in range(0, len(chosen), batch):
            rows += _play(setting, actor, chosen[first : first + batch], columns, report)
        if file is not None:
            file.save(rows)
    except BaseException as error:
        if file is not None and rows:
            words, details = _saved(file, rows, len(chosen))
            error.add_note(words + details)
            report.end(f", stopped: {words}")
        raise
    report.end()
    return rows


@dataclass(frozen=True, slots=True)
class _Setting:
    """The worlds that a policy acts in, and their wrappers."""

    env: str
    keywords: dict[str, Any]
    n_robots: int
    wrap: Callable[[Any], Any] | None
    fingerprint: str

    @contextmanager
    def made(self, n_worlds: int) -> Generator[tuple[Any, Any]]:
        """Makes the worlds; yields the plain ones, and the wrapped ones or None."""
        worlds: Any = gymnasium.make_vec(
            self.env,
            num_envs=n_worlds * self.n_robots,
            max_episode_steps=-1,
            autoreset_mode=AutoresetMode.DISABLED,
            **self.keywords,
        )
        worlds.unwrapped.allow_test_worlds()
        try:
            yield worlds.unwrapped, None if self.wrap is None else _wrapped(worlds, self.wrap)
        finally:
            worlds.close()


def _wrapped(worlds: Any, wrap: Callable[[Any], Any]) -> Any:
    from emberwatch.benchmark.wrapped import Wrapped  # needs Stable-Baselines3

    return Wrapped(worlds, wrap)


def _setting(
    env: str,
    task: Task | None,
    burn_in: int | None,
    wrap: Callable[[Any], Any] | None,
    keywords: dict[str, Any],
) -> _Setting:
    """Adds the defaults of an evaluation to the keywords of the environment."""
    served = None
    if keywords.get("instance") is not None:
        with Client(keywords["instance"]) as client:
            served = client.info
    n_robots = task.robots if task else keywords.get("robots") or 1
    if served is not None and served.n_robots != n_robots:
        raise invalid("robots", f"the server's {served.n_robots}", n_robots)
    if burn_in is None and all(keywords.get(it) is None for it in ("task", "instance", "states")):
        burn_in = _BURN_IN
    # Worlds in this process can always reveal their hidden states.
    defaults = {"truth": served is None or served.publish_truth, "timeout": _TIMEOUT}
    keywords = {**defaults, **keywords, "burn_in": burn_in}
    if served is None:
        world = {it: keywords[it] for it in WorldArguments.__annotations__ if it in keywords}
        fingerprint = _native.worlds_fingerprint(json.dumps(Settings(**world).of_server(1)))
    else:
        fingerprint = served.worlds_fingerprint or ""
    return _Setting(env, keywords, n_robots, wrap, fingerprint)


def _play(
    setting: _Setting,
    actor: Actor,
    seeds: Sequence[int],
    columns: dict[str, Any],
    report: Progress,
) -> list[Row]:
    """Scores a policy on the worlds of some seeds, all at the same time."""
    steps = columns["steps"]
    with setting.made(len(seeds)) as (worlds, wrapped):
        shown = worlds if wrapped is None else wrapped
        tally = Tally(worlds.world_spec, len(seeds), columns["recent_steps"])
        actor.begin(len(seeds), worlds.num_envs)
        seen, _ = shown.reset(seed=np.repeat(seeds, setting.n_robots).tolist())
        if (worlds.lease.client.info.worlds_fingerprint or "") != setting.fingerprint:
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
    return tally.rows(seeds, columns)


def _saved(file: RowFile, rows: Sequence[Row], n_worlds: int) -> tuple[str, str]:
    """Saves the rows of an evaluation that ended early. Returns where, or the rows themselves."""
    done = f"{len(rows)} of {n_worlds} worlds finished"
    try:
        return f"{done}, their rows are in {file.save_partial(rows)}", ""
    except InvalidArgumentError:
        return f"{done}, their rows could not be saved", f":\n{text_of(rows)}"


def _check(
    name: str, estimator: str | None, env: str, seeds: Iterable[int], **numbers: int
) -> list[int]:
    """Checks the arguments of an evaluation; returns the seeds as a list."""
    for what, text in {"name": name, "estimator": estimator or "none"}.items():
        if not isinstance(text, str) or not text or not text.isprintable():  # pyright: ignore[reportUnnecessaryIsInstance]
            raise invalid(what, "a name for the table", repr_of(text))
    if env not in (_MOVES, _PATHS):
        raise invalid("env", f"{_MOVES!r} or {_PATHS!r}", repr_of(env))
    for what, number in numbers.items():
        as_count(number, what, 1, 2**32 - 1)
    if not isinstance(seeds, Iterable):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise invalid("seeds", "several seeds, such as range(8)", repr_of(seeds))
    chosen = [as_seed(seed) for seed in seeds]
    if not chosen or len(set(chosen)) < len(chosen):
        raise invalid("seeds", "at least one seed, without duplicates", chosen)
    return chosen
