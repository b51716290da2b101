"""The part of the package that is written in Rust.

Waits leave the interpreter to other threads; Ctrl-C ends them. What is open belongs to the process
that made it: in a forked child, using it is an error with code `"forked"`.
"""

from os import PathLike
from typing import Any, Literal, Protocol, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Doubles = NDArray[np.float64]

class _Airspace(Protocol):
    """What counts of an `Airspace`."""

    @property
    def radius(self) -> int: ...
    @property
    def n_rings(self) -> int: ...
    @property
    def pays(self) -> str: ...
    @property
    def no_fly(self) -> NDArray[np.bool_] | None: ...

class _Text(Protocol):
    """A model or a description."""

    @property
    def toml(self) -> str: ...

class _Spec(Protocol):
    """What counts of a `WorldSpec`."""

    @property
    def height(self) -> int: ...
    @property
    def width(self) -> int: ...
    @property
    def n_moves(self) -> int: ...
    @property
    def n_observations(self) -> int: ...
    @property
    def burn_in(self) -> int: ...
    @property
    def airspace(self) -> _Airspace: ...
    @property
    def model(self) -> _Text | None: ...
    @property
    def description(self) -> _Text | None: ...

VERSION: str

#: Worlds with seeds below are for tests: nothing may be trained or tuned on them.
FIRST_TRAINING_SEED: int

#: Maximum number of moves in a path.
MAX_MOVES: int

#: Maximum number of rows and columns that a robot sees beyond its cell.
MAX_RADIUS: int

#: Maximum number of rows, and of columns, of a grid.
MAX_SIDE: int

#: Maximum number of states, and of observations, of a model.
MAX_VALUES: int

def built_in(kind: Literal["models", "tasks", "states"]) -> dict[str, str]:
    """Texts of the built-in files by name; `states`: descriptions of recorded states."""

def explain(status: int, detail: int) -> tuple[str, str] | None:
    """The name of a status code, and its sentence for people; None if no refusal has the code."""

def check_settings(settings: str) -> str:
    """All settings that a server with these would have; JSON from JSON."""

def worlds_fingerprint(settings: str) -> str:
    """The `worlds_fingerprint` of a server with these settings, as JSON; simulates nothing."""

_Numbers = tuple[float, bool, bool, int, int, NDArray[np.int64]]
_Columns = tuple[
    _Doubles,
    NDArray[np.bool_],
    NDArray[np.bool_],
    NDArray[np.int64],
    NDArray[np.int64],
    NDArray[np.int64],
    bool,
]

@final
class Answer:
    """The answer to a step or an observation, of consecutive robots.

    No other object shares its memory. Results are bytes as PROTOCOL.md lays them out.
    """

    def __new__(
        cls,
        team: int,
        height: int,
        width: int,
        first_robot: int,
        n_robots: int,
        flags: int,
        simulation_nanos: int,
        payload: NDArray[np.uint8],
    ) -> Answer:
        """Presents a payload: results of the worlds, results of the robots, frames.

        `team`: robots of each world.
        """

    @property
    def first_robot(self) -> int: ...
    @property
    def simulation_nanos(self) -> int: ...
    @property
    def frames(self) -> NDArray[np.uint8]:
        """A frame of each robot, or of each world's team, `(n, H, W)`; a view."""

    @property
    def worlds(self) -> NDArray[np.uint8]:
        """Results of the worlds, bytes; a view."""

    @property
    def robots(self) -> NDArray[np.uint8]:
        """Results of the robots, bytes; a view."""

    @property
    def results(self) -> NDArray[np.uint8]:
        """Bytes of `wire.RESULT_DTYPE`, one for each robot; a new array."""

    @property
    def world_of_robots(self) -> NDArray[np.int64]:
        """The position of each robot's world, `(n_robots,)`."""

    def result(self, index: int) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """The fields of one robot's `WorldResult` and `RobotResult`."""

    def numbers(self, pays: int) -> _Numbers:
        """Reward, terminated, truncated, step, distinct cells visited and cell of the first robot.

        The cell is a new array, `(1, 2)`. `pays`: which reward, 0 the share, 1 the team's, 2 the
        marginal one.
        """

def columns(results: NDArray[np.uint8], pays: int) -> _Columns:
    """The numbers of many robots, from bytes of `wire.RESULT_DTYPE`; new arrays.

    Rewards, terminated, truncated, steps, distinct cells visited, `(n,)` each; cells, `(n, 2)`; and
    whether any episode is over. `pays`: as of `Answer.numbers`.
    """

def moves(given: ArrayLike, n_robots: int, n_moves: int) -> NDArray[np.uint8] | None:
    """Paths as bytes, `(n_robots, n_moves)`, checked; None as of `Lease.step`."""

class Server:
    """A connection to a server, or worlds in this process. Threads may share it, in turns."""

    def __init__(self, instance: str, client: str, seconds: float) -> None:
        """Opens it; `client` names this program in the server's log."""

    @staticmethod
    def embedded(settings: str, warns: bool) -> Server:
        """Worlds in this process, of these settings of `config/server.toml`, as JSON.

        `warns`: of starts that no-fly cells close in.
        """

    def truths(self, first_world: int, n_worlds: int) -> list[dict[str, Any]]:
        """Hidden states of worlds in this process, as `Truth`; refused of a server's."""

    @property
    def info(self) -> str:
        """What the server said of itself, as JSON."""

    def control(self, text: bytes, what: str, seconds: float) -> str:
        """Sends JSON, `what` in errors; returns the JSON of the answer."""

    def step(
        self,
        operation: int,
        lease: int,
        first_robot: int,
        n_robots: int,
        n_moves: int,
        flags: int,
        body: bytes,
        seconds: float,
    ) -> Answer:
        """Sends a request on `step` as it is."""

    def close(self) -> None:
        """Closes it. May be called again."""

class Options:
    """Beliefs and plans of worlds with one robot each; worlds are numbered from 0."""

    def __init__(
        self,
        spec: _Spec,
        n_worlds: int,
        estimator: str | None,
        checkpoint: str | None,
        prior: str,
        watched: tuple[str, int] | None,
    ) -> None:
        """Checks all arguments.

        `watched`: the instance in which beliefs are published, and the number there of world 0.
        """

    @property
    def estimator(self) -> str:
        """Name of the estimator that keeps the beliefs."""

    def begin(self, worlds: list[int], seeds: list[int]) -> None:
        """Starts episodes: the first belief in each of `worlds`, and a seed."""

    def take_over(self, world: int, kind: str, data: bytes) -> bool:
        """Continues with a belief of another client about the present step; False: no fit."""

    def left(self, world: int) -> tuple[str, bytes] | None:
        """Returns the kind and the bytes of a belief, for the next client."""

    def see(self, worlds: list[int], results: NDArray[np.uint8], frames: NDArray[np.uint8]) -> None:
        """Updates beliefs with an earlier step: bytes as of `plan`, frames `(n, H, W)`."""

    def plan(
        self,
        worlds: list[int],
        results: NDArray[np.uint8],
        frames: NDArray[np.uint8] | None,
        flown: list[int] | None,
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Updates beliefs with the present step, unless `frames` is None, then plans.

        `results`: bytes of `wire.RESULT_DTYPE`.

        Returns features `(n_worlds, options, features)` and paths `(n_worlds, options, T)` of all
        worlds, new arrays.
        """

    def close(self) -> None:
        """Drops all beliefs. May be called again."""

class Flights:
    """The present path of each robot, as far as it is flown. Rows are robots.

    With `reward`, each cell pays when it is first visited, or seen where that pays, what its hidden
    state pays. A copy or pickle is as new.
    """

    def __init__(
        self,
        n_rows: int,
        height: int,
        width: int,
        n_moves: int,
        reward: list[float] | None,
        airspace: _Airspace | None = None,
    ) -> None: ...
    @property
    def robots(self) -> NDArray[np.int64]:
        """Row and column of each robot; a new array, as the others."""

    @property
    def n_made(self) -> NDArray[np.int64]:
        """Number of moves made."""

    @property
    def visited(self) -> NDArray[np.uint8]:
        """255 in the cells visited, else 0."""

    @property
    def paid(self) -> NDArray[np.float64]:
        """What the moves have been paid."""

    @property
    def masks(self) -> NDArray[np.int8]:
        """1 for each move that takes a robot to another cell, else 0, `(n_rows, 4)`.

        All 1 where no move does.
        """

    def begin(
        self,
        begun: NDArray[np.bool_],
        robots: NDArray[np.int64],
        states: NDArray[np.uint8] | None,
    ) -> None:
        """Begins some paths; `robots` and hidden `states` are those of all rows."""

    def completes(self) -> NDArray[np.bool_]:
        """Of which rows the next move is the last of its path."""

    def paths(self, actions: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The paths that these actions would complete, `(n_rows, T)`."""

    def made(self, row: int) -> NDArray[np.uint8]:
        """The moves made by one robot."""

    def move(self, moved: NDArray[np.bool_], actions: NDArray[np.uint8]) -> NDArray[np.float64]:
        """One move of some robots; returns what it pays each row."""

class Lease:
    """The right to fly consecutive robots, and the step k of each of their worlds."""

    def __init__(self, server: Server, number: int, first_robot: int, n_robots: int) -> None: ...
    def step(
        self, paths: ArrayLike, first_robot: int, n_robots: int, flags: int, seconds: float
    ) -> Answer | None:
        """Flies a path with each robot, for the next step of its world.

        None if the paths are no plain array of int64 or uint8, or wrong: `as_moves` converts them.
        """

    def fly(
        self,
        paths: ArrayLike,
        first_robot: int,
        n_robots: int,
        accepts_late: bool,
        seconds: float,
    ) -> tuple[Answer, int] | None:
        """As `step`, sent again until the worlds have moved; see `lease.Lease.fly`."""

    def observe(self, first_robot: int, n_robots: int, flags: int, seconds: float) -> Answer:
        """The last results and frames again; steps go on from there."""

    def note(self, world: int, step: int) -> None:
        """From here on a world is at this step."""

    @property
    def steps(self) -> list[int]:
        """The step of each world."""

@final
class Windows:
    """A square of cells around each robot, in rows: the observation parts `local` and `recent`.

    The channels about the world come first, then 255 where this path has been, 255 off the grid and
    in no-fly cells, and 255 times the share of the path's moves that are left.
    """

    def __new__(
        cls,
        n_rows: int,
        height: int,
        width: int,
        side: int,
        n_of_world: int,
        airspace: _Airspace,
    ) -> Windows:
        """`side`: cells along a side, odd; `n_of_world`: channels about the world."""

    def begin(self, begun: NDArray[np.bool_], shown: NDArray[np.uint8]) -> None:
        """Shows the world, `(n_begun, H, W, n_of_world)`, to robots that have visited nothing."""

    def visit(self, flights: Flights, moved: NDArray[np.bool_]) -> None:
        """Marks the cells of some robots as visited, and what their visit pays as found."""

    def around(self, flights: Flights) -> NDArray[np.uint8]:
        """The windows of all robots, `(n_rows, side, side, channels)`; a new array."""

class Frames:
    """Reads `Frame`s, of one world or of all."""

    def __init__(self, instance: str, world: int | None = None) -> None: ...
    def receive(self, seconds: float) -> dict[str, Any] | None:
        """The fields of the next sample; None if none comes in time."""

    def close(self) -> None:
        """Closes it. May be called again."""

class Truths:
    """Reads `Truth`s, of one world or of all."""

    def __init__(self, instance: str, world: int | None = None) -> None: ...
    def receive(self, seconds: float) -> dict[str, Any] | None:
        """The fields of the next sample; None if none comes in time."""

    def close(self) -> None:
        """Closes it. May be called again."""

class Outlooks:
    """Reads `Outlook`s, of one world or of all."""

    def __init__(self, instance: str, world: int | None = None) -> None: ...
    def receive(self, seconds: float) -> dict[str, Any] | None:
        """The fields of the next sample; None if none comes in time."""

    def close(self) -> None:
        """Closes it. May be called again."""

class Recording:
    """Reads a recording."""

    def __init__(self, path: str | bytes | PathLike[str]) -> None:
        """Raises an error with code "cut" or "damaged" where all before is whole."""

    def read(self) -> tuple[int, Literal["server", "frame", "truth"], Any] | None:
        """Nanoseconds, and the server's JSON or the fields of a sample; None at the end."""

def estimator_names() -> list[tuple[str, str]]:
    """Returns the name and a description of each estimator on which options can be planned."""

def option_names() -> tuple[list[str], list[str]]:
    """Returns the names of the options, and of the features that describe each plan."""

def read_model(text: str) -> dict[str, Any]:
    """The fields of `Model` but `toml`; raises `ValueError` for what is no model file."""

def grid_of_maps(path: str) -> tuple[int, int] | None:
    """Height and width of the maps of a model file; None if it has none, or is wrong."""

def model_text(path: str) -> str:
    """The text of a model file, with the maps that are in files beside it."""

def model_with_radius(text: str, radius: int) -> str:
    """The text of a model file with another sensor radius."""

def description_with_radius(text: str, radius: int) -> str:
    """The same of a description."""

def read_description(text: str) -> dict[str, Any]:
    """The same of `Description`."""

@final
class Transition:
    """``Phi`` for a model file's text on one grid; it keeps work space."""

    def __new__(cls, model: str, height: int, width: int) -> Transition: ...
    def apply(self, beliefs: _Doubles) -> _Doubles:
        """Of `(S, n, H, W)`, a new array."""

    def __getnewargs__(self) -> tuple[str, int, int]: ...

class Estimators:
    """Beliefs of one kind about n worlds; `Belief` checks the arguments.

    `chosen` is a mask of worlds, `(n,)`.
    """

    @staticmethod
    def known(model: str, prior: NDArray[np.float32], kind: str, n_worlds: int) -> Estimators:
        """Builds beliefs from a model file's text; `prior`, `(S, H, W)`, is the same for all."""

    @staticmethod
    def load(
        checkpoint: str,
        grid: tuple[int, int],
        kind: str | None,
        model: str | None,
        n_worlds: int,
    ) -> Estimators:
        """Loads beliefs; `grid` is height and width, `model` a model file's text."""

    @property
    def kind(self) -> str: ...
    @property
    def state_names(self) -> list[str]: ...
    @property
    def target_state(self) -> int: ...
    @property
    def n_observations(self) -> int: ...
    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of worlds, height and width."""

    def belief(self) -> NDArray[np.float32]:
        """Returns a new array, `(S, n, H, W)`."""

    def entropy(self) -> NDArray[np.float32]:
        """Returns a new array, `(n, H, W)`, in nats."""

    def reset(self, chosen: NDArray[np.bool_], keeps_correlations: bool) -> None: ...
    def correct(self, frames: NDArray[np.uint8], chosen: NDArray[np.bool_]) -> None:
        """Corrects the chosen worlds; `frames` has one for each world, `(n, H, W)`."""

    def predict(self, chosen: NDArray[np.bool_]) -> None: ...
    def scores(self, states: NDArray[np.uint8], target: int) -> tuple[_Doubles, _Doubles, _Doubles]:
        """Returns log loss, Brier score and accuracy for states `(n, H, W)`, `(n,)` each."""

    def score_frames(self, frames: NDArray[np.uint8]) -> tuple[_Doubles, _Doubles]:
        """Returns the log-likelihood of frames `(n, H, W)` and observed cells, `(n,)` each."""

def belief_kinds() -> list[tuple[str, str]]:
    """Returns the name and a description of each kind of belief that frames correct."""

def correct(beliefs: _Doubles, likelihood: _Doubles, frames: NDArray[np.uint8]) -> None:
    """Applies Bayes' rule in place: `(S, n, H, W)`, `(S, O)` and `(n, H, W)`."""

def simulated_prior(model: str, height: int, width: int, burn_in: int) -> NDArray[np.float32]:
    """Returns how often each cell of 64 simulated worlds is in each state, `(S, H, W)`."""

def beam_search(
    values: NDArray[np.float32],
    robots: NDArray[np.int64],
    keys: NDArray[np.uint64],
    n_moves: int,
    width: int,
    airspace: _Airspace | None = None,
) -> NDArray[np.uint8]:
    """A path for each world: `(n, H, W)`, `(n, 2)` and `(n,)` give `(n, n_moves)`."""

@final
class MeritTally:
    """The figures of merit of some worlds while they go on."""

    def __new__(
        cls, n_worlds: int, height: int, width: int, target: int, recent_steps: int
    ) -> MeritTally: ...
    def update(
        self,
        visited: NDArray[np.bool_],
        robots: NDArray[np.int64],
        n_hits: NDArray[np.uint32],
        n_burning: NDArray[np.uint32],
        states: NDArray[np.uint8] | None,
    ) -> None:
        """One step: `(n, H, W)`, `(n, R, 2)`, `(n,)`, `(n,)` and `(n, H, W)`."""

    def merit(self, world: int) -> tuple[int | None, int | None, float | None, float | None, float]:
        """The fields of `Merit`."""

def choices(given: object, n_rows: int, n_choices: int) -> NDArray[np.uint8] | None:
    """Integers below `n_choices`, as bytes; None if it is no plain array of one for each row."""
