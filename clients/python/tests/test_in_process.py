"""Worlds in this process need nothing outside, survive forks, and behave like a server's."""

import copy
import os
import pickle
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import (
    FLAGS,
    MOVES,
    OBJECTIVE,
    RECORDED,
    SMALL,
    WILDFIRE,
    assert_same,
    closed_later,
    make,
    make_vec,
    rollout,
    small_server,
)
from failures import fails, refuses
from processes import asleep, isolated, script

import emberwatch
from emberwatch.errors import EmberwatchError, ServerGoneError
from emberwatch.model import Model


def make_team(**keywords: Any) -> Any:
    return closed_later(emberwatch.parallel_env(robots=2, **SMALL, **keywords))


#: Environments of all kinds.
MAKERS: dict[str, Callable[[], Any]] = {
    "path": make,
    "moves": lambda: make_vec(2, MOVES),
    "options": lambda: make_vec(2, OBJECTIVE),
    "team": make_team,
}


@pytest.fixture
def client() -> Iterator[emberwatch.Client]:
    with emberwatch.embed(worlds=2, seed=None, **FLAGS) as client:
        yield client


def threads() -> set[str]:
    return set(os.listdir("/proc/self/task"))


def opened() -> set[str]:
    files = [path for path in Path("/proc/self/fd").iterdir() if path.is_symlink()]
    return {os.readlink(path) for path in files}


@pytest.mark.parametrize("kind", MAKERS)
def test_nothing_is_opened_before_the_first_reset(kind: str) -> None:
    before = opened(), threads()
    env = MAKERS[kind]()
    assert opened() == before[0]
    assert threads() <= before[1]
    env.reset(seed=1)
    assert threads() - before[1]


#: Uses everything that needs no server.
ALONE = """
import os, warnings
import gymnasium, numpy as np
from gymnasium.utils.env_checker import check_env
import emberwatch
warnings.simplefilter("ignore")
assert os.listdir("/dev/shm") == [] and os.environ["PATH"] == ""
small = {"height": 7, "width": 5, "n_moves": 4, "burn_in": 50}
for name in ("Wildfire-v0", "WildfireMoves-v0", "WildfireObjective-v1"):
    name = f"emberwatch/{name}"
    env = gymnasium.make(name, render_mode="rgb_array", truth=True, **small)
    env.reset(seed=1)
    env.step(env.action_space.sample())
    assert env.render().ndim == 3
    check_env(env.unwrapped, skip_render_check=True)
    env.close()
    envs = gymnasium.make_vec(name, num_envs=3, **small)
    envs.reset(seed=1)
    envs.step(envs.action_space.sample())
team = emberwatch.parallel_env(robots=2, **small)
team.reset(seed=1)
team.step({agent: space.sample() for agent, space in team.action_spaces.items()})
print("done")
"""


def test_in_process_worlds_need_no_shared_memory_or_programs() -> None:
    run = isolated("ro")
    ended = run("env", "PATH=", sys.executable, "-c", ALONE)
    assert (ended.returncode, ended.stdout) == (0, "done\n"), ended.stderr


def in_child(call: Callable[[], object]) -> Any:
    """Runs a call in a forked child. Returns its result, or the code of its error."""
    context = get_context("fork")
    receiver, sender = context.Pipe()

    def child() -> None:
        try:
            sender.send(call())
        except EmberwatchError as error:
            sender.send(error.code)

    process = context.Process(target=child)
    process.start()
    sender.close()
    outcome = receiver.recv()
    process.join()
    assert process.exitcode == 0
    return outcome


def action(env: Any) -> Any:
    agents: dict[str, Any] = getattr(env, "action_spaces", {})
    zero = {agent: np.zeros(space.shape, int) for agent, space in agents.items()}
    return zero or np.zeros(env.action_space.shape, int)


@pytest.mark.parametrize("kind", MAKERS)
@pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")
def test_a_forked_child_must_reset_first(kind: str) -> None:
    env, unopened = MAKERS[kind](), MAKERS[kind]()
    n_moves = SMALL["n_moves"] if kind in ("moves", "team") else 1  # until the worlds move
    first = env.reset(seed=4)
    expected = [env.step(action(env)) for _ in range(3 * n_moves)]
    env.reset(seed=4)
    for _ in range(n_moves):
        env.step(action(env))

    def refused() -> float:
        start = time.monotonic()
        with fails("forked", match="the process that forked"):
            for _ in range(n_moves):
                env.step(action(env))
        return time.monotonic() - start

    def closed_and_reset() -> list[Any]:
        env.close()
        return [env.reset(seed=4), env.step(action(env))]

    assert in_child(refused) < 1.0
    assert_same(in_child(closed_and_reset), [first, expected[0]])
    assert_same(
        in_child(lambda: [unopened.reset(seed=4), unopened.step(action(env))]), [first, expected[0]]
    )
    assert_same([env.step(action(env)) for _ in range(2 * n_moves)], expected[n_moves:])
    assert_same([unopened.reset(seed=4), unopened.step(action(env))], [first, expected[0]])


def test_snapshots_and_forks_equal_a_servers(client: emberwatch.Client, tmp_path: Path) -> None:
    other = small_server(worlds=2).connect()
    path, seen = tmp_path / "worlds", list[Any]()
    for at in (client, other):
        lease = at.acquire(0, 2)
        lease.step([[3] * 4] * 2)
        at.snapshot(path)
        told = [lease.step([[1] * 4] * 2).results]
        told += [lease.restore(path), lease.step([[1] * 4] * 2).results]
        told += [lease.fork(0, 1), lease.step([[3] * 4] * 2).results]
        told += [at.recall(2, 0, 2).frames, at.belief(), at.info.model]
        seen.append(told)
        assert_same(told[0], told[2])
    assert_same(seen[0], seen[1])


def test_errors_have_the_codes_of_a_server(client: emberwatch.Client) -> None:
    lease = client.acquire(0)
    with fails("no_such_robot"):
        client.acquire(7)
    with fails("bad_file"):
        lease.restore("nowhere")
    assert client.status().worlds[0].holder_pids == (os.getpid(),)
    client.shutdown()
    with pytest.raises(ServerGoneError, match="ended by shutdown"):
        lease.step([3] * 4)


def test_wrong_settings_are_refused(client: emberwatch.Client) -> None:
    with fails("invalid_argument", match="embedded worlds with publish_truth"):
        client.truths(range(1))
    with fails("invalid_argument", match="^instance: expected an environment made with instance="):
        _ = make().unwrapped.instance
    for settings, words in (
        ({"snapshot_keep": 9}, "^snapshot_keep: expected to be left out"),
        ({"model": "\ud800"}, "model: expected UTF-8"),
        ({"wrolds": 2}, "^wrolds: expected the name of a setting \\(burn_in, .*\\), got 2$"),
        ({"height": 7.0}, "^height: expected an integer, True or False, text or a path, got 7.0$"),
    ):
        with fails("invalid_argument", match=words):
            emberwatch.embed(**settings)


def test_ctrl_c_ends_the_read_of_a_model_from_a_pipe(tmp_path: Path) -> None:
    os.mkfifo(fifo := tmp_path / "model.toml")
    started = script(
        f"import emberwatch; print(1, flush=True); emberwatch.embed(model={str(fifo)!r})"
    )
    assert started.line() == "1"
    asleep(started.pid)
    started.signal(signal.SIGINT)
    _, _, err = started.end()
    assert "KeyboardInterrupt" in err


def test_a_step_does_not_wait_for_other_worlds_burn_ins() -> None:
    large = {"height": 512, "width": 512, "burn_in": 4000, "worlds": 3, "threads": 1}
    with emberwatch.embed(**large, moves=4) as client:
        client.acquire(0).step([3] * 4)
        assert client.status().worlds[2].resetting


#: A burn-in of hours, which Ctrl-C ends, then short burn-ins.
INTERRUPTED = """
import gymnasium, emberwatch, os
env = gymnasium.make("emberwatch/Wildfire-v0", burn_in=10**9)
n_threads = len(os.listdir("/proc/self/task"))
print("ready", flush=True)
try:
    env.reset(seed=1)
except KeyboardInterrupt:
    print("interrupted", flush=True)
try:
    env.step(env.action_space.sample())
except emberwatch.EmberwatchError as error:
    print(error.code, flush=True)
env.close()
while len(os.listdir("/proc/self/task")) > n_threads: pass  # until the burn-in has ended
env = gymnasium.make("emberwatch/Wildfire-v0", burn_in=10)
env.reset(seed=1)
env.step(env.action_space.sample())
print("closed", flush=True)
"""


def test_ctrl_c_ends_a_burn_in() -> None:
    started = script(INTERRUPTED)
    assert started.line() == "ready"
    asleep(started.pid)
    started.signal(signal.SIGINT)
    code, out, err = started.end()
    assert (code, out.split()) == (0, ["interrupted", "closed", "closed"]), err


def write_files(folder: Path) -> None:
    """Writes a model with a map in a file of its own, a task with it, and recorded states."""
    no_fly = 'no_fly = "closed.npy"\n'
    (folder / "model.toml").write_text(no_fly + Model.named("wildfire-small").toml)
    np.save(folder / "closed.npy", np.eye(7, 5, 2, np.uint8))
    worlds = "height = 7\nwidth = 5\nmoves = 6\nburn_in = 20\nmax_steps = 9\n"
    seeds = "test_seeds = { start = 0, end = 2 }\n"
    (folder / "task.toml").write_text(f'name = "mine"\nmodel = "model.toml"\n{worlds}{seeds}')
    np.savez(folder / "lab.npz", np.random.default_rng(5).integers(0, 3, (9, 4, 4), np.uint8))
    shutil.copy(RECORDED, folder / "lab.toml")


#: Keywords that name files of `write_files`.
OF_FILES: dict[str, dict[str, Any]] = {
    "model": {**SMALL, "model": "model.toml"},
    "task": {"task": "task.toml"},
    "states": {"states": "lab.npz", "n_moves": 6},
}


def of_files(of: str, kind: str) -> Any:
    if kind == "path":
        return closed_later(gymnasium.make(WILDFIRE, **OF_FILES[of]))
    return closed_later(gymnasium.make_vec(MOVES, num_envs=2, **OF_FILES[of]))


@pytest.mark.parametrize("of", OF_FILES)
@pytest.mark.parametrize("kind", ["path", "moves"])
def test_files_are_read_once(
    of: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    env, reference = (of_files(of, kind) for _ in range(2))
    twin, pickled = copy.deepcopy(env), pickle.dumps(env)
    expected = rollout(reference, 8, seed=1001)
    monkeypatch.chdir("/")
    assert_same(rollout(pickle.loads(pickled), 8, seed=1001), expected)
    for file in tmp_path.iterdir():
        file.write_bytes(b"changed")
    for again in (env, twin):
        for _ in range(2):
            assert_same(rollout(again, 8, seed=1001), expected)
            again.close()
    with refuses("model|task|states"):
        pickle.loads(pickled)
