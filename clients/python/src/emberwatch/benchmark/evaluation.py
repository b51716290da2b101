"""Evaluation of Python policies on the benchmark's worlds."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing, contextmanager
from functools import partial
from typing import Any, Final, TextIO

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emberwatch.benchmark.policies import Actor, Policy
from emberwatch.benchmark.report import Progress
from emberwatch.benchmark.rows import Row, RowFile
from emberwatch.benchmark.tally import Tally
from emberwatch.client import wire
from emberwatch.client.client import Client
from emberwatch.common.arguments import as_count, as_list, as_seed
from emberwatch.common.paths import with_absolute_paths
from emberwatch.envs.observations import OF_BELIEF, OF_TEAM, names_of
from emberwatch.envs.path_env import WildfireVectorEnv
from emberwatch.envs.settings import Settings, WorldArguments
from emberwatch.errors import InvalidArgumentError, invalid, repr_of
from emberwatch.model.tasks import Task

_MOVES: Final = "emberwatch/WildfireMoves-v0"
_PATHS: Final = "emberwatch/Wildfire-v0"


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
    wrap: Callable[[Any], Any] | None = None,
    csv: str | os.PathLike[str] | None = None,
    append: bool = False,
    progress: TextIO | None = sys.stderr,
    **keywords: Any,
) -> list[Row]:
    """Scores a policy on several worlds, by default as `emberwatch-agent compare` does.

    Args:
        policy: A function from stacked observations of several worlds to their actions, or an
            object with the `predict` of Stable-Baselines3's models. If it has parameters with
            these names, it receives `state` (which it last returned), `episode_start` (true in the
            first step), `deterministic` and `action_masks` (`(n_worlds, 4)` booleans). A
            `VecNormalize` that a model refers to normalizes its observations. A method
            `begin(n_worlds)`, if there is one, is called before each batch of worlds.
        name: The policy's name in the table.
        seeds: The seeds of the worlds; None: the test seeds of the task, or 0 to 7. Seeds below
            1000 are test worlds.
        steps: Number of scored steps, each a path, in each world; None: the task's, or 1,500.
        burn_in: Number of steps before the first scored one; None: the value of the task or the
            running server, or 25,000. Recorded worlds have no burn-in.
        env: The environment: `"emberwatch/WildfireMoves-v0"` or `"emberwatch/Wildfire-v0"`.
        estimator: The name of the policy's belief in the table; None: `known` if
            `observation` has a belief, otherwise `none`.
        deterministic: Argument of `predict`.
        batch: Number of worlds to simulate at the same time, in the order of the seeds.
        wrap: A function that wraps the worlds (a `VecEnv` of Stable-Baselines3) as in the training,
            for example `lambda worlds: VecFrameStack(worlds, 4)`, or for a saved model
            `lambda worlds: VecNormalize.load("statistics.pkl", worlds)`. Statistics stay unchanged.
        csv: The file for the rows, written after the last world. If the evaluation ends early, the
            rows of the finished worlds replace the file with `.partial` after this path, until the
            next evaluation that does not end early removes it.
        append: Whether `csv` may exist. The rows are added to its rows, which must be of other
            policies on the same worlds.
        progress: The stream for progress; None: no output.
        keywords: Keywords of the environment, such as `task`, `model`, `height` and `observation`.
            With several `robots`, each row of observations and actions belongs to one robot.

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
    steps = (task.max_steps if task else 1500) if steps is None else steps
    for what, text in {"name": name, "estimator": estimator or "none"}.items():
        if not text or not str(text).isprintable():
            raise invalid(what, "a name for the table", repr_of(text))
    if env not in (_MOVES, _PATHS):
        raise invalid("env", f"{_MOVES!r} or {_PATHS!r}", repr_of(env))
    for what, number in {"steps": steps, "batch": batch}.items():
        as_count(number, what, 1, 2**32 - 1)
    chosen = (task.test_seeds if task else range(8)) if seeds is None else as_list(seeds, "seeds")
    chosen = [as_seed(seed) for seed in chosen]
    if not chosen or len(set(chosen)) < len(chosen):
        raise invalid("seeds", "at least one seed, without duplicates", chosen)
    actor = Actor(policy, deterministic=deterministic)
    keywords, n_robots, fingerprint = _with_defaults(keywords, task, burn_in)
    made = partial(_made, env, keywords, n_robots, wrap)
    with made(1) as (worlds, shown):
        actor.check(worlds, shown)
    if keywords["truth"]:
        batch = min(batch, wire.TRUTH_BUFFER)
    parts = set(names_of(keywords.get("observation")))
    columns = {
        "policy": name,
        "estimator": estimator or (keywords.get("kind", "known") if OF_BELIEF & parts else "none"),
        "robots": n_robots,
        "team": "shared" if n_robots > 1 and OF_TEAM & parts else "alone",
        "steps": steps,
        "worlds_fingerprint": fingerprint,
    }
    played = {(fingerprint, seed, steps) for seed in chosen}
    file = None if csv is None else RowFile(csv, name, played, append=append)
    report = Progress(progress, name, chosen, steps)
    rows: list[Row] = []
    try:
        for first in range(0, len(chosen), batch):
            rows += _play(made, actor, chosen[first : first + batch], columns, report)
        if file is not None:
            file.save(rows)
    except BaseException as error:
        if file is not None and rows:
            error.add_note(file.save_partial(rows))
        raise
    finally:
        report.add(0, ends=True)
    return rows


def _with_defaults(
    keywords: dict[str, Any], task: Task | None, burn_in: int | None
) -> tuple[dict[str, Any], int, str]:
    """Returns keywords with an evaluation's defaults, the number of robots and the fingerprint."""
    if burn_in is None and all(keywords.get(it) is None for it in ("task", "instance", "states")):
        burn_in = 25_000
    # Hidden states can arrive late on a busy machine.
    keywords = {"timeout": 30.0, **with_absolute_paths(keywords), "burn_in": burn_in}
    if keywords.get("instance") is not None:
        with Client(keywords["instance"]) as client:
            info = client.info
        keywords.setdefault("truth", info.publish_truth)
        return keywords, info.n_robots, info.worlds_fingerprint or ""
    keywords.setdefault("truth", True)  # worlds in this process can always reveal it
    world: Any = {it: keywords[it] for it in WorldArguments.__annotations__ if it in keywords}
    fingerprint = Settings.of(WildfireVectorEnv, world).read().worlds_fingerprint
    return keywords, keywords.get("robots") or (task.robots if task else 1), fingerprint


@contextmanager
def _made(
    env: str, keywords: dict[str, Any], n_robots: int, wrap: Any, n_worlds: int
) -> Generator[tuple[Any, Any]]:
    """Makes worlds; yields them without and with their wrappers."""
    worlds: Any = gymnasium.make_vec(
        env,
        num_envs=n_worlds * n_robots,
        max_episode_steps=-1,
        autoreset_mode=AutoresetMode.DISABLED,
        **keywords,
    )
    worlds.unwrapped.allow_test_worlds()
    with closing(worlds):
        shown = worlds.unwrapped
        if wrap is not None:
            from emberwatch.benchmark.wrapped import Wrapped  # needs Stable-Baselines3

            shown = Wrapped(worlds, wrap)
        yield worlds.unwrapped, shown


def _play(
    made: Any, actor: Actor, seeds: Sequence[int], columns: dict[str, Any], report: Progress
) -> list[Row]:
    """Scores a policy on the worlds of some seeds, all at the same time."""
    steps = columns["steps"]
    with made(len(seeds)) as (worlds, shown):
        tally = Tally(worlds.world_spec, len(seeds))
        actor.begin(len(seeds), worlds.num_envs)
        seen, _ = shown.reset(seed=np.repeat(seeds, columns["robots"]).tolist())
        if (worlds.lease.client.info.worlds_fingerprint or "") != columns["worlds_fingerprint"]:
            raise InvalidArgumentError(
                "worlds: changed since the evaluation began; either the file of their task, model "
                "or states has changed, or another server uses the instance"
            )
        n_actions = 1 if worlds.single_action_space.shape else worlds.world_spec.n_moves
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
