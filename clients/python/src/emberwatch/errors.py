"""The errors of this package. All are an `EmberwatchError`, whose `code` names the cause.

Only causes that callers handle differently have a subclass of their own.
"""

from typing import Final, Self

from emberwatch._native import explain


class EmberwatchError(Exception):
    """Base class of all errors of this package.

    Attributes:
        code: The cause. If the server refused a request, the name of the status (PROTOCOL.md
            section 5), such as `"busy"`; the refused request changed nothing in the world. Other
            codes are `"closed"`, `"in_use"` (a signal handler used the object whose call it
            interrupted), `"interrupted"` (an earlier step or reset did not finish: reset or
            resume; the same of a belief's `correct` or `predict`), `"forked"` (channels and worlds
            in this process do not survive `fork`), `"embedded"` (the worlds in this process could
            not be created), `"threads"` (the system cannot start more threads), `"channel"`
            (iceoryx2, or a system call that it needs, failed), `"bad_answer"` (client and server
            are of different releases), `"program"` (a prior or a network failed), `"pid_namespace"`
            (the server runs in a different PID namespace), `"impossible_frame"` and `"recording"`.
        worlds: With `"impossible_frame"`, the worlds of a belief whose frames were refused.
        detail: A number that comes with a refusal. Its meaning depends on the status; 0 if there is
            no number.
    """

    code: str = "unknown"
    worlds: tuple[int, ...] = ()

    def __init__(self, message: str | Self, code: str | None = None, detail: int = 0) -> None:
        if isinstance(message, EmberwatchError):  # `AsyncVectorEnv` wraps an error in its own type
            message, code, detail = str(message), code or message.code, detail or message.detail
        super().__init__(message)
        self.code = code or self.code
        self.detail = detail


class InvalidArgumentError(EmberwatchError, ValueError):
    """An action or a keyword is invalid, or does not match the server. Nothing was sent."""

    code = "invalid_argument"


class ExistingFileError(InvalidArgumentError, FileExistsError):
    """Raised if a file of results would replace an existing file."""


def shortened(value: str) -> str:
    """Returns at most 80 characters of a value for an error: of a longer one, both its ends."""
    return value if len(value) <= 80 else f"{value[:39]}…{value[-40:]}"


def repr_of(value: object) -> str:
    """Returns the `repr` of an argument for an error: of a long one, both its ends.

    If `repr` raises an exception, returns that.
    """
    try:
        return shortened(repr(value))
    except Exception as error:
        return shortened(f"{type(value).__name__}: {error}")


def invalid(subject: object, expected: object, got: object) -> InvalidArgumentError:
    """Returns the error for an invalid value: ``subject: expected ..., got ...``."""
    got = got if isinstance(got, str | Exception) else shortened(str(got))
    return InvalidArgumentError(f"{subject}: expected {expected}, got {got}")


class LeaseLostError(EmberwatchError):
    """The lease ended, or another client took over some of its robots.

    `detail` is the process ID of the other client, or 0.
    """

    code = "lease_lost"


class NoServerError(EmberwatchError):
    """No server runs under this instance name."""

    code = "no_server"


class NotEnoughMemoryError(EmberwatchError, MemoryError):
    """A request needs more memory than the machine, a cgroup or a `ulimit` allows."""

    code = "no_memory"


class RequestTimeoutError(EmberwatchError, TimeoutError):
    """No answer came in time. The step may still have run, so observe before the next one."""

    code = "timeout"


class ServerGoneError(EmberwatchError, ConnectionError):
    """The server ended before it answered."""

    code = "server_gone"


class TrainingOnTestWorldsWarning(UserWarning):
    """A reset began an episode on a test seed of the task, outside an evaluation."""


_CLASSES: Final = {"lease_lost": LeaseLostError, "no_memory": NotEnoughMemoryError}


def refusal(status: int, detail: int, message: str | None = None) -> EmberwatchError:
    """Returns the error for a nonzero status code, with `message` or the status's own text."""
    known = explain(status, detail)
    if known is None:
        message = message or f"the server refused: status {status}, detail {detail}"
        return EmberwatchError(message, detail=detail)
    code, sentence = known
    if message is None or code == "busy":  # the server's text names a JSON key, not our keyword
        message = sentence.replace('"takeover": true', "takeover=True")
    return _CLASSES.get(code, EmberwatchError)(message, code, detail)
