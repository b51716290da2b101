"""Everything that can go wrong, one exception per cause.

A server's refusal is a `RefusedError` and changed nothing in the world; each status code of
PROTOCOL.md section 5 has a subclass of its own.
"""

from __future__ import annotations

from typing import ClassVar


class EmberwatchError(Exception):
    """Base of all errors of this package."""


class ChannelError(EmberwatchError):
    """A channel could not be opened or used."""


class NoServerError(ChannelError):
    """Nobody serves the instance."""


class ServerGoneError(EmberwatchError, ConnectionError):
    """The server ended while, or before, it was asked."""


class RequestTimeoutError(EmberwatchError, TimeoutError):
    """No answer in time. A step may have been made all the same: observe before stepping again."""


class GarbledAnswerError(EmberwatchError):
    """An answer makes no sense: client and server are not of one release."""


class ForkedError(EmberwatchError, RuntimeError):
    """A connection was used in a child process: shared memory does not survive `fork`."""


class ClosedError(EmberwatchError, RuntimeError):
    """A connection, lease or observer was used after it had been closed."""


class LaunchError(EmberwatchError, RuntimeError):
    """A program of Emberwatch could not be found or started."""


class InvalidActionError(EmberwatchError, ValueError):
    """An action of the wrong shape, type or value. Nothing was sent."""


class SettingError(EmberwatchError, ValueError):
    """A keyword has an impossible value, or contradicts the server attached to."""


class RefusedError(EmberwatchError):
    """The server refused a request and changed nothing.

    Attributes:
        name: The status as text, such as `"busy"`.
        detail: What it concerns; its meaning depends on the status (PROTOCOL.md section 5).
    """

    name: ClassVar[str] = "unknown"

    def __init__(self, message: str, detail: int = 0) -> None:
        """Makes the error of one refusal."""
        super().__init__(message)
        self.detail = detail


class VersionMismatchError(RefusedError):
    """Client and server speak different protocol versions. `detail`: the server's."""

    name = "version_mismatch"


class UnknownOperationError(RefusedError):
    """The server does not know the operation. `detail`: the operation."""

    name = "unknown_operation"


class MalformedError(RefusedError):
    """The server could not read a control message."""

    name = "malformed"


class NoSuchWorldError(RefusedError):
    """A world that the server does not have. `detail`: how many it has."""

    name = "no_such_world"


class WrongLengthError(RefusedError):
    """Paths of a wrong total length. `detail`: bytes expected."""

    name = "wrong_length"


class WrongPathLengthError(RefusedError):
    """Paths of a wrong number of moves. `detail`: moves expected."""

    name = "wrong_path_length"


class BadMoveError(RefusedError):
    """A move that does not exist. `detail`: its position in the paths."""

    name = "bad_move"


class NoLeaseError(RefusedError):
    """Acting without a lease. `detail`: the first such world."""

    name = "no_lease"


class LeaseLostError(RefusedError):
    """The lease ended or the world was taken over.

    `detail`: pid of who took it over, or holds it since; 0 if nobody.
    """

    name = "lease_lost"


class BusyError(RefusedError):
    """Somebody else holds a world. `detail`: pid of the holder."""

    name = "busy"


class ResettingError(RefusedError):
    """A world is in its burn-in. `detail`: the world."""

    name = "resetting"


class EpisodeOverError(RefusedError):
    """The episode was truncated; reset first. `detail`: the world."""

    name = "episode_over"


class NotPermittedError(RefusedError):
    """A full frame was asked of a server that shows paths only, or a replay was to act."""

    name = "not_permitted"


class UnknownFlagsError(RefusedError):
    """The server does not know a flag of the request. `detail`: the flags."""

    name = "unknown_flags"


class BadObjectiveError(RefusedError):
    """An objective that the agent does not have. `detail`: how many it has."""

    name = "bad_objective"


class AgentEndsError(RefusedError):
    """The agent that serves decisions ends: told so, its server is gone, or it failed."""

    name = "agent_ends"


class BadFileError(RefusedError):
    """A file on the server's host cannot be written or read, or is no snapshot of its worlds."""

    name = "bad_file"


class NotKeptError(RefusedError):
    """A step's frame, or a belief, that is not kept; `detail` is the nearest step that is."""

    name = "not_kept"


#: The error of each status code, from code 1.
REFUSALS: tuple[type[RefusedError], ...] = (
    VersionMismatchError,
    UnknownOperationError,
    MalformedError,
    NoSuchWorldError,
    WrongLengthError,
    WrongPathLengthError,
    BadMoveError,
    NoLeaseError,
    LeaseLostError,
    BusyError,
    ResettingError,
    EpisodeOverError,
    NotPermittedError,
    UnknownFlagsError,
    BadObjectiveError,
    AgentEndsError,
    BadFileError,
    NotKeptError,
)


def refusal(code: int, detail: int, message: str | None = None) -> RefusedError:
    """The error for a status code other than 0, in the server's words if they fit Python."""
    if not 1 <= code <= len(REFUSALS):
        return RefusedError(
            message or f"the server refused: status {code}, detail {detail}", detail
        )
    kind = REFUSALS[code - 1]
    if message is None or kind is BusyError:  # to take over is said in Python's terms
        message = _explain(kind, detail)
    return kind(message, detail)


def _explain(kind: type[RefusedError], detail: int) -> str:
    """The server's sentence: on `step` it sends only the code."""
    if kind is LeaseLostError and detail == 0:
        return "lease lost: it expired or was released; acquire the worlds again"
    if kind is NoSuchWorldError:
        return f"no such world: the server has worlds 0 to {max(detail - 1, 0)}"
    sentences = {
        "version_mismatch": "protocol version mismatch: the server speaks {}; "
        "use a client and a server of one release",
        "unknown_operation": "operation: expected 1 (step), 2 (observe) or 3 (recall), got {}",
        "malformed": "malformed control message",
        "wrong_length": "wrong payload length: expected {} bytes",
        "wrong_path_length": "wrong path length: the server flies {} moves a step",
        "bad_move": "byte {} of the paths: expected a move in 0..=3",
        "no_lease": "no lease on world {}: acquire it first",
        "lease_lost": "lease lost to pid {}, which took the world over or acquired it since",
        "busy": "busy: held by pid {}; wait for its release, or acquire with takeover=True",
        "resetting": "world {} is being reset; wait for the answer to the reset",
        "episode_over": "world {} was truncated: reset it first",
        "not_permitted": 'not permitted: full frames need a server with coverage "client" or '
        '"full", and a replay takes no steps',
        "unknown_flags": "flags: expected 0 or 1 (full coverage), got {}",
        "bad_objective": "objective: expected one below {}",
        "bad_file": "the file cannot be used",
        "not_kept": "not kept: the nearest step that is kept is {}",
        "agent_ends": "the agent ends",
    }
    return sentences[kind.name].format(detail)
