"""What can go wrong. `EmberwatchError` covers all of it; `code` names the cause.

Subclasses exist only where a caller acts differently.
"""

from typing import Final, Self

from emberwatch._native import explain


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


_CLASSES: Final = {"lease_lost": LeaseLostError, "no_memory": NotEnoughMemoryError}


def refusal(status: int, detail: int, message: str | None = None) -> EmberwatchError:
    """The error of a status code other than 0, in the words of its status if none are given."""
    known = explain(status, detail)
    if known is None:
        message = message or f"the server refused: status {status}, detail {detail}"
        return EmberwatchError(message, detail=detail)
    code, sentence = known
    if message is None or code == "busy":  # the server's words name a flag, not a keyword
        message = sentence.replace('"takeover": true', "takeover=True")
    return _CLASSES.get(code, EmberwatchError)(message, code, detail)
