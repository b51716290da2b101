"""What can go wrong. `EmberwatchError` covers all of it; `code` names the cause.

Subclasses exist only where a caller acts differently.
"""

from typing import Final, Self


class EmberwatchError(Exception):
    """Base of all errors of this package.

    Attributes:
        code: The cause. A refusal has the name of its status (PROTOCOL.md section 5), such as
            `"busy"`, and changed nothing in the world. Others: `"closed"`, `"interrupted"` (an
            earlier step or reset did not finish: reset or resume), `"forked"` (neither channels
            nor worlds in a process survive `fork`), `"embedded"` (worlds in this process could
            not be made), `"threads"` (the system starts no more), `"channel"` (iceoryx2, or a
            system call that it needs, failed), `"bad_answer"` (client and server
            are not of one release), `"program"` (a prior or a network failed),
            `"pid_namespace"` (the server is in another one), `"impossible_frame"`, `"recording"`.
        detail: The number that comes with a refusal; its meaning depends on the status.
    """

    code: str = "unknown"

    def __init__(self, message: str | Self, code: str | None = None, detail: int = 0) -> None:
        if isinstance(message, EmberwatchError):  # made again, as `AsyncVectorEnv` does
            message, code, detail = str(message), code or message.code, detail or message.detail
        super().__init__(message)
        self.code = code or self.code
        self.detail = detail


class InvalidArgumentError(EmberwatchError, ValueError):
    """An action or a keyword is impossible, or contradicts the server. Nothing was sent."""

    code = "invalid_argument"


def invalid(subject: object, expected: object, got: object) -> InvalidArgumentError:
    """The error of a value that is not what was expected."""
    return InvalidArgumentError(f"{subject}: expected {expected}, got {got}")


def bad_answer(subject: object, expected: object, got: object) -> EmberwatchError:
    """The error of an answer, or of something published, that makes no sense."""
    return EmberwatchError(f"{subject}: expected {expected}, got {got}", "bad_answer")


class LeaseLostError(EmberwatchError):
    """The lease ended, or another client took robots over; `detail` is its pid, or 0."""

    code = "lease_lost"


class NoServerError(EmberwatchError):
    """Nobody serves the instance."""

    code = "no_server"


class NotEnoughMemoryError(EmberwatchError, MemoryError):
    """More memory was asked for than the machine, a cgroup or a `ulimit` has."""

    code = "no_memory"


class RequestTimeoutError(EmberwatchError, TimeoutError):
    """No answer in time. A step may have been made all the same: observe before stepping again."""

    code = "timeout"


class ServerGoneError(EmberwatchError, ConnectionError):
    """The server ended while or before it was asked."""

    code = "server_gone"


class TrainingOnTestWorldsWarning(UserWarning):
    """A reset has begun an episode on a test seed of the task, outside of an evaluation."""


#: Name and sentence of each status code, from code 1; `step` sends the code alone. None: not used.
STATUSES: Final[tuple[tuple[str, str] | None, ...]] = (
    (
        "version_mismatch",
        "protocol version mismatch: the server speaks {}; use a client and a server of one release",
    ),
    ("unknown_operation", "operation: expected 1 (step), 2 (observe) or 3 (recall), got {}"),
    ("malformed", "malformed control message"),
    (
        "no_such_world",
        "no such world: there are worlds 0 to {last}; for more, set worlds (--worlds N of a "
        "server)",
    ),
    ("wrong_length", "wrong payload length: expected {} bytes"),
    ("wrong_path_length", "wrong path length: the server flies {} moves a step"),
    ("bad_move", "byte {} of the payload: expected a move in 0..=3"),
    ("no_lease", "no lease on robot {}: acquire it first"),
    ("lease_lost", "lease lost to pid {}, which took the robot over or acquired it since"),
    ("busy", "busy: held by pid {}; wait for its release, or acquire with takeover=True"),
    ("resetting", "world {} is being reset; wait for the answer to the reset"),
    ("episode_over", "world {} was truncated: reset it first"),
    (
        "not_permitted",
        'not permitted: full frames need a server with coverage "client" or "full", and a replay '
        "takes no steps",
    ),
    ("unknown_flags", "flags: expected 1 (full coverage), 2 (team frames), both or 0, got {}"),
    None,
    None,
    ("bad_file", "the file cannot be used"),
    ("not_kept", "not kept: the nearest step that is kept is {}"),
    (
        "late",
        "late: the world is at step {} already; observe it, and send a path for that step",
    ),
    ("early", "early: the world is at step {} only"),
    (
        "incomplete",
        "incomplete: robot {} is missing; a step names all robots that its client holds in a "
        "world, and a step of several worlds needs them all",
    ),
    (
        "no_such_robot",
        "no such robot: there are robots 0 to {last}; for more, set worlds or robots (--worlds N "
        "or --robots N of a server)",
    ),
    ("no_memory", "memory: expected {} bytes for the answer, got less; ask for fewer robots"),
)

_CLASSES: Final = {"lease_lost": LeaseLostError, "no_memory": NotEnoughMemoryError}


def refusal(status: int, detail: int, message: str | None = None) -> EmberwatchError:
    """The error of a status code other than 0, in the server's words if they fit Python."""
    known = STATUSES[status - 1] if 1 <= status <= len(STATUSES) else None
    if known is None:
        message = message or f"the server refused: status {status}, detail {detail}"
        return EmberwatchError(message, detail=detail)
    code, sentence = known
    if code == "lease_lost" and detail == 0:
        sentence = "lease lost: it expired or was released; acquire the robots again"
    if code == "no_memory" and detail == 0:
        sentence = "shared memory is full: free some, and ask again"
    if message is None or code == "busy":  # the server's words name a flag, not a keyword
        message = sentence.format(detail, last=max(detail - 1, 0))
    return _CLASSES.get(code, EmberwatchError)(message, code, detail)
