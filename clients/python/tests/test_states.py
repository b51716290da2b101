"""States in memory: `Model.advance`, `clone_state` and `restore_state`."""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import (
    LIVELY,
    MOVES,
    OBJECTIVE,
    SMALL,
    WILDFIRE,
    actions,
    assert_same,
    make,
    make_vec,
    small_server,
)
from failures import fails, refuses
from processes import script

from emberwatch.model import Model

PARTS = ("frame", "image", "robot", "age", "belief", "team", "others")
PATH_PARTS = (*PARTS, "local", "recent", "visited", "move", "action_mask")

#: Environments whose observations need every kind of memory.
CASES: list[tuple[str, dict[str, Any]]] = [
    (WILDFIRE, {"truth": True}),
    (WILDFIRE, {"observation": PARTS, "kind": "known+spatial+cavities"}),
    (MOVES, {"observation": PATH_PARTS, "reward": "move"}),
    (MOVES, {"observation": "recent", "render_mode": "rgb_array"}),
    (OBJECTIVE, {}),
    (OBJECTIVE, {"estimator": "known+spatial", "truth": True}),
]

#: Keeps cloning and restoring; prints the growth of its resident memory in KiB.
GROWTH = """
import gymnasium, numpy as np, emberwatch
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4
worlds = gymnasium.make_vec("emberwatch/WildfireSmallMoves-v0", 2, observation=("local", "recent"))
worlds.reset(seed=1000)
def work(times):
    for _ in range(times):
        state = worlds.unwrapped.clone_state()
        worlds.step(np.array([1, 3]))
        worlds.unwrapped.restore_state(state)
work(500)
before = resident()
work(TIMES)
print(resident() - before)
"""


def outcomes(env: Any, n_steps: int, seed: int) -> list[Any]:
    """Flies random actions."""
    seen = []
    for action in actions(env, n_steps, seed):
        seen.append(copy.deepcopy(env.step(action)))
        if env.render_mode is not None:
            seen.append(copy.deepcopy(env.render()))
    return seen


@pytest.mark.parametrize(("name", "keywords"), CASES)
@pytest.mark.parametrize("mode", [None, "NextStep", "SameStep"])
def test_a_restored_environment_continues_to_the_byte(
    name: str, keywords: dict[str, Any], mode: str | None
) -> None:
    steps, robots = 22 if name == MOVES else 5, 1 if name == OBJECTIVE else 2

    def made() -> Any:
        if mode is None:
            return make(name, max_episode_steps=None, **keywords)
        limits = {"max_episode_steps": steps + 2, "autoreset_mode": mode}
        return make_vec(4, name, robots=robots, **limits, **keywords)

    env, other = made(), made()
    env.reset(seed=7)
    other.reset(seed=8)
    outcomes(env, steps, 1)
    state = pickle.loads(pickle.dumps(env.unwrapped.clone_state()))
    expected = outcomes(env, 2 * steps, 2)
    for each in (env, other, env):
        each.unwrapped.restore_state(state)
        assert_same(outcomes(each, 2 * steps, 2), expected)
    env.unwrapped.restore_state(state)
    other.unwrapped.restore_state(state)
    assert_same(*(each.reset() for each in (env, other)))  # the next seeds are drawn alike


def test_a_state_continues_after_the_end_of_its_episode() -> None:
    env = make(MOVES, model="wildfire", burn_in=0, max_episode_steps=6)
    env.reset(seed=3)
    outcomes(env.unwrapped, 6, 1)
    state = env.unwrapped.clone_state()
    first = env.reset()
    env.unwrapped.restore_state(state)
    assert_same(env.reset(), first)


def test_states_are_refused_elsewhere() -> None:
    env = make()
    with fails("closed"):
        env.unwrapped.clone_state()
    env.reset(seed=1)
    state = env.unwrapped.clone_state()
    expected = r"state: expected a state of WildfireEnv with observation=\('frame', 'robot'\), got "
    with refuses(f"{expected}3"):
        env.unwrapped.restore_state(3)
    moves = make(MOVES)
    moves.reset(seed=1)
    with refuses(f"{expected}WildfireMovesEnv with"):
        env.unwrapped.restore_state(moves.unwrapped.clone_state())
    wider = make(width=6)
    with fails("closed"):
        wider.unwrapped.restore_state(state)
    before = wider.reset(seed=1)
    with refuses("restore_state: width: expected 6, .* got 5"):
        wider.unwrapped.restore_state(state)
    assert_same(wider.unwrapped.reset(options={"resume": True})[0], before[0])
    three, two = (make_vec(n) for n in (3, 2))
    for worlds in (three, two):
        worlds.reset(seed=1)
    with refuses("worlds: expected 2 worlds, got 3"):
        two.unwrapped.restore_state(three.unwrapped.clone_state())
    two.step(two.action_space.sample())


def test_states_of_a_servers_worlds_are_refused() -> None:
    attached = make(instance=small_server().instance)
    attached.reset(seed=1)
    words = ": expected worlds in this process, got worlds of a server"
    with refuses(f"clone_state{words}"):
        attached.unwrapped.clone_state()
    own = make()
    own.reset(seed=1)
    with refuses(f"restore_state{words}"):
        attached.unwrapped.restore_state(own.unwrapped.clone_state())
    attached.step(attached.action_space.sample())


def test_memory_does_not_grow_with_clones() -> None:
    code, grown, error = script(GROWTH.replace("TIMES", "1000")).end()
    assert code == 0, error
    # A leaked state has over 4 KiB, so 1,000 of them would take 4,000 KiB.
    assert int(grown) < 1000


@pytest.mark.parametrize("model", [LIVELY, "wildfire", "wildfire-burnout"])
def test_advance_equals_the_simulator(model: str) -> None:
    settings = {**SMALL, "model": model, "burn_in": 300, "truth": True}
    env = gymnasium.make_vec(WILDFIRE, num_envs=5, **settings)
    _, infos = env.reset(seed=2**64 - 9)
    states, seeds = infos["truth"], np.arange(5, dtype=np.uint64) + np.uint64(2**64 - 9)
    known = Model.named(model)
    for k in range(20):
        *_, infos = env.step(env.action_space.sample())
        one = known.advance(states[3], seed=int(seeds[3]), step=300 + k)
        states = known.advance(states, seed=seeds, step=300 + k)
        assert states.dtype == np.uint8 and np.array_equal(states, infos["truth"])
        assert one.shape == (7, 5) and np.array_equal(one, states[3])
    env.close()


def test_worlds_with_one_seed_share_their_random_numbers() -> None:
    model = Model.named(LIVELY)
    states = np.tile(model.advance(np.zeros((16, 16), np.uint8), seed=5, step=0), (8, 1, 1))
    states.flags.writeable = False
    shared = model.advance(np.asfortranarray(states), seed=1, step=1)
    assert (shared == shared[0]).all()
    assert (model.advance(states, seed=np.arange(8), step=1) != shared).any(axis=(1, 2)).sum() >= 7
    assert (model.advance(states, seed=1, step=2) != shared).any()
    assert model.advance(states[:0], seed=1, step=1).shape == (0, 16, 16)
    with ThreadPoolExecutor(4) as threads:
        found = threads.map(lambda _: model.advance(states, seed=1, step=1), range(8))
    assert all(np.array_equal(each, shared) for each in found)


def test_advance_refuses_wrong_arguments() -> None:
    model, states = Model.wildfire(), np.zeros((2, 3, 4), np.uint8)
    shape = r"states: expected uint8 of shape \(H, W\) or \(n, H, W\), got "
    seeds = r"seed: expected an integer within 0 to 2\*\*64 - 1, or 2 of them, got "
    for wrong, words in (
        ({"states": states.astype(int)}, rf"{shape}int64 of shape \(2, 3, 4\)"),
        ({"states": states[0, 0]}, rf"{shape}uint8 of shape \(4,\)"),
        ({"states": states[:, :0]}, "grid: expected height and width within 1 to 4096, got 0 x 4"),
        ({"states": states + np.uint8(3)}, "states: expected values below 3, got 3"),
        ({"seed": -1}, "seed: expected an integer within 0 to"),
        ({"seed": [1, 2, 3]}, seeds),
        ({"seed": [1, -1]}, seeds),
        ({"seed": [0.5, 1.0]}, seeds),
        ({"step": -1}, "step: expected an integer within 0 to"),
        ({"step": 1.5}, "step: expected an integer within 0 to"),
    ):
        with refuses(words):
            model.advance(**{"states": states, "seed": 1, "step": 1, **wrong})
    with refuses(r"grid|map"):
        Model.named("wildfire-terrain").advance(states, seed=1, step=1)
