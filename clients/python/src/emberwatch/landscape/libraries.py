"""Imports the libraries of the extra `landscape` when they are needed."""

import importlib
from typing import Any

from emberwatch.errors import InvalidArgumentError


def library(name: str) -> Any:
    """Imports a module of a library; names the extra if the library is missing."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InvalidArgumentError(f"{error}; pip install emberwatch[landscape]") from None
