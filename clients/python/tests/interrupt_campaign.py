"""Random interrupts in steps and resets: afterwards, environments show what their worlds show.

`python interrupt_campaign.py 2000` ends once so many interrupts have landed in calls, and says how
many landed in each kind of environment.
"""

import logging
import random
import signal
import sys
import warnings
from collections import Counter
from collections.abc import Callable
from types import FrameType
from typing import Any

import gymnasium
import numpy as np
from environments import (
    MOVES,
    OBJECTIVE,
    SMALL,
    assert_same,
    closed_later,
    make,
    make_vec,
    small_server,
)
from processes import at_the_end

import emberwatch

PARTS = ("frame", "robot", "age", "belief")
MOVE = (*PARTS, "visited", "move", "local", "recent")

#: Environments, and how many of their steps fly a path.
KINDS: dict[str, tuple[Callable[[], Any], int]] = {
    "path": (lambda: make(observation=PARTS, truth=True), 1),
    "moves": (lambda: make(MOVES, observation=MOVE), 4),
    "paths": (lambda: make_vec(3, observation=PARTS, autoreset_mode="Disabled"), 1),
    "many moves": (lambda: make_vec(3, MOVES, observation=MOVE, autoreset_mode="Disabled"), 4),
    "team": (
        lambda: closed_later(emberwatch.parallel_env(robots=2, observation=MOVE, **SMALL)),
        4,
    ),
    "option": (lambda: make(OBJECTIVE), 1),
    "options": (lambda: make_vec(2, OBJECTIVE, autoreset_mode="Disabled"), 1),
    "attached path": (lambda: make(instance=small_server().instance, observation=PARTS), 1),
    "attached paths": (
        lambda: make_vec(
            3,
            instance=small_server(worlds=3).instance,
            observation=PARTS,
            autoreset_mode="Disabled",
        ),
        1,
    ),
}

#: Longest time until an interrupt, as a part of what the call usually takes.
LATEST = 1.3


def handler(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def interrupted(call: Callable[[], object], seconds: float) -> bool:
    """Interrupts a call after some time; whether it was still running."""
    try:
        signal.setitimer(signal.ITIMER_REAL, seconds)
        call()
        signal.setitimer(signal.ITIMER_REAL, 0)
    except KeyboardInterrupt:
        return True
    return False


class Victim:
    """An environment that is interrupted, and another one to compare it with."""

    def __init__(self, kind: str, rng: random.Random) -> None:
        maker, self._n_moves = KINDS[kind]
        self._rng, self._env, self._other = rng, maker(), maker()
        #: Interrupts after which the environment refused a step.
        self.n_unfinished = 0
        self._env.reset(seed=0)

    def strike(self) -> bool:
        """Interrupts a step, a reset or a resume at random; whether it landed."""
        rng, env = self._rng, self._env
        seed, action = rng.randrange(1000), self._action(rng.randrange(1000))
        call, usual = rng.choice(
            [
                (lambda: env.step(action), 150e-6),
                (lambda: env.reset(seed=seed), 500e-6),
                (lambda: env.reset(options={"resume": True}), 300e-6),
            ]
        )
        has_landed = interrupted(call, rng.uniform(1e-6, LATEST * usual))
        if has_landed:
            env = self._env.unwrapped
            self.n_unfinished += getattr(env, "_worlds", env)._session.is_unfinished
            self._check(rng.choice([self._step, self._resume, self._reset]))
        return has_landed

    def _check(self, go_on: Callable[[], None]) -> None:
        go_on()
        for _ in range(2):
            self._fly()

    def _step(self) -> None:
        """A step is refused, or is the world's next."""
        try:
            self._fly()
        except emberwatch.EmberwatchError as error:
            assert error.code == "interrupted", error
            self._rng.choice([self._resume, self._reset])()
        except gymnasium.error.ResetNeeded:
            self._reset()

    def _resume(self) -> None:
        """A resume shows what the worlds show."""
        self._compare(*self._env.reset(options={"resume": True}))

    def _reset(self) -> None:
        """After a reset, all is as in an environment that nobody has interrupted."""
        seed = self._rng.randrange(1000)
        actions = [self._action(seed + k) for k in range(2 * self._n_moves)]
        episodes = [
            [env.reset(seed=seed), *map(env.step, actions)] for env in (self._env, self._other)
        ]
        assert_same(*episodes)

    def _fly(self) -> None:
        """Completes a path, of which some moves may have been made."""
        for k in range(self._n_moves):
            observation, *_, info = self._env.step(self._action(k))
            self._compare(observation, info)

    def _compare(self, observation: Any, info: dict[str, Any]) -> None:
        """The environment shows the worlds' step, and its last frame."""
        env = self._env.unwrapped
        lease = getattr(env, "_worlds", env).lease
        answer = lease.client.observe(lease.robots.start, len(lease.robots))
        agents = [name for name in info if name.startswith("robot_")]
        if agents:
            info, observation = info[agents[0]], observation[agents[0]]
        steps = np.atleast_1d(info["step"])
        assert np.array_equal(steps, answer.worlds["step"]), (steps, answer.worlds)
        if isinstance(observation, dict):  # options observe features
            frames = observation["frame"].reshape(len(steps), *answer.frames.shape[1:])
            assert np.array_equal(frames, answer.frames[: len(steps)])

    def _action(self, seed: int) -> Any:
        agents: dict[str, Any] = getattr(self._env, "action_spaces", {})
        for space in agents.values() or [self._env.action_space]:
            space.seed(seed)
        if agents:
            return {agent: space.sample() for agent, space in agents.items()}
        return self._env.action_space.sample()


def campaign(n: int) -> tuple[Counter[str], int]:
    """Interrupts calls until `n` interrupts have landed.

    Returns how many have landed in each kind of environment, and how many of all of them have left
    a step or reset unfinished.
    """
    signal.signal(signal.SIGALRM, handler)
    rng = random.Random(n)
    victims = {kind: Victim(kind, rng) for kind in KINDS}
    landed = Counter[str]()
    while landed.total() < n:
        kind = min(KINDS, key=lambda kind: landed[kind])
        landed[kind] += victims[kind].strike()
    return landed, sum(victim.n_unfinished for victim in victims.values())


if __name__ == "__main__":
    logging.disable()  # of servers that are waited for
    warnings.simplefilter("ignore")
    try:
        landed, n_unfinished = campaign(int(sys.argv[1]))
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        at_the_end.close()
    print(f"{landed.total()} interrupts landed, {n_unfinished} left a call unfinished")
    print(dict(landed))
