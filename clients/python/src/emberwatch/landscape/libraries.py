"""The libraries that the extra `landscape` installs, imported when they are needed."""

import importlib
from typing import Any

from emberwatch.errors import InvalidArgumentError


def library(name: str, subject: object) -> Any:
    """Imports a module; `subject` is what needs it, such as a file."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InvalidArgumentError(
            f"{subject}: expected {name} to read it with, got: {error}; "
            "pip install emberwatch[landscape]"
        ) from None
