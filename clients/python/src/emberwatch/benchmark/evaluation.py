"""Evaluation of Python policies on the benchmark's worlds."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing, contextmanager
from typing import Any, Final, TextIO

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

import emberwatch._native as _native
from emberwatch.benchmark.policies import Actor, Policy
from emberwatch.benchmark.rows import Row, new_rows
from emberwatch.client.client import Client
from emberwatch.client.wire import TRUTH_BUFFER
from emberwatch.common.arguments import as_count, as_list, as_seed
from emberwatch.common.paths import with_absolute_paths
from emberwatch.envs.observations import OF_BELIEF, OF_TEAM, cells_of, names_of
from emberwatch.envs.settings import WorldSpec
from emberwatch.errors import invalid, repr_of
from emberwatch.model.moves import fly
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
    progress: TextIO | None = sys.stderr,
    **keywords: Any,
) -> list[Row]:
    """Scores a policy on several worlds, by default as `emberwatch-agent compare` does.

    Args:
        policy: A function from stacked observations of several worlds to their actions, or a model
            of Stable-Baselines3, also of RecurrentPPO or MaskablePPO. A method `begin(n_worlds)`,
            if there is one, is called before each batch of worlds.
        name: The policy's name in the table.
        seeds: The seeds of the worlds; None: the test seeds of the task, or 0 to 7. Seeds below
            1000 are test worlds.
        steps: Number of scored steps, each a path, in each world; None: the task's, or 1,500.
        burn_in: Number of steps before the first scored one; None: the value of the task or the
            running server, or 25,000. Recorded worlds have no burn-in.
        env: The environment: `"emberwatch/WildfireMoves-v0"` or `"emberwatch/Wildfire-v0"`.
        estimator: The name of the policy's belief in the table; None: `known` if
            `observation` has a belief, otherwise `none`.
        deterministic: Argument of a model's `predict`.
        batch: Number of worlds to simulate at the same time, in the order of the seeds.
        wrap: A function that wraps the worlds (a `VecEnv` of Stable-Baselines3) as in the training,
            for example `lambda worlds: VecFrameStack(worlds, 4)`, or
            `lambda worlds: VecNormalize.load("statistics.pkl", worlds)`. Statistics stay unchanged.
        csv: A new file for the rows, written after the last world. If the evaluation ends early,
            there is no file.
        progress: The stream for a line after each batch; None: no output.
        keywords: Keywords of the environment, such as `task`, `model`, `height` and `observation`.
            With several `robots`, each row of observations and actions belongs to one robot.

    Returns:
        One row for each seed, in order.

    Raises:
        ExistingFileError: If `csv` exists.
        InvalidArgumentError: If an argument is invalid, the policy does not fit the worlds, or the
            file cannot be written.
    """
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
    keywords, n_robots = _with_defaults(keywords, task, burn_in)
    parts = set(names_of(keywords.get("observation")))
    columns = {
        "policy": name,
        "estimator": estimator or (keywords.get("kind", "known") if OF_BELIEF & parts else "none"),
        "robots": n_robots,
        "team": "shared" if n_robots > 1 and OF_TEAM & parts else "alone",
        "steps": steps,
    }
    if keywords.get("instance") is not None:
        batch = min(batch, TRUTH_BUFFER)
    begin = time.monotonic()
    with new_rows(csv) as rows:
        for first in range(0, len(chosen), batch):
            part = chosen[first : first + batch]
            with _made(env, keywords, len(part) * n_robots, wrap) as (worlds, shown):
                actor = Actor(policy, worlds, shown, deterministic=deterministic)
                rows += _play(worlds, shown, actor, part, columns)
            if progress is not None:
                line = f"{name}: {len(rows)} of {len(chosen)} worlds"
                print(f"{line}, {time.monotonic() - begin:.0f} s", file=progress, flush=True)
    return rows


def _with_defaults(
    keywords: dict[str, Any], task: Task | None, burn_in: int | None
) -> tuple[dict[str, Any], int]:
    """Returns keywords with an evaluation's defaults, and the number of robots in each world."""
    if burn_in is None and all(keywords.get(it) is None for it in ("task", "instance", "states")):
        burn_in = 25_000
    truth, n_robots = True, keywords.get("robots") or (task.robots if task else 1)
    if keywords.get("instance") is not None:
        with Client(keywords["instance"]) as client:
            truth, n_robots = client.info.publish_truth, client.info.n_robots
    # Hidden states can arrive late on a busy machine.
    defaults = {"timeout": 30.0, "truth": truth}
    return {**defaults, **with_absolute_paths(keywords), "burn_in": burn_in}, n_robots


@contextmanager
def _made(env: str, keywords: dict[str, Any], n_rows: int, wrap: Any) -> Generator[tuple[Any, Any]]:
    """Makes worlds; yields them without and with their wrappers."""
    worlds: Any = gymnasium.make_vec(
        env,
        num_envs=n_rows,
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
    worlds: Any, shown: Any, actor: Actor, seeds: Sequence[int], columns: dict[str, Any]
) -> list[Row]:
    """Scores a policy on the worlds of some seeds, all at the same time."""
    steps = columns["steps"]
    tally = _Tally(worlds.world_spec, len(seeds))
    seen, _ = shown.reset(seed=np.repeat(seeds, columns["robots"]).tolist())
    fingerprint = worlds.lease.client.info.worlds_fingerprint or ""
    n_actions = 1 if worlds.single_action_space.shape else worlds.world_spec.n_moves
    truncated = np.zeros(worlds.num_envs, np.bool_)
    for step in range(1, steps + 1):
        flown: list[NDArray[np.integer]] = []
        for _ in range(n_actions):
            begin = time.perf_counter()
            flown.append(actor.act(seen))
            tally.seconds += time.perf_counter() - begin
            seen, _, _, truncated, _ = shown.step(flown[-1])
        if truncated.any() and step < steps:
            raise invalid("steps", f"at most {step}, the length of these episodes", steps)
        paths = np.stack(flown, axis=1).reshape(len(truncated), -1)
        tally.add(worlds.results, paths, worlds.truths)
    columns = {**columns, "worlds_fingerprint": fingerprint}
    return [tally.row(world, world_seed=seed, **columns) for world, seed in enumerate(seeds)]


class _Tally:
    """Sums of results over the steps of several worlds, one entry for each world."""

    def __init__(self, spec: WorldSpec, n_worlds: int) -> None:
        self._spec: Final = spec
        target = 0 if spec.described is None else spec.described.target_state
        self._merit = _native.MeritTally(n_worlds, spec.height, spec.width, target)
        #: Rewards, distinct visited cells, visits, hits, and cells in the state that pays most.
        self._sums = np.zeros((5, n_worlds))
        #: Seconds that the policy took for all actions.
        self.seconds = 0.0

    def add(
        self,
        results: NDArray[np.void],
        paths: NDArray[np.integer],
        truths: NDArray[np.uint8] | None,
    ) -> None:
        """Adds a step of all robots; `truths`: hidden states of their worlds, if known."""
        n_robots, robots = self._spec.n_robots, results["robot"]
        worlds = results["world"][::n_robots]
        n_visits = robots["n_visited"].reshape(-1, n_robots).sum(1)
        counts = (worlds[name] for name in ("n_hits", "n_target_cells"))
        self._sums += [worlds["reward"], worlds["n_visited"], n_visits, *counts]
        visited = np.zeros((len(worlds), self._spec.height, self._spec.width), np.bool_)
        cells = fly(np.stack((robots["start_row"], robots["start_col"]), 1), paths, self._spec)
        rows = np.arange(len(robots))[:, np.newaxis]
        visited[rows // n_robots, cells[..., 0], cells[..., 1]] = True
        self._merit.update(
            visited,
            cells_of(robots).reshape(-1, n_robots, 2),
            worlds["n_hits"].astype(np.uint32),
            worlds["n_target_cells"].astype(np.uint32),
            None if truths is None or not self._spec.described else truths[::n_robots],
        )

    def row(self, world: int, **columns: Any) -> Row:
        """Returns the row of a world; `columns`: values that do not depend on its steps."""
        steps = columns["steps"]
        reward, n_visited, n_visits, n_hits, n_fire = self._sums[:, world].tolist()
        detected, n_burning, seen, distance, grid_seen = self._merit.merit(world)
        return Row(
            **columns,
            mean_reward=reward / steps,
            mean_distinct_cells=n_visited / steps,
            hit_rate=n_hits / max(n_visited, 1),
            mean_fire_cells=n_fire / steps,
            mean_plan_millis=1e3 * self.seconds / steps / self._sums.shape[1],
            brier="",
            moves=self._spec.n_moves,
            mean_repeated=1.0 - n_visited / n_visits,
            steps_to_detection=detected,
            burning_cells_at_detection=n_burning,
            burning_seen_share=seen,
            front_distance=distance,
            grid_seen_share=grid_seen,
        )
