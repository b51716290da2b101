"""A policy in Python on the benchmark's worlds, for the table of `emberwatch-agent compare`.

    rows = evaluate(policy, name="ppo", seeds=range(32), csv="ppo.csv", model="wildfire-small", ...)

and `emberwatch-agent compare --add ppo.csv`, with the same worlds and steps, puts them beside its
own policies, paired by world.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, TextIO, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emberwatch import wire
from emberwatch.arguments import as_integer, as_seed, told
from emberwatch.client import Client
from emberwatch.errors import InvalidArgumentError, invalid
from emberwatch.merit import RECENT_STEPS, MeritTally
from emberwatch.moves import fly
from emberwatch.observations import OF_BELIEF, OF_TEAM, cells_of, names_of
from emberwatch.rows import Row, RowFile
from emberwatch.rows import read as read
from emberwatch.settings import WorldSpec
from emberwatch.tasks import FIRST_TRAINING_SEED, Task, built_in_tasks

#: Takes the stacked observations of some worlds; returns an action for each.
Policy = Callable[[Any], Any]

_MOVES: Final = "emberwatch/WildfireMoves-v0"
_PATHS: Final = "emberwatch/Wildfire-v0"

#: Of `emberwatch-agent compare`.
_BURN_IN: Final = 25_000
_SEEDS: Final = range(8)
_STEPS: Final = 1500

#: A busy machine may keep the hidden states back for longer than a learner would wait, seconds.
_TIMEOUT: Final = 30.0

#: Keywords of the environment that an evaluation sets itself.
_SET: Final = ("reward", "num_envs", "max_episode_steps", "autoreset_mode")


class _Tally:
    """Sums over the steps of some worlds."""

    def __init__(self, spec: WorldSpec, n_worlds: int, recent_steps: int) -> None:
        self._spec: Final = spec
        self.n_moves: Final = spec.n_moves
        self.n_robots: Final = spec.n_robots
        self.recent_steps: Final = recent_steps
        self._shape = (n_worlds, spec.height, spec.width)
        described = spec.described
        self._knows_target = described is not None
        target = 0 if described is None else described.target_state
        self.merit: Final = MeritTally(
            n_worlds, self._shape[1:], target=target, recent_steps=recent_steps
        )
        self.reward = np.zeros(n_worlds)
        self.n_visited, self.n_visits, self.n_hits, self.n_fire = np.zeros((4, n_worlds), np.int64)
        self.seconds = 0.0

    def timed(self, act: Policy, seen: Any) -> Any:
        begin = time.perf_counter()
        actions = act(seen)
        self.seconds += time.perf_counter() - begin
        return actions

    def add(
        self,
        results: NDArray[np.void],
        paths: NDArray[np.integer],
        truths: NDArray[np.uint8] | None,
    ) -> None:
        """One step of all robots, and the hidden states of their worlds, where these are known."""
        worlds = results["world"][:: self.n_robots]
        self.reward += worlds["reward"]
        self.n_visited += worlds["n_visited"]
        self.n_visits += results["robot"]["n_visited"].reshape(-1, self.n_robots).sum(1, np.int64)
        self.n_hits += worlds["n_hits"]
        self.n_fire += worlds["n_target_cells"]
        self.merit.update(
            self._visited(results["robot"], paths),
            cells_of(results["robot"]).reshape(-1, self.n_robots, 2),
            n_hits=worlds["n_hits"],
            n_burning=worlds["n_target_cells"],
            states=None if truths is None or not self._knows_target else truths[:: self.n_robots],
        )

    def _visited(self, robots: NDArray[np.void], paths: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Cells that some robot of each world visited, `(n_worlds, H, W)`."""
        visited = np.zeros(self._shape, np.bool_)
        worlds = np.arange(len(robots))[:, np.newaxis] // self.n_robots
        cells = fly(np.stack((robots["start_row"], robots["start_col"]), 1), paths, self._spec)
        visited[worlds, cells[..., 0], cells[..., 1]] = True
        return visited


def evaluate(
    policy: Any,
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
    csv: str | os.PathLike[str] | None = None,
    progress: TextIO | None = sys.stderr,
    **keywords: Any,
) -> list[Row]:
    """Scores a policy; defaults are those of `emberwatch-agent compare`.

    Args:
        policy: A function from the stacked observations of some worlds to their actions, or a model
            of Stable-Baselines3. If it has a method `begin(n_worlds)`, that is called whenever
            other worlds begin.
        name: What the table calls it.
        seeds: The worlds; None: those to test the task on, or 0 to 7. Those below 1000 are test
            worlds.
        steps: Scored steps, thus paths, of each world; None: those of the task, or 1,500.
        burn_in: Steps before the first scored one; None: 25,000, or as the task or the running
            server has it. Recorded worlds have none.
        env: What it acts in: `"emberwatch/WildfireMoves-v0"` or `"emberwatch/Wildfire-v0"`.
        estimator: What the table says of its belief; None: `known_model` where `observation` has
            a belief, else `none`.
        deterministic: Passed on to Stable-Baselines3.
        batch: Worlds at a time, in the order of the seeds.
        recent_steps: Steps for which a cell counts as seen after a visit, in the figures of merit.
            Those that need the hidden states are None with `truth=False`, and where a running
            server does not publish them, or hides its model or the description of recorded
            worlds.
        csv: A file to write rows to. Rows of this policy that it has already are kept, and not
            run again; those of other policies are kept. A changed policy needs another name.
        progress: Where to write how far it is; None: nowhere.
        keywords: Of the environment: `task`, `model`, `height`, `n_moves`, `observation`, ...
            With `robots` the policy acts for all robots of each world: rows are robots.

    Returns:
        A row for each seed, in order.
    """
    task = None if keywords.get("task") is None else Task.named(keywords["task"])
    seeds = (task.test_seeds if task else _SEEDS) if seeds is None else seeds
    steps = (task.max_steps if task else _STEPS) if steps is None else steps
    chosen = _check(name, seeds, steps, batch, recent_steps, env, keywords)
    act = _acting(policy, deterministic)
    if burn_in is None and all(keywords.get(it) is None for it in ("task", "instance", "states")):
        burn_in = _BURN_IN
    keywords["burn_in"] = burn_in
    keywords.setdefault("timeout", _TIMEOUT)
    if keywords.setdefault("truth", _publishes(keywords.get("instance"))):
        batch = min(batch, wire.TRUTH_BUFFER)
    if estimator is None:
        has_belief = OF_BELIEF & set(names_of(keywords.get("observation")))
        estimator = "known_model" if has_belief else "none"
    file = None if csv is None else RowFile(Path(csv))
    robots = task.robots if task else keywords.get("robots") or 1
    shares = robots > 1 and bool(OF_TEAM & set(names_of(keywords.get("observation"))))
    team = "shared" if shares else "alone"
    kind = (name, estimator, robots, team)
    done: dict[int, Row] = {}
    if file is not None:
        done = file.done(kind, steps, _n_moves(env, keywords, robots), recent_steps)
    missing = [seed for seed in chosen if seed not in done]
    report = _Progress(progress, name, chosen, len(missing) * steps)
    for first in range(0, len(missing), batch):
        part = missing[first : first + batch]
        if hasattr(policy, "begin"):
            policy.begin(len(part))
        tally = _play(env, keywords, robots, act, part, steps, recent_steps, report)
        rows = _rows(tally, part, steps, kind)
        done |= {row.world_seed: row for row in rows}
        if file is not None:
            file.add(rows)
    report.end()
    return [done[seed] for seed in chosen]


def suite(
    policy: Any,
    *,
    name: str,
    folder: str | os.PathLike[str] = "suite",
    tasks: Iterable[str | os.PathLike[str]] | None = None,
    worlds: int | None = None,
    **keywords: Any,
) -> dict[str, list[Row]]:
    """Scores a policy on the test worlds of tasks, for `emberwatch-agent suite --out FOLDER`.

    Args:
        policy: As of `evaluate`, for all tasks; or a mapping from the name of each task to one.
        name: What tables call it.
        folder: Where rows are kept, a CSV file a task. What is there already is not run again.
        tasks: Names of tasks or task files; None: all that have names, or those of the mapping.
        worlds: Worlds of each task, the first of its test seeds; None: all of them.
        keywords: As of `evaluate`, but for `task`, `seeds`, `steps` and `csv`.

    Returns:
        A row for each world, by the name of its task.
    """
    for keyword in ("task", "seeds", "steps", "csv"):
        if keyword in keywords:
            raise InvalidArgumentError(f"{keyword}: expected none, as suite sets it")
    if worlds is not None and (as_integer(worlds) or 0) < 1:
        raise invalid("worlds", "at least 1", told(worlds))
    by_task = cast("Mapping[str, Any]", policy) if isinstance(policy, Mapping) else None
    chosen = list(tasks or by_task or built_in_tasks())
    rows: dict[str, list[Row]] = {}
    for source in chosen:
        task = Task.named(source)
        if by_task is not None and task.name not in by_task:
            raise invalid("policy", f"one for the task {task.name}", ", ".join(by_task))
        rows[task.name] = evaluate(
            policy if by_task is None else by_task[task.name],
            name=name,
            task=source,
            seeds=task.test_seeds[:worlds],
            csv=Path(folder) / f"{task.name}.csv",
            **keywords,
        )
    return rows


def _make(env: str, keywords: dict[str, Any], n_robots: int, n_worlds: int) -> Any:
    make: Any = {"num_envs": n_worlds * n_robots, "max_episode_steps": -1, **keywords}
    return gymnasium.make_vec(env, autoreset_mode=AutoresetMode.DISABLED, **make)


def _publishes(instance: str | None) -> bool:
    """Whether there are hidden states to be had: a private server publishes them."""
    if instance is None:
        return True
    with Client(instance) as client:
        return client.info.publish_truth


def _n_moves(env: str, keywords: dict[str, Any], n_robots: int) -> int:
    """Moves of a path; starts no server."""
    worlds = _make(env, keywords, n_robots, 1)
    worlds.close()
    return worlds.unwrapped.n_moves


def _play(
    env: str,
    keywords: dict[str, Any],
    n_robots: int,
    act: Policy,
    seeds: Sequence[int],
    steps: int,
    recent_steps: int,
    report: _Progress,
) -> _Tally:
    """Flies so many paths in some worlds."""
    worlds = _make(env, keywords, n_robots, len(seeds))
    worlds.unwrapped.allow_test_worlds()
    try:
        if worlds.unwrapped.world_spec.n_robots != n_robots:
            raise InvalidArgumentError(
                f"robots: expected {worlds.unwrapped.world_spec.n_robots}, as the server's worlds "
                f"have, got {n_robots}"
            )
        tally = _Tally(worlds.unwrapped.world_spec, len(seeds), recent_steps)
        seen, _ = worlds.reset(seed=np.repeat(seeds, n_robots).tolist())
        n_actions = tally.n_moves if env == _MOVES else 1
        truncated = np.zeros(worlds.num_envs, np.bool_)
        for step in range(1, steps + 1):
            flown: list[NDArray[np.integer]] = []
            for _ in range(n_actions):
                # A copy: a policy may use its array again.
                flown.append(np.array(tally.timed(act, seen)))
                seen, _, _, truncated, _ = worlds.step(flown[-1])
            if truncated.any() and step < steps:
                raise invalid("steps", f"at most {step}, as episodes of these worlds have", steps)
            paths = np.stack(flown, axis=1).reshape(len(truncated), -1)
            tally.add(worlds.unwrapped.results, paths, worlds.unwrapped.truths)
            report.add(len(seeds))
    finally:
        worlds.close()
    return tally


def _rows(
    tally: _Tally, seeds: Sequence[int], steps: int, kind: tuple[str, str, int, str]
) -> list[Row]:
    name, estimator, robots, team = kind
    return [
        Row(
            policy=name,
            estimator=estimator,
            world_seed=seed,
            steps=steps,
            mean_reward=float(tally.reward[index]) / steps,
            mean_distinct_cells=int(tally.n_visited[index]) / steps,
            hit_rate=int(tally.n_hits[index]) / max(int(tally.n_visited[index]), 1),
            mean_fire_cells=int(tally.n_fire[index]) / steps,
            mean_plan_millis=1e3 * tally.seconds / steps / len(seeds),
            brier="",
            moves=tally.n_moves,
            robots=robots,
            team=team,
            mean_repeated=1.0 - int(tally.n_visited[index]) / int(tally.n_visits[index]),
            recent_steps=tally.recent_steps,
            **asdict(tally.merit.merit(index)),
        )
        for index, seed in enumerate(seeds)
    ]


def _check(
    name: str,
    seeds: Iterable[int],
    steps: int,
    batch: int,
    recent_steps: int,
    env: str,
    keywords: dict[str, Any],
) -> list[int]:
    """The seeds as a list; refuses what no worlds can be made of."""
    if not isinstance(name, str) or not name or not name.isprintable():  # pyright: ignore[reportUnnecessaryIsInstance]
        raise invalid("name", "a name for the table", repr(name))
    if env not in (_MOVES, _PATHS):
        raise invalid("env", f"{_MOVES!r} or {_PATHS!r}", repr(env))
    numbers = {"steps": steps, "batch": batch, "recent_steps": recent_steps}
    for what, number in numbers.items():
        if not isinstance(number, int | np.integer) or number < 1:  # pyright: ignore[reportUnnecessaryIsInstance]
            raise invalid(what, "at least 1", repr(number))
    for what in _SET:
        if what in keywords:
            raise InvalidArgumentError(f"{what}: expected none, as evaluate sets it")
    if not isinstance(seeds, Iterable):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise invalid("seeds", "some, such as range(8)", repr(seeds))
    chosen = [as_seed(seed) for seed in seeds]
    if not chosen or len(set(chosen)) < len(chosen):
        raise invalid("seeds", "some, each once", chosen)
    return chosen


def _acting(policy: Any, deterministic: bool) -> Policy:
    predict = getattr(policy, "predict", None)
    if predict is not None:
        return lambda observations: predict(observations, deterministic=deterministic)[0]
    if not callable(policy):
        raise invalid(
            "policy", "a function of observations, or a model of Stable-Baselines3", repr(policy)
        )
    return cast("Policy", policy)


class _Progress:
    """Says how far an evaluation is, a line a second on a terminal, else a line at its end."""

    def __init__(self, out: TextIO | None, name: str, seeds: Sequence[int], n_steps: int) -> None:
        n_test = sum(seed < FIRST_TRAINING_SEED for seed in seeds)
        sort = {0: "", len(seeds): " test"}.get(n_test, f" ({n_test} of them test)")
        self._out, self._title = out, f"{name}: {len(seeds)}{sort} worlds"
        self._n_steps, self._n_done = n_steps, 0
        self._begin = self._last = time.monotonic()

    def add(self, n_steps: int) -> None:
        self._n_done += n_steps
        now = time.monotonic()
        if self._out is not None and self._out.isatty() and now - self._last > 1.0:
            self._last = now
            left = (now - self._begin) * (self._n_steps / self._n_done - 1.0)
            share = 100 * self._n_done // self._n_steps
            print(f"\r{self._title}, {share} %, {left:.0f} s left ", end="", file=self._out)

    def end(self) -> None:
        if self._out is not None:
            start = "\r" if self._out.isatty() else ""
            seconds = time.monotonic() - self._begin
            print(f"{start}{self._title}, {seconds:.0f} s{' ' * 20}".rstrip(), file=self._out)


def summary(rows: Sequence[Row]) -> str:
    """The mean reward of a step, and its standard error over worlds."""
    rewards = np.array([row.mean_reward for row in rows])
    n_test = sum(row.world_seed < FIRST_TRAINING_SEED for row in rows)
    error = rewards.std(ddof=1) / math.sqrt(len(rows)) if len(rows) > 1 else math.nan
    sort = "test " if n_test == len(rows) else "" if n_test == 0 else f"({n_test} test) "
    return (
        f"{rows[0].policy}: {rewards.mean():.2f} +- {error:.2f} a step on {len(rows)} {sort}worlds"
    )
