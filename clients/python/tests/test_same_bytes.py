"""Every environment returns the same bytes as when `same_bytes.json` was recorded.

The file has one digest per 100 returned values, over their types, ordered keys, dtypes, shapes and
bytes. The tests check the first 600 of its 1,000 steps, for worlds in this process and on a server.
`python test_same_bytes.py` records the file again, from the installed package.
"""

import functools
import hashlib
import itertools
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from environments import LIVELY, MOVES, OBJECTIVE, RECORDED, WILDFIRE, closed_later, make, make_vec
from gymnasium.vector import AutoresetMode
from processes import at_once, at_the_end, server

import emberwatch

FILE = Path(__file__).with_name("same_bytes.json")

N_RECORDED, N_STEPS, N_PER_DIGEST = 1000, 600, 100

#: Moves per path.
T = 6

WORLD: dict[str, Any] = {"height": 9, "width": 11, "n_moves": T, "burn_in": 60, "model": LIVELY}
FLAGS: dict[str, Any] = {"height": 9, "width": 11, "moves": T, "burn_in": 60, "model": LIVELY}

PARTS = ("frame", "image", "robot", "age", "belief", "team", "others")
MOVES_PARTS = (*PARTS, "local", "recent", "visited", "move")

#: The server's flag for each keyword of a world.
OF_SERVERS = {
    name: name for name in ("height", "width", "burn_in", "model", "states", "robots")
} | {"n_moves": "moves"}

#: The values that an environment returns, call by call.
Outcomes = Iterator[object]


def told(value: Any) -> Iterator[bytes]:
    """Yields a value as bytes, including everything that a caller can distinguish."""
    yield f"{type(value).__name__} ".encode()
    if isinstance(value, Mapping):
        yield from told(list(value.items()))
    elif isinstance(value, np.ndarray | np.generic) and value.dtype != object:
        yield f"{value.dtype.descr} {value.shape} ".encode() + value.tobytes()
    elif isinstance(value, tuple | list | np.ndarray):
        yield f"{len(value)} ".encode()
        for each in value:
            yield from told(each)
    else:
        assert value is None or isinstance(value, bool | int | float | str), type(value)
        yield f"{value!r} ".encode()


def digests(outcomes: Outcomes) -> list[str]:
    found = list[str]()
    while batch := list(itertools.islice(outcomes, N_PER_DIGEST)):
        digest = hashlib.sha256()
        for outcome in batch:
            for piece in told(outcome):
                digest.update(piece)
        found.append(digest.hexdigest()[:16])
    return found


def actions(high: int, *shape: int) -> Iterator[Any]:
    rng = np.random.default_rng(3)
    return (rng.integers(0, high, shape) for _ in range(N_STEPS))


def placed(attaches: bool, n_worlds: int, keywords: dict[str, Any]) -> dict[str, Any]:
    """Returns keywords of worlds in this process, or of the same worlds on a server."""
    if not attaches:
        return keywords
    flags = {flag: keywords.get(name) for name, flag in OF_SERVERS.items()}
    instance = server(worlds=n_worlds, publish_truth=True, **flags).instance
    kept = {name: value for name, value in keywords.items() if name not in OF_SERVERS}
    return {"instance": instance, "timeout": 60.0, **kept}


def single(name: str, high: int, *shape: int, attaches: bool, **keywords: Any) -> Outcomes:
    """Runs episodes of one environment: one is cut short, and one is resumed."""
    keywords = {**WORLD, "max_episode_steps": 70, **keywords}
    env = make(name, **placed(attaches, 1, keywords))
    yield env.reset(seed=11)
    for step, action in enumerate(actions(high, *shape)):
        outcome = env.step(action)
        yield outcome
        if step == 50:
            yield env.reset(seed=step)
        elif step == 500:
            yield env.reset(options={"resume": True})
        elif outcome[2] or outcome[3]:
            yield env.reset()
        if env.render_mode == "rgb_array" and step % 50 == 0:
            yield env.render()


def vector(
    name: str,
    mode: AutoresetMode,
    high: int,
    *shape: int,
    attaches: bool,
    robots: int = 1,
    **keywords: Any,
) -> Outcomes:
    """Runs episodes of three worlds, which end at different times."""
    n_rows = 3 * robots
    if robots > 1:
        keywords["robots"] = robots
    keywords = {**WORLD, "max_episode_steps": 70, **keywords}
    env = make_vec(n_rows, name, autoreset_mode=mode, **placed(attaches, 3, keywords))
    yield env.reset(seed=21)
    over, last = np.zeros(n_rows, np.bool_), np.arange(n_rows) >= n_rows - robots
    for step, chosen in enumerate(actions(high, n_rows, *shape)):
        if over.any() and mode is AutoresetMode.DISABLED:
            yield env.reset(options={"reset_mask": over})
        outcome = env.step(chosen)
        yield outcome
        over = outcome[2] | outcome[3]
        if step == 17:
            yield env.reset(options={"reset_mask": last})
        elif step == 501:
            yield env.reset(options={"resume": True})
            over[:] = False
        if step % 50 == 0:
            yield env.unwrapped.results


def team(action: str, high: int, *shape: int, attaches: bool, **keywords: Any) -> Outcomes:
    keywords = {**WORLD, "robots": 3, "max_episode_steps": 70, **keywords}
    env = closed_later(emberwatch.parallel_env(action=action, **placed(attaches, 1, keywords)))
    yield env.reset(seed=31)
    for chosen in actions(high, 3, *shape):
        yield env.step(dict(zip(env.agents, chosen, strict=True)))
        yield env.state()
        if not env.agents:
            yield env.reset()


def members() -> Outcomes:
    """Runs two environments that fly the robots of one world together."""
    instance = server(robots=2, **FLAGS).instance
    keywords = {"instance": instance, "observation": PARTS, "timeout": 60.0}
    envs = [make(robot=robot, reward="marginal", **keywords) for robot in range(2)]
    yield [env.reset(seed=41) for env in envs]
    for chosen in actions(4, 2, T):
        calls = zip(envs, chosen, strict=True)
        yield at_once(*(functools.partial(env.step, path) for env, path in calls))


def lease(attaches: bool) -> Outcomes:
    """Flies three worlds with the plain client: all robots at once, or world by world."""
    flags = {"worlds": 3, "robots": 2, "coverage": "client", "history": 5, **FLAGS}
    client = server(**flags).connect() if attaches else emberwatch.embed(**flags)
    lease = client.acquire(0, 6)
    lease.reset([1, 2, 3])
    for step, paths in enumerate(actions(4, 6, T)):
        options = {"team": step % 3 == 0, "full": step % 4 == 0}
        groups = [range(6)] if step % 5 else [range(0, 2), range(2, 6)]
        for robots in groups:
            answer = lease.step(paths[robots.start : robots.stop], robots=robots, **options)
            yield answer.first_robot, answer.worlds, answer.robots, answer.frames, answer.results
        yield answer.world_of, answer.result(1), client.recall(step, 0, 6).frames


def recorded(name: str, high: int, *shape: int, **keywords: Any) -> Outcomes:
    """Runs worlds of recorded states, which end with the last recorded state."""
    with tempfile.TemporaryDirectory() as folder:
        rng, path = np.random.default_rng(5), Path(folder, "states.npz")
        lengths = {"states_000": 40, "states_001": 53}
        np.savez(path, **{n: rng.integers(0, 3, (k, 8, 9), np.uint8) for n, k in lengths.items()})
        path.with_suffix(".toml").write_bytes(RECORDED.read_bytes())
        of_states = dict.fromkeys(("height", "width", "burn_in", "model"))
        keywords |= {**of_states, "states": path, "max_episode_steps": None}
        yield from vector(name, AutoresetMode.NEXT_STEP, high, *shape, **keywords)


def cases(attaches: bool) -> dict[str, Callable[[], Outcomes]]:
    """Returns all cases by name, in this process or on a server."""
    where = {"attaches": attaches}
    path = {"observation": PARTS, "truth": True, **where}
    moves = {"observation": MOVES_PARTS, "reward": "move", "truth": True, **where}
    team_moves = {"observation": MOVES_PARTS, "reward": "marginal", "max_episode_steps": 300}
    team_moves |= where
    found: dict[str, Callable[[], Outcomes]] = {
        "wildfire": functools.partial(single, WILDFIRE, 4, T, render_mode="rgb_array", **where),
        "wildfire, all parts": functools.partial(single, WILDFIRE, 4, T, **path),
        "moves": functools.partial(single, MOVES, 4, **where),
        "moves, all parts": functools.partial(single, MOVES, 4, **moves),
        "objective": functools.partial(single, OBJECTIVE, 8, estimator="known", **where),
        "team, paths": functools.partial(team, "path", 4, T, reward="team", truth=True, **where),
        "team, moves": functools.partial(team, "move", 4, **team_moves),
        "lease": functools.partial(lease, **where),
        "recorded, paths": functools.partial(
            recorded, WILDFIRE, 4, T, observation=PARTS[:4], **where
        ),
        "recorded, moves": functools.partial(recorded, MOVES, 4, reward="move", **where),
    }
    for mode in AutoresetMode:
        of_paths = functools.partial(vector, WILDFIRE, mode, 4, T, robots=2, reward="marginal")
        of_moves = functools.partial(vector, MOVES, mode, 4, max_episode_steps=75)
        found |= {
            f"wildfire, {mode.name}": functools.partial(of_paths, **path),
            f"moves, {mode.name}": functools.partial(of_moves, **moves),
            f"objective, {mode.name}": functools.partial(
                vector, OBJECTIVE, mode, 8, estimator="known", truth=True, **where
            ),
        }
    if attaches:
        found["members"] = members
    return found


CASES = {"here": cases(attaches=False), "at a server": cases(attaches=True)}


@pytest.mark.parametrize(("place", "case"), [(at, case) for at in CASES for case in CASES[at]])
def test_environments_return_the_recorded_bytes(place: str, case: str) -> None:
    *found, _ = digests(CASES[place][case]())
    assert found == json.loads(FILE.read_text())[case][: len(found)] and len(found) > 4


if __name__ == "__main__":
    N_STEPS = N_RECORDED
    recording = list[str]()
    for name, outcomes in CASES["at a server"].items():
        recording.append(f"{json.dumps(name)}: {json.dumps(digests(outcomes()))}")
        at_the_end.close()
    FILE.write_text("{\n" + ",\n".join(recording) + "\n}\n")
