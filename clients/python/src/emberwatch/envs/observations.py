"""Observations of learners: their parts, and the space of each part."""

from collections.abc import Iterable, Sequence
from itertools import chain, zip_longest
from typing import Any, Final, Literal, TypeAlias, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from emberwatch._native import Flights
from emberwatch.belief import Belief, kinds, known
from emberwatch.belief.prior import prior_of
from emberwatch.client import wire
from emberwatch.common.arguments import as_integer
from emberwatch.envs.last_seen import LastSeen
from emberwatch.envs.session import Session
from emberwatch.envs.settings import WorldSpec
from emberwatch.errors import InvalidArgumentError, invalid, repr_of

Part: TypeAlias = Literal["frame", "image", "robot", "age", "belief", "team", "others"]
MovesPart: TypeAlias = Literal[Part, "local", "recent", "visited", "move", "action_mask"]

#: A single part is a plain observation, several parts are a flat dictionary.
Parts: TypeAlias = Part | Sequence[Part]
MovesParts: TypeAlias = MovesPart | Sequence[MovesPart]

#: Default side of the parts `local` and `recent`, in cells.
WINDOW: Final = 15

#: Maximum side of the parts `local` and `recent`, in cells.
MAX_WINDOW: Final = 255

#: Number of the first channels of `local`, from the belief, and of its last ones, about the path.
N_OF_BELIEF: Final = 2
N_OF_PATH: Final = 3

#: Parts that need a filter, parts that need a memory of frames, and parts about other robots.
OF_BELIEF: Final = frozenset(("belief", "local"))
_OF_MEMORY: Final = frozenset(("age", "recent"))
OF_TEAM: Final = frozenset(("team", "others"))


class Observations:
    """Observations of several robots, one row for each: all robots of some worlds, or one robot."""

    def __init__(
        self,
        parts: str | Sequence[str],
        session: Session,
        kind: str = "known",
        *,
        window: int | None = None,
        pays: bool = False,
    ) -> None:
        """Checks the parts and makes their spaces.

        With `window`, robots fly move by move, and the parts about an incomplete path are
        available. `pays`: whether moves are rewarded.
        """
        spec, n_rows = session.spec, session.n_rows
        known = _spaces(spec, window)
        names = names_of(parts)
        if not names or len(set(names)) < len(names) or not known.keys() >= set(names):
            raise invalid("observation", f"one or several of {', '.join(known)}", repr_of(parts))
        self._names, self._is_plain = names, isinstance(parts, str)
        self._session, self._spec = session, spec
        self._n_rows = n_rows
        #: The index of the first row's robot in its world.
        self._first = session.settings.robot or 0
        #: Whether a part is about other robots.
        self.shows_team = bool(OF_TEAM & set(names))
        if OF_BELIEF & set(names) and spec.model is None:
            needs = "a server that reveals its model"
            if spec.is_recorded:
                needs = "simulated worlds, as recorded ones have no model"
            raise InvalidArgumentError(f"observation: expected {needs}, for parts with a belief")
        known_kinds = [name for name, it in kinds().items() if not it.needs_checkpoint]
        if kind not in known_kinds:
            raise invalid("kind", f"one of {', '.join(known_kinds)}", repr_of(kind))
        self._kind = kind
        #: The space of one robot's observation.
        self.space = (
            known[names[0]]
            if self._is_plain
            else spaces.Dict({name: known[name] for name in names})
        )
        grid = (spec.height, spec.width, spec.n_observations)
        self._last_seen = LastSeen(n_rows, *grid) if _OF_MEMORY & set(names) else None
        self._belief: Belief | None = None
        channels = {"local": N_OF_BELIEF, "recent": spec.n_observations}
        #: The parts that `flights` shows around the robots, in its order.
        self._windows = [name for name in names if name in channels]
        #: The paths of robots that fly move by move.
        self.flights: Flights | None = None
        if window is not None:
            if pays and spec.described is None:
                needs = "reward='move': expected a server that reveals its model"
                raise InvalidArgumentError(needs)
            # Each cell pays the reward of its hidden state when the path first visits it.
            reward = spec.described.reward.tolist() if pays and spec.described else None
            windows = [(window, channels[name]) for name in self._windows]
            size = n_rows, spec.height, spec.width, spec.n_moves
            self.flights = Flights(*size, reward, spec.airspace, windows)
        #: Whether observations depend on frames before the last one.
        self.has_memory = has_memory(names)
        self._image = np.empty(0, np.uint8)
        # One row for each observed value, and a last row for unobserved cells.
        self._one_hot = 255 * np.eye(spec.n_observations + 1, dtype=np.uint8)

    def __getstate__(self) -> dict[str, Any]:
        """Omits the belief from copies, because their next episode begins with the prior."""
        return {**vars(self), "_belief": None}

    def start_episodes(
        self, begun: NDArray[np.bool_], results: NDArray[np.void], frames: NDArray[np.uint8]
    ) -> None:
        """Begins the episodes of the rows `begun`, or joins them at their current step.

        The frames that the worlds still keep of a joined episode come first. `results` and `frames`
        have an entry for every row.
        """
        steps = results["world"]["step"]
        joined = begun & (steps > 0) & self.has_memory
        self._reset(begun & ~joined, frames)
        rows = np.flatnonzero(joined).tolist()
        each = [
            chain(
                (past.frames[0] for past in self._session.history(row, int(steps[row]))),
                [frames[row]],
            )
            for row in rows
        ]
        seen = np.zeros_like(frames)
        # The rows join together, because each update takes the time of all rows.
        for number, shown in enumerate(zip_longest(*each)):
            moved = np.zeros(self._n_rows, np.bool_)
            for row, frame in zip(rows, shown, strict=True):
                if frame is not None:
                    seen[row], moved[row] = frame, True
            if number == 0:
                self._reset(moved, seen)
            else:
                self.update(moved, results, seen)

    def _reset(self, begun: NDArray[np.bool_], frames: NDArray[np.uint8]) -> None:
        """Forgets everything in the rows `begun`, then shows their frames, (n_rows, H, W)."""
        if not begun.any():
            return
        if self._last_seen is not None:
            self._last_seen.reset(begun, frames)
        if OF_BELIEF & set(self._names):
            if self._belief is None:
                spec, model = self._spec, self._spec.model
                assert model is not None
                grid = {"height": spec.height, "width": spec.width, "burn_in": spec.burn_in}
                prior = prior_of(None, model, **grid)
                self._belief = known(model, prior=prior, kind=self._kind, n_worlds=self._n_rows)
            self._belief.reset(begun)
            self._belief.correct(frames, begun)
            self._belief.predict(begun)
        self._show(begun)

    def update(
        self, moved: NDArray[np.bool_], results: NDArray[np.void], frames: NDArray[np.uint8]
    ) -> None:
        """Updates the rows `moved` with a step; `frames` has a frame for every row."""
        if self._last_seen is not None:
            self._last_seen.update(moved, frames)
        if self._belief is not None:
            self._belief.correct(frames, moved)
            self._belief.predict(moved)
        self._show(moved)

    @property
    def form(self) -> str:
        """Names the parts, and the kind of belief if they need one."""
        kind = f", kind={self._kind!r}" if OF_BELIEF & set(self._names) else ""
        return f"observation={self._names}{kind}"

    def memory(self) -> dict[str, Any]:
        """Returns what the observations depend on, apart from the last frames."""
        flights = self.flights
        return {
            "belief": self._belief,
            "last_seen": self._last_seen,
            "moves": [] if flights is None else [flights.made(row) for row in range(self._n_rows)],
        }

    def restore(self, memory: dict[str, Any], results: NDArray[np.void]) -> None:
        """Continues from `memory`; the environment has begun the paths of all robots again."""
        self._belief, self._last_seen = memory["belief"], memory["last_seen"]
        self._show(np.ones(self._n_rows, np.bool_))
        # The moves of the incomplete paths are made again.
        made: list[NDArray[np.uint8]] = memory["moves"]
        for index in range(max(map(len, made), default=0)):
            moved = np.array([len(moves) > index for moves in made])
            actions = [int(moves[index]) if len(moves) > index else 0 for moves in made]
            if self.flights is not None:
                self.flights.move(moved, np.array(actions, np.uint8))

    def all(
        self,
        frames: NDArray[np.uint8],
        robots: NDArray[np.int64],
        teams: wire.StepAnswer | None = None,
    ) -> Any:
        """Returns the observations of all rows, stacked; `frames` and `robots` are not copied.

        `teams` has the team frames and the results of all robots of the worlds. It is needed if the
        rows do not include all robots of their worlds.
        """
        parts = {name: self._part(name, frames, robots, teams) for name in self._names}
        return parts[self._names[0]] if self._is_plain else parts

    def one(
        self,
        frames: NDArray[np.uint8],
        robots: NDArray[np.int64],
        teams: wire.StepAnswer | None = None,
    ) -> Any:
        """Returns the observation of the only row; arguments as in `all`."""
        if self._is_plain:
            return self._part(self._names[0], frames, robots, teams)[0]
        return {
            name: frames[0, ..., np.newaxis]
            if name == "frame"
            else self._part(name, frames, robots, teams)[0]
            for name in self._names
        }

    def _part(
        self,
        name: str,
        frames: NDArray[np.uint8],
        robots: NDArray[np.int64],
        teams: wire.StepAnswer | None,
    ) -> NDArray[Any]:
        if name == "frame":
            return frames[..., np.newaxis]
        if name == "image":
            unseen = np.uint8(self._spec.n_observations)
            return self._one_hot[np.where(frames == wire.UNOBSERVED, unseen, frames)]
        if name == "robot":
            return robots
        if name == "team":
            if teams is None:  # unobserved is 255
                seen = frames.reshape(-1, self._spec.n_robots, *frames.shape[1:]).min(axis=1)
            else:
                seen = teams.frames
            return np.repeat(seen, self._n_rows // len(seen), axis=0)[..., np.newaxis]
        if name == "others":
            return self._others(robots if teams is None else cells_of(teams.robots))
        if self._last_seen is not None and name == "age":
            return self._last_seen.ages[..., np.newaxis].copy()
        if name == "belief":
            return self._image.copy()
        assert self.flights is not None
        if name in self._windows:
            return self.flights.around(self._windows.index(name))
        if name == "visited":
            return self.flights.visited[..., np.newaxis]
        if name == "action_mask":
            return self.flights.masks
        return self.flights.n_made

    def _others(self, robots: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Returns 255 in the cells of each row's teammates; `robots` includes all robots."""
        spec = self._spec
        shown = np.zeros((self._n_rows, spec.height, spec.width, 1), np.uint8)
        own = np.remainder(self._first + np.arange(self._n_rows), spec.n_robots)
        n_same = self._n_rows * spec.n_robots // len(robots)  # rows for each world
        rows, others = np.nonzero(own[:, np.newaxis] != np.arange(spec.n_robots))
        cells = robots[rows // n_same * spec.n_robots + others]
        shown[rows, cells[:, 0], cells[:, 1]] = 255
        return shown

    def _show(self, rows: NDArray[np.bool_]) -> None:
        """Updates the beliefs and windows of `rows`, in which a new path begins."""
        if self._belief is not None and "belief" in self._names:
            image = np.rint(255.0 * self._belief.belief.transpose(1, 2, 3, 0))
            self._image = image.astype(np.uint8)
        for index, name in enumerate(self._windows):
            assert self.flights is not None
            if name == "recent" and self._last_seen is not None:
                self.flights.show(index, rows, self._last_seen.fading(rows))
            elif self._belief is not None:
                self.flights.show(index, rows, _local(self._belief, rows))


def _local(belief: Belief, rows: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Returns the first channels of `local` for the rows `rows`, shape (n, H, W, 2).

    These are 255 times the probability of the state that pays most, and 255 times the entropy
    divided by log S.
    """
    target = belief.belief[belief.target_state]
    entropy = belief.entropy() / np.log(len(belief.state_names))
    channels = np.stack((target[rows], entropy[rows]), axis=-1)
    return np.rint(255.0 * channels).astype(np.uint8)


def cells_of(robots: NDArray[np.void]) -> NDArray[np.int64]:
    """Returns row and column of each robot as a new array."""
    return np.stack((robots["row"], robots["col"]), axis=1).astype(np.int64)


def has_memory(parts: str | Sequence[str]) -> bool:
    """Whether an observation of these parts depends on frames before the last one."""
    return bool((OF_BELIEF | _OF_MEMORY) & set(names_of(parts)))


def names_of(parts: object) -> tuple[str, ...]:
    """Returns the names in the argument `observation`, without checking them."""
    if isinstance(parts, str):
        return (parts,)
    return tuple(map(str, cast("Iterable[object]", parts))) if isinstance(parts, Iterable) else ()


def of_row(observations: Any, index: int) -> Any:
    """Returns the observation of one row of stacked observations."""
    if isinstance(observations, dict):
        parts = cast("dict[str, NDArray[Any]]", observations)
        return {name: part[index] for name, part in parts.items()}
    return observations[index]


def _spaces(spec: WorldSpec, window: int | None) -> dict[str, spaces.Space[Any]]:
    def image(n_channels: int) -> spaces.Box:
        return spaces.Box(0, 255, (spec.height, spec.width, n_channels), np.uint8)

    n_states = 1 if spec.model is None else spec.model.n_states
    known: dict[str, spaces.Space[Any]] = {
        "frame": image(1),
        "image": image(spec.n_observations + 1),
        "robot": spaces.MultiDiscrete([spec.height, spec.width]),
        "age": image(1),
        "belief": image(n_states),
        "team": image(1),
        "others": image(1),
    }
    if window is None:
        return known
    if as_integer(window) is None or not 3 <= window <= MAX_WINDOW or not window & 1:
        raise invalid("window", f"an odd number, 3 to {MAX_WINDOW}", repr_of(window))

    def around(n_of_world: int) -> spaces.Box:
        return spaces.Box(0, 255, (window, window, n_of_world + N_OF_PATH), np.uint8)

    return {
        **known,
        "local": around(N_OF_BELIEF),
        "recent": around(spec.n_observations),
        "visited": image(1),
        "move": spaces.Discrete(spec.n_moves),
        "action_mask": spaces.Box(0, 1, (wire.N_MOVES,), np.int8),
    }
