"""Forked children use every belief, planner and environment, at sizes that start all pools."""

import os
import subprocess
import sys
from pathlib import Path

import golden_options
import numpy as np
from processes import PATIENCE, find

#: Uses each object in the parent, then in a forked child: the parent's object and a new one. Prints
#: the objects whose child did not compute the parent's numbers in time, and the number of threads
#: that outlived the objects.
SCRIPT = """
import contextlib, gc, os, signal, sys, time
import gymnasium, numpy as np
from gymnasium.vector import AsyncVectorEnv
import emberwatch
from emberwatch import belief, planning
from emberwatch.errors import EmberwatchError
from emberwatch.model import Model
from emberwatch.wrappers import BeliefObservation

FOLDER, MODEL, SIDE = sys.argv[1], Model.named("wildfire-small"), 150
GRID = {"height": SIDE, "width": SIDE}
WORLD = {**GRID, "model": "wildfire-small", "n_moves": 16, "burn_in": 2}
PRIOR = belief.uniform_prior(MODEL, **GRID)

def known(kind, n):
    return lambda: belief.known(MODEL, prior=PRIOR, kind=kind, n_worlds=n)

def load(name, kind, n, side=SIDE):
    keywords = {"kind": kind, "model": MODEL, "n_worlds": n}
    return lambda: belief.load(f"{FOLDER}/{name}", height=side, width=side, **keywords)

def believe(kept):
    kept.reset()
    frames = np.full(kept.shape, 255, np.uint8)
    frames[..., 3:6, :] = 0
    kept.correct(frames)
    kept.predict()
    return kept.belief

def plan(width):
    values = np.arange(2.0 * SIDE * SIDE).reshape(2, SIDE, SIDE)
    robots = np.array([[3, 4], [80, 90]])
    return planning.beam_search(values, robots, 16, rng=np.random.default_rng(1), width=width)

def act(env):
    results = [env.reset(seed=1000)]
    try:
        spaces = env.action_spaces
        paths = {agent: np.zeros(space.shape, int) for agent, space in spaces.items()}
    except AttributeError:
        paths = np.zeros(env.action_space.shape, int)
    results += [env.step(paths) for _ in range(2)]
    return numbers(results)

def numbers(found):
    if isinstance(found, dict):
        found = [found[key] for key in sorted(found)]
    if isinstance(found, (list, tuple)):
        return np.concatenate([np.zeros(0), *map(numbers, found)])
    return np.ravel(np.asarray(found, float) if np.asarray(found).dtype.kind in "biuf" else [])

def make_vec(name, n, **keywords):
    return lambda: gymnasium.make_vec(f"emberwatch/{name}", num_envs=n, **WORLD, **keywords)

CASES = {
    **{name: (known(name, 2), believe)
       for name, kind in belief.kinds().items() if not kind.needs_checkpoint},
    **{name: (load("learned_filter", name, 2), believe) for name in ("learned", "learned+spatial")},
    "neural": (load("neural_belief", "neural", 1), believe),
    "neural, many worlds": (load("neural_belief", "neural", 40, 16), believe),
    "autoencoder": (load("autoencoder", None, 2), believe),
    "beam_search": (lambda: 50, plan),
    "objective": (make_vec("WildfireObjective-v1", 2, prior="uniform"), act),
    **{f"objective, neural, {n} worlds":
       (make_vec("WildfireObjective-v1", n, checkpoint=f"{FOLDER}/neural_belief"), act)
       for n in (1, 2)},
    "paths": (make_vec("Wildfire-v0", 3, observation="belief"), act),
    "moves": (make_vec("WildfireMoves-v0", 3, observation="local"), act),
    "team": (lambda: emberwatch.parallel_env(action="path", robots=2, **WORLD), act),
}
assert {name.partition(",")[0] for name in CASES} >= set(belief.kinds())

def threads():
    return len(os.listdir("/proc/self/task"))

def in_child(make, use, kept, expected):
    signal.alarm(20)  # ends a child that hangs
    for _ in range(2):
        try:
            found = use(kept)
        except EmberwatchError as error:
            assert error.code == "forked"
        else:
            assert np.array_equal(found, expected)
        kept = make()
    os._exit(0)

failed = []
before = threads()
for name, (make, use) in CASES.items():
    kept = make()
    expected = use(kept)
    child = os.fork()
    if child == 0:
        try:
            in_child(make, use, kept, expected)
        finally:
            os._exit(1)
    status = os.waitpid(child, 0)[1]
    if status:
        failed.append((name, os.waitstatus_to_exitcode(status)))
    if hasattr(kept, "close"):
        kept.close()
    del kept
gc.collect()

def observing():
    env = gymnasium.make("emberwatch:emberwatch/Wildfire-v0", observation="frame", **WORLD)
    return BeliefObservation(env, checkpoint=f"{FOLDER}/neural_belief")

with contextlib.closing(AsyncVectorEnv([observing] * 2, context="fork")) as envs:
    envs.reset_async(seed=1)
    first = envs.reset_wait(timeout=20)[0]
    envs.step_async(np.zeros(envs.action_space.shape, int))
    assert (envs.step_wait(timeout=20)[0] != first).any()

end = time.monotonic() + 10
while threads() > before and time.monotonic() < end:
    time.sleep(0.01)
print(failed, "threads left:", threads() - before)
"""


def test_every_pool_is_left_to_the_parent(tmp_path: Path) -> None:
    golden = np.load(golden_options.FILE)
    for name in ("learned_filter", "neural_belief"):
        (tmp_path / name).write_bytes(golden[f"checkpoint {name}"].tobytes())
    train = [find("emberwatch-agent"), "train", "--learner=autoencoder", "--steps=1", "--burn-in=0"]
    train += ["--height=150", "--width=150", f"--out={tmp_path}/train", "--model=wildfire-small"]
    subprocess.run(train, check=True, capture_output=True, timeout=PATIENCE)
    (tmp_path / "train" / "checkpoint.safetensors").rename(tmp_path / "autoencoder")
    run = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", SCRIPT, str(tmp_path)]
    # NumPy's threads end at the first fork, so it must not count any.
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    ended = subprocess.run(run, env=environment, capture_output=True, text=True, timeout=600)
    assert (ended.returncode, ended.stdout) == (0, "[] threads left: 0\n"), ended.stderr
