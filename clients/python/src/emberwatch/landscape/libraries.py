"""Imports the libraries of the extra `landscape` when they are needed."""

import importlib
from typing import Any

from emberwatch.errors import InvalidArgumentError


def library(name: str, subject: object) -> Any:
    """Imports a module; for the error, `subject` names what needs it, such as a file."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InvalidArgumentError(
            f"{subject}: reading it needs {name}, got: {error}; pip install emberwatch[landscape]"
        ) from None
