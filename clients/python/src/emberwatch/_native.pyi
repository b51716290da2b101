"""The Rust part of the package.

Calls that wait release the interpreter lock, and Ctrl-C interrupts them. Open objects belong to the
process that made them: using one in a forked child raises an error with code `"forked"`.
"""

from os import PathLike
from typing import Any, Literal, Protocol, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Doubles = NDArray[np.float64]

class _Airspace(Protocol):
    """The attributes of an `Airspace` that the native module reads."""

    @property
    def radius(self) -> int: ...
    @property
    def no_fly(self) -> NDArray[np.bool_] | None: ...

class _Text(Protocol):
    """A model or a description of recorded states."""

    @property
    def toml(self) -> str: ...

class _Spec(Protocol):
    """The attributes of a `WorldSpec` that the native module reads."""

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

#: The default kind of belief where a model is known.
RECOMMENDED: str
VERSION: str

#: Smallest training seed. Worlds with smaller seeds are for tests: do not train or tune on them.
FIRST_TRAINING_SEED: int

#: Maximum size of a model's archive of maps, in bytes.
MAX_ARCHIVE_BYTES: int

#: Maximum number of values in all maps of a model.
MAX_MAP_VALUES: int

#: Maximum number of moves in a path.
MAX_MOVES: int

#: Maximum number of rows and columns that a robot sees beyond its cell.
MAX_RADIUS: int

#: Maximum height and maximum width of a grid, in cells.
MAX_SIDE: int

#: Maximum number of states of a model, and maximum number of its observations.
MAX_VALUES: int

def built_in(kind: Literal["models", "tasks", "states"]) -> dict[str, str]:
    """Returns the texts of built-in files by name; `states` are descriptions of recorded states."""

def explain(status: int, detail: int) -> tuple[str, str] | None:
    """Returns the name and the message of a status code; None if the code is not a refusal."""

@final
class CheckedSettings:
    """Settings of worlds in this process, with the files that they name, which are read only here.

    A pickle reads the files again, and refuses files that have changed.
    """

    def __new__(cls, settings: str) -> CheckedSettings:
        """Reads and checks settings: JSON with the keys of `config/server.toml`.

        Warns about start cells that no-fly cells enclose.
        """

    def with_worlds(self, worlds: int) -> CheckedSettings:
        """Returns the same settings with another number of worlds."""

    @property
    def info(self) -> str:
        """The answer to `hello` of a server with these settings, as JSON."""

    @property
    def task(self) -> tuple[str, int, int, int, int, int, str, int] | None:
        """Name, moves, robots, steps, first and end of test seeds, prefix and version of ids."""

    @property
    def worlds_fingerprint(self) -> str:
        """Digits that identify the worlds, apart from their seeds."""

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
    """The answer to a step or an observation, for consecutive robots.

    It shares its memory with no other answer. Results are bytes in the layout of PROTOCOL.md.
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
        """Wraps a payload: results of the worlds, results of the robots, frames.

        `team`: number of robots in each world.
        """

    @property
    def first_robot(self) -> int: ...
    @property
    def simulation_nanos(self) -> int: ...
    @property
    def frames(self) -> NDArray[np.uint8]:
        """One frame for each robot, or for each world's team, `(n, H, W)`; a view."""

    @property
    def worlds(self) -> NDArray[np.uint8]:
        """Results of the worlds as bytes; a view."""

    @property
    def robots(self) -> NDArray[np.uint8]:
        """Results of the robots as bytes; a view."""

    @property
    def results(self) -> NDArray[np.uint8]:
        """One `wire.RESULT_DTYPE` for each robot, as bytes; a new array."""

    @property
    def world_of_robots(self) -> NDArray[np.int64]:
        """The index of each robot's world among the answer's worlds, `(n_robots,)`."""

    def result(self, index: int) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Returns the fields of one robot's `WorldResult` and `RobotResult`."""

    def numbers(self, pays: int) -> _Numbers:
        """Returns the results of the first robot.

        The tuple has reward, terminated, truncated, step, number of distinct visited cells, and
        cell (a new array, `(1, 2)`). `pays` chooses the reward: 0 share, 1 team, 2 marginal.
        """

def columns(results: NDArray[np.uint8], pays: int) -> _Columns:
    """Returns the results of many robots as new arrays, from bytes of `wire.RESULT_DTYPE`.

    The tuple has rewards, terminated, truncated, steps and numbers of distinct visited cells,
    `(n,)` each; cells, `(n, 2)`; and whether any episode is over. `pays`: as in `Answer.numbers`.
    """

class Connection:
    """A connection to a server, or worlds in this process. Calls of several threads take turns."""

    def __init__(self, instance: str, client: str, seconds: float) -> None:
        """Connects to a server; `client` names this program in the server's log."""

    @staticmethod
    def embedded(settings: CheckedSettings, seed: int | None = None) -> Connection:
        """Creates worlds in this process; `seed` replaces the first world's seed."""

    def truths(self, first_world: int, n_worlds: int) -> list[dict[str, Any]]:
        """Returns the hidden states of worlds in this process, as the fields of `Truth`.

        Refused on a connection to a server.
        """

    def snapshot(self) -> bytes:
        """Returns the state of all worlds in this process; refused on a connection to a server."""

    def restore(self, bytes: bytes) -> None:
        """Replaces all worlds in this process by the worlds of a `snapshot`; refuses others."""

    @property
    def info(self) -> str:
        """The server's reply to `hello`, as JSON."""

    def control(self, text: bytes, what: str, seconds: float) -> str:
        """Sends a JSON request, and returns the JSON answer; `what` names it in errors."""

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
        """Sends a raw request to the service `step`."""

    def close(self) -> None:
        """Closes the connection. May be called again."""

class Options:
    """Beliefs about worlds of one robot each, and plans for the robots. Worlds count from 0."""

    def __init__(
        self,
        spec: _Spec,
        n_worlds: int,
        estimator: str | None,
        checkpoint: tuple[str, bytes] | None,
        prior: str,
    ) -> None:
        """Checks all arguments. `checkpoint`: the path, for errors, and the bytes of the file."""

    @property
    def estimator(self) -> str:
        """Name of the estimator that computes the beliefs."""

    def start_episodes(self, chosen: NDArray[np.bool_], results: NDArray[np.uint8]) -> None:
        """Starts episodes in the worlds marked in `chosen`, with the first belief.

        `results`, here and below: bytes of `wire.RESULT_DTYPE` for all worlds.
        """

    def take_over(self, world: int, kind: str, data: bytes) -> bool:
        """Loads another client's belief about the current step; False if it does not fit."""

    def left(self, world: int) -> tuple[str, bytes] | None:
        """Returns the kind and the bytes of a belief, for the next client."""

    def recall(self, world: int, result: NDArray[np.uint8], frame: NDArray[np.uint8]) -> None:
        """Updates the belief about a world with the result and frame of an earlier step."""

    def update(
        self, chosen: NDArray[np.bool_], results: NDArray[np.uint8], frames: NDArray[np.uint8]
    ) -> None:
        """Updates the beliefs about the worlds marked in `chosen` with a step."""

    def plan(
        self, chosen: NDArray[np.bool_], results: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Plans all options in the worlds marked in `chosen`.

        Returns features `(n_worlds, options, features)` and paths `(n_worlds, options, T)` of all
        worlds, as new arrays.
        """

    def close(self) -> None:
        """Drops all beliefs. May be called again."""

class Flights:
    """The current path of each robot, up to its latest move; one row for each robot.

    `reward` is the reward of each state. If given, each cell pays the reward of its hidden state
    when the path first visits it. A copied or unpickled object has no moves.
    """

    def __init__(
        self,
        n_rows: int,
        height: int,
        width: int,
        n_moves: int,
        reward: list[float] | None,
        airspace: _Airspace | None = None,
        windows: list[tuple[int, int]] = ...,
    ) -> None:
        """`windows`: side, and number of channels about the world, of each square to show."""

    @property
    def robots(self) -> NDArray[np.int64]:
        """Row and column of each robot. All properties are new arrays."""

    @property
    def n_made(self) -> NDArray[np.int64]:
        """Number of moves made."""

    @property
    def visited(self) -> NDArray[np.uint8]:
        """255 in the visited cells, otherwise 0."""

    @property
    def paid(self) -> NDArray[np.float64]:
        """Sum of the rewards of the moves made."""

    @property
    def masks(self) -> NDArray[np.int8]:
        """1 for each move that takes a robot to another cell, otherwise 0, `(n_rows, 4)`.

        If no move does, the whole row is 1.
        """

    def start_paths(
        self,
        begun: NDArray[np.bool_],
        robots: NDArray[np.int64],
        states: NDArray[np.uint8] | None,
    ) -> None:
        """Begins paths in the rows `begun`; `robots` and `states` have an entry for every row."""

    def completes(self) -> NDArray[np.bool_]:
        """Returns the mask of the rows whose next move completes their path."""

    def paths(self, actions: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Returns the paths that `actions` complete as last moves, `(n_rows, T)`; makes no move."""

    def made(self, row: int) -> NDArray[np.uint8]:
        """Returns the moves made by one robot."""

    def show(self, windows: int, begun: NDArray[np.bool_], shown: NDArray[np.uint8]) -> None:
        """Begins paths in the rows `begun`, with channels `(n_begun, H, W, n_of_world)`."""

    def around(self, windows: int) -> NDArray[np.uint8]:
        """Returns the cells around the robots as a new array, `(n_rows, side, side, channels)`.

        The channels about the world come first, 0 in visited cells. Three channels follow: 255 in
        the cells that this path has visited; 255 off the grid and in no-fly cells; 255 times the
        share of remaining moves.
        """

    def move(self, moved: NDArray[np.bool_], actions: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Makes a move in the rows `moved`; returns the reward of each row."""

class Lease:
    """The right to fly consecutive robots, and the step k of each of their worlds."""

    def __init__(
        self, server: Connection, number: int, first_robot: int, n_robots: int
    ) -> None: ...
    def step(
        self, paths: ArrayLike, first_robot: int, n_robots: int, flags: int, seconds: float
    ) -> Answer | None:
        """Flies a path with each robot, for the next step of its world.

        Returns None if the paths are not a plain array of int64 or uint8, or are invalid: then
        `as_moves` converts or refuses them.
        """

    def send_paths(
        self,
        paths: ArrayLike,
        first_robot: int,
        n_robots: int,
        accepts_late: bool,
        seconds: float,
    ) -> tuple[Answer, int] | None:
        """Like `step`, but repeats the request until the worlds have moved; see `client.Lease`."""

    def observe(self, first_robot: int, n_robots: int, flags: int, seconds: float) -> Answer:
        """Returns the last results and frames again; steps continue from the observed step."""

    def note(self, world: int, step: int) -> None:
        """Sets the step that a world is at."""

    @property
    def steps(self) -> list[int]:
        """The step of each world."""

class Frames:
    """A reader of `Frame`s, of one world or of all worlds."""

    def __init__(self, instance: str, world: int | None = None) -> None: ...
    def receive(self, seconds: float) -> dict[str, Any] | None:
        """Returns the fields of the next sample; None if none arrives in time."""

    def close(self) -> None:
        """Closes the reader. May be called again."""

class Truths:
    """A reader of `Truth`s, of one world or of all worlds."""

    def __init__(self, instance: str, world: int | None = None) -> None: ...
    def receive(self, seconds: float) -> dict[str, Any] | None:
        """Returns the fields of the next sample; None if none arrives in time."""

    def close(self) -> None:
        """Closes the reader. May be called again."""

class Outlooks:
    """A reader of `Outlook`s, of one world or of all worlds."""

    def __init__(self, instance: str, world: int | None = None) -> None: ...
    def receive(self, seconds: float) -> dict[str, Any] | None:
        """Returns the fields of the next sample; None if none arrives in time."""

    def close(self) -> None:
        """Closes the reader. May be called again."""

class Recording:
    """A reader of a recording.

    An error with code "cut" or "damaged" means that all earlier records are complete.
    """

    def __init__(self, path: str | bytes | PathLike[str]) -> None: ...
    def read(self) -> tuple[int, Literal["server", "frame", "truth"], Any] | None:
        """Returns nanoseconds, kind, and a server's JSON or a sample's fields; None at the end."""

def checkpoint_bytes(path: str) -> bytes:
    """Returns the bytes of a checkpoint; refuses folders, pipes and files that are too large."""

def option_names() -> tuple[list[str], list[str]]:
    """Returns the names of the options, and of the features that describe each plan."""

def read_model(text: str) -> dict[str, Any]:
    """Returns the fields of `Model` except `toml`; `ValueError` if the text is not a model file."""

def model_text(name: str) -> str:
    """Returns the text of a model with all maps, by its name, path, or the text of its file."""

def model_with_radius(text: str, radius: int) -> str:
    """Returns the text of a model file with another sensor radius."""

def description_with_radius(text: str, radius: int) -> str:
    """Returns the text of a description with another sensor radius."""

def read_description(text: str) -> dict[str, Any]:
    """Returns the fields of `Description` except `toml`; `ValueError` if the text is invalid."""

@final
class Dynamics:
    """The transition of worlds for one model on one grid; `Model.advance` checks the arguments."""

    def __new__(cls, model: str, height: int, width: int) -> Dynamics:
        """`model`: the text of a model file."""

    def advance(
        self, states: NDArray[np.uint8], seeds: NDArray[np.uint64], step: int
    ) -> NDArray[np.uint8]:
        """Returns the states one step later, `(n, H, W)`, as a new array; `seeds`: `(n,)`."""

class Estimators:
    """Beliefs of one kind about n worlds; `Belief` checks the arguments.

    `chosen`, `(n,)`, is the mask of the worlds that a call applies to.
    """

    @staticmethod
    def known(
        model: str, prior: NDArray[np.float32], kind: str, n_worlds: int | None
    ) -> Estimators:
        """Builds beliefs from a model file's text. All worlds share the `prior`, `(S, H, W)`."""

    @staticmethod
    def load(
        file: str,
        grid: tuple[int, int] | None,
        kind: str | None,
        model: str | None,
        n_worlds: int | None,
    ) -> Estimators:
        """Loads beliefs; `grid` is height and width, `model` a model file's text.

        A file of `save` takes no other arguments.
        """

    def copy(self) -> Estimators: ...
    def to_bytes(self) -> bytes: ...
    @staticmethod
    def from_bytes(bytes: bytes) -> Estimators: ...
    def save(self, file: str) -> None: ...
    def steps(self) -> list[int | None]:
        """Returns the number of predictions of each world; None after an interrupted call."""

    def sample(self, seed: int) -> NDArray[np.uint8]:
        """Returns states drawn cell by cell, as a new array, `(n, H, W)`."""

    @property
    def is_single(self) -> bool:
        """Whether arrays have no axis for worlds."""

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
        """Returns the beliefs as a new array, `(S, n, H, W)`."""

    def entropy(self) -> NDArray[np.float32]:
        """Returns the entropy of each cell in nats, as a new array, `(n, H, W)`."""

    def reset(self, chosen: NDArray[np.bool_], keeps_correlations: bool) -> None: ...
    def correct(self, frames: NDArray[np.uint8], chosen: NDArray[np.bool_]) -> None:
        """Corrects the beliefs about the chosen worlds; one frame for each world, `(n, H, W)`."""

    def predict(self, chosen: NDArray[np.bool_]) -> None: ...
    def scores(self, states: NDArray[np.uint8], target: int) -> tuple[_Doubles, _Doubles, _Doubles]:
        """Returns log loss, Brier score and accuracy for states `(n, H, W)`, `(n,)` each."""

    def score_frames(self, frames: NDArray[np.uint8]) -> tuple[_Doubles, _Doubles]:
        """Returns log-likelihoods of frames `(n, H, W)` and numbers of observed cells, `(n,)`."""

def belief_kinds() -> list[tuple[str, tuple[str, bool, bool, bool]]]:
    """Returns the name of each kind of belief that frames can correct, and the fields of `Kind`."""

def simulated_prior(model: str, height: int, width: int, burn_in: int) -> NDArray[np.float32]:
    """Returns the share of 64 simulated worlds with each cell in each state, `(S, H, W)`."""

def beam_search(
    values: NDArray[np.float32],
    robots: NDArray[np.int64],
    keys: NDArray[np.uint64],
    n_moves: int,
    width: int,
    airspace: _Airspace | None = None,
) -> NDArray[np.uint8]:
    """Returns a path for each world, `(n, n_moves)`.

    `values`: `(n, H, W)`; `robots`: `(n, 2)`; `keys`: `(n,)`, seeds that break ties.
    """

@final
class MeritTally:
    """Running figures of merit of several worlds."""

    def __new__(cls, n_worlds: int, height: int, width: int, target: int) -> MeritTally: ...
    def update(
        self,
        visited: NDArray[np.bool_],
        robots: NDArray[np.int64],
        n_hits: NDArray[np.uint32],
        n_burning: NDArray[np.uint32],
        states: NDArray[np.uint8] | None,
    ) -> None:
        """Adds a step; shapes `(n, H, W)`, `(n, R, 2)`, `(n,)`, `(n,)` and `(n, H, W)`."""

    def merit(self, world: int) -> tuple[int | None, int | None, float | None, float | None, float]:
        """Returns the fields of `Merit`."""

def choices(given: object, n_rows: int, n_choices: int) -> NDArray[np.uint8] | None:
    """Checks that each row has one integer below `n_choices`; returns the integers as bytes.

    Returns None if the argument is not a plain array, or is invalid.
    """
