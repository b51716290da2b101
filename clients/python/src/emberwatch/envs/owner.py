"""What all environments and vector environments share."""

import pickle
from contextlib import AbstractContextManager
from copy import copy
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import ArrayLike, NDArray

from emberwatch.client.client import Lease
from emberwatch.client.wire import StepAnswer
from emberwatch.common.arguments import as_json, as_moves
from emberwatch.common.paths import with_absolute_paths
from emberwatch.envs.observations import Observations
from emberwatch.envs.plans import Plans
from emberwatch.envs.session import Session
from emberwatch.envs.settings import WorldSpec
from emberwatch.errors import invalid, repr_of
from emberwatch.model import Model
from emberwatch.model.moves import fly
from emberwatch.render import Palette, Picture, ansi, rgb_array
from emberwatch.render.screen import Screen

#: Pictures per second in a film, and at most in a window.
FPS: Final = 10

RENDER_MODES: Final = ("human", "rgb_array", "ansi")
METADATA: Final[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": FPS}


@dataclass(frozen=True, slots=True, eq=False)
class EnvState:
    """The state of an environment, from `clone_state`; it can be pickled.

    Unpickle only states that you saved: like every pickle, a state can run code.
    """

    form: str
    """The class of the environment, and what it observes."""
    worlds: bytes = field(repr=False)
    """The worlds and robots, in the format of a snapshot file. They contain the hidden states."""
    memory: bytes = field(repr=False)
    """The rest: beliefs, memory of frames, moves of incomplete paths, generators."""


class SessionOwner:
    """The robots of a session, one row for each: their frames, pictures and states in memory."""

    #: The attributes that the future depends on, apart from worlds and observations.
    _KEPT: ClassVar[tuple[str, ...]]

    _made_by: EnvSpec | None = None
    #: The frames of the current step, `(n_rows, H, W)`.
    _frames: NDArray[np.uint8]
    #: The hidden states in each robot's world, `(n_rows, H, W)`; None if they are not read.
    _truths: NDArray[np.uint8] | None = None

    def _attach(self, session: Session, observations: Observations | Plans, pays: int) -> None:
        """`pays` is the kind of reward, an index in `base.REWARDS`."""
        self._session, self._spec = session, session.spec
        self._observations, self._pays = observations, pays
        self._reveals = session.settings.truth
        self._reads_truth = session.settings.reads_truth
        self.render_mode = mode = session.settings.render_mode
        if mode is not None and mode not in RENDER_MODES:
            raise invalid("render_mode", f"None or one of {', '.join(RENDER_MODES)}", repr_of(mode))
        self._palette = Palette.of(session.spec.described or session.spec.n_observations)
        self._screen: Screen | None = None
        #: The cells of each robot's last path; None without a render mode.
        self._paths: list[NDArray[np.intp] | None] = [None] * session.n_rows

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
    def burn_in(self) -> int:
        """Number of steps that the worlds are simulated before k = 0."""
        return self._session.spec.burn_in

    @property
    def instance(self) -> str:
        """The instance name of the environment's server, after a reset; refused without one."""
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
            kept = {name: getattr(self, name) for name in self._KEPT}
            memory = pickle.dumps((kept, self._observations.memory()))
            return EnvState(self._form(), worlds, memory)

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
            kept, memory = pickle.loads(state.memory)
            vars(self).update(kept)
            self._restore(answer)
            self._observations.restore(memory, answer.results)
            self._session.finish()

    def draw(self, rows: slice) -> Any:
        """Returns a picture of some robots of one world, or shows it, in mode ``"human"``."""
        frame, cells = self.seen(rows)
        paths = [self._path(row) for row in range(len(self._paths))[rows]]
        picture = Picture(
            frame=frame,
            palette=self._palette,
            robots=[(row, col) for row, col in cells.tolist()],
            paths=[path for path in paths if path is not None],
            truth=self._truths[rows.start] if self._reveals and self._truths is not None else None,
            airspace=self._spec.airspace,
        )
        if self.render_mode != "human":
            return rgb_array(picture) if self.render_mode == "rgb_array" else ansi(picture)
        self._screen = self._screen or Screen(fps=FPS)
        self._screen.show(picture)
        return None

    def _close(self) -> None:
        self._session.close()
        if self._screen is not None:
            self._screen.close()
            self._screen = None

    def seen(self, rows: slice) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        """Returns the combined frame and the cells of some robots of one world, as new arrays."""
        return self._frames[rows].min(axis=0), self._robots()[rows]

    def can_draw(self) -> bool:
        """Returns whether there is something to draw; warns if not."""
        if self.render_mode is None or not self.is_open:
            gymnasium.logger.warn(
                "render: nothing to draw; give a render_mode to gymnasium.make and reset first"
            )
            return False
        return True

    def _keep_paths(
        self, moved: NDArray[np.bool_], results: NDArray[np.void], paths: ArrayLike
    ) -> None:
        """Keeps the cells of the paths that the rows `moved` flew, for pictures."""
        moves = as_moves(paths, len(results), self._spec.n_moves).reshape(len(results), -1)
        for row in np.flatnonzero(moved).tolist():
            robot = results["robot"][row]
            start = int(robot["start_row"]), int(robot["start_col"])
            self._paths[row] = fly(start, moves[row, : robot["n_moves"]], self._spec)

    def _path(self, row: int) -> NDArray[np.intp] | None:
        """Returns the cells of a robot's path, which are kept only with a render mode."""
        return self._paths[row]

    def _robots(self) -> NDArray[np.int64]:
        """Returns row and column of each robot as a new array."""
        raise NotImplementedError

    def _form(self) -> str:
        """Names the class and what it observes."""
        return f"{type(self).__name__} with {self._observations.form}"

    def _restore(self, answer: StepAnswer) -> None:
        """Continues from restored worlds, whose current step is `answer`."""
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
