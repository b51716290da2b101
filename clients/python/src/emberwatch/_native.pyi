"""The part of the package that is written in Rust.

Waits leave the interpreter to other threads; Ctrl-C ends them. What is open belongs to the process
that made it: in a forked child, using it is an error with code `"forked"`.
"""

from os import PathLike
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

class Server:
    """A connection to a server. Threads may share it: they take turns."""

    def __init__(self, instance: str, client: str, seconds: float) -> None:
        """Opens it; `client` names this program in the server's log."""

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
    ) -> tuple[int, NDArray[np.uint8]]:
        """Sends a request on `step` as it is.

        Returns:
            How long the server worked on it, nanoseconds, and the answer's payload.
        """

    def close(self) -> None:
        """Closes it. May be called again."""

class Agent:
    """A connection to the agent whose first world is `world`, which serves decisions."""

    def __init__(self, instance: str, world: int, client: str, seconds: float) -> None: ...
    @property
    def info(self) -> str:
        """What the agent said of itself, as JSON."""

    def control(self, text: bytes, what: str, seconds: float) -> str:
        """As `Server.control`."""

    def close(self) -> None:
        """Closes it. May be called again."""

class Lease:
    """The right to fly consecutive robots, and the step k of each of their worlds."""

    def __init__(self, server: Server, number: int, first_robot: int, n_robots: int) -> None: ...
    def step(
        self, paths: ArrayLike, first_robot: int, n_robots: int, flags: int, seconds: float
    ) -> tuple[int, NDArray[np.uint8]]:
        """Flies a path with each robot, for the next step of its world."""

    def observe(
        self, first_robot: int, n_robots: int, flags: int, seconds: float
    ) -> tuple[int, NDArray[np.uint8]]:
        """The last results and frames again; steps go on from there."""

    def note(self, world: int, step: int) -> None:
        """From here on a world is at this step."""

    @property
    def steps(self) -> list[int]:
        """The step of each world."""

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
