"""The public attributes that all environments and vector environments share."""

from contextlib import AbstractContextManager
from copy import copy
from typing import Any

from gymnasium.envs.registration import EnvSpec

from emberwatch.client.client import Lease
from emberwatch.client.wire import StepAnswer
from emberwatch.common.arguments import as_json
from emberwatch.common.paths import with_absolute_paths
from emberwatch.envs.observations import Observations
from emberwatch.envs.plans import Plans
from emberwatch.envs.session import Session
from emberwatch.envs.settings import WorldSpec
from emberwatch.envs.state import EnvState
from emberwatch.errors import invalid, repr_of
from emberwatch.model import Model


class SessionOwner:
    """The public attributes of an environment or vector environment, taken from its session."""

    _session: Session
    _observations: Observations | Plans
    _made_by: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """The specification that `gymnasium.make` used, with values that JSON can represent."""
        return self._made_by

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._made_by = made_by = copy(spec)
        if made_by is not None:
            made_by.kwargs = with_absolute_paths(as_json(made_by.kwargs))

    @property
    def model(self) -> Model | None:
        """The model of the worlds; None if the server hides it, or the worlds are recorded."""
        return self._session.spec.model

    @property
    def world_spec(self) -> WorldSpec:
        """The grid, moves, sensor and model of the worlds, known before the first reset."""
        return self._session.spec

    @property
    def n_moves(self) -> int:
        """Number of moves in a path, T."""
        return self._session.spec.n_moves

    @property
    def burn_in(self) -> int:
        """Number of steps that the worlds are simulated before k = 0."""
        return self._session.spec.burn_in

    @property
    def instance(self) -> str:
        """The instance name of the server that the environment is attached to, after a reset.

        Raises:
            InvalidArgumentError: If the worlds are in this process, without `instance`.
        """
        return self._session.instance

    @property
    def lease(self) -> Lease:
        """The lease on the environment's robots, after a reset, for snapshots and forks of worlds.

        After `lease.restore` or `lease.fork`, continue with ``reset(options={"resume": True})``.
        """
        return self._session.lease

    @property
    def is_open(self) -> bool:
        """Whether the environment has been reset since it was made or closed."""
        return self._session.is_open

    @property
    def turn(self) -> AbstractContextManager[object]:
        """A lock, for `with` statements, that lets only one thread at a time step or reset."""
        return self._session.turn

    def allow_test_worlds(self) -> None:
        """Turns off the warning about resets on a task's test seeds."""
        self._session.allows_test_worlds = True

    def clone_state(self) -> EnvState:
        """Returns the state of worlds, robots, beliefs and observations, for `restore_state`.

        The state holds the hidden states, so planning on restored worlds is an oracle. Wrappers
        keep their own memory, such as the number of steps in Gymnasium's `TimeLimit`.

        Raises:
            InvalidArgumentError: If the worlds are on a server (then see `Client.snapshot`).
            EmberwatchError: Code ``"closed"`` before the first reset, code ``"interrupted"`` if an
                earlier step or reset did not finish.
        """
        with self._session.turn:
            worlds = self._session.clone_state()
            return EnvState.of(self._form(), worlds, self._memory())

    def restore_state(self, state: EnvState) -> None:
        """Returns to a state of `clone_state`, as often as you like.

        The following steps and resets give the same observations, rewards and infos, to the byte.
        The state may come from another environment, also in another process, that was made with the
        same arguments. Reset this environment once before.

        Raises:
            InvalidArgumentError: If the state is of other worlds or another kind of environment, or
                the worlds are on a server. Nothing has changed then.
            EmberwatchError: Code ``"closed"`` before the first reset.
        """
        form = self._form()
        if getattr(state, "form", None) != form:
            got = state.form if isinstance(state, EnvState) else repr_of(state)  # pyright: ignore[reportUnnecessaryIsInstance]
            raise invalid("state", f"a state of {form}", got)
        with self._session.turn:
            answer = self._session.restore_state(state.worlds)
            self._restore(answer, state.copy_of_memory())
            self._session.finish()

    def _form(self) -> str:
        """Names the class and what it observes."""
        return f"{type(self).__name__} with {self._observations.form}"

    def _memory(self) -> dict[str, Any]:
        """Returns what the future depends on, apart from the worlds."""
        raise NotImplementedError

    def _restore(self, answer: StepAnswer, memory: dict[str, Any]) -> None:
        """Continues from restored worlds, whose current step is `answer`, and from `_memory`."""
        raise NotImplementedError

    def __getstate__(self) -> dict[str, Any]:
        """Refuses copies of open environments, as no two environments may act on one world."""
        return state_of(self, self.is_open, "gymnasium.make(env.spec)")


def state_of(environment: object, is_open: bool, maker: str) -> dict[str, Any]:
    """Returns the state of a closed environment for a copy or a pickle.

    `maker` is the call that makes another environment, for the error message.
    """
    if is_open:
        raise TypeError(
            f"copy or pickle: expected a closed environment, got a {type(environment).__name__} "
            f"that is open: close it first, or make another with {maker}; "
            "clone_state copies its state"
        )
    return vars(environment).copy()
