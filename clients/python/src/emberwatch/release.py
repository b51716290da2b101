"""The package's version."""

import tomllib
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final


def _version() -> str:
    """That of the installed package, or of the source tree that this is imported from."""
    with suppress(PackageNotFoundError):
        return version("emberwatch")
    with suppress(OSError, LookupError, ValueError):
        workspace = Path(__file__).resolve().parents[4] / "Cargo.toml"
        return str(tomllib.loads(workspace.read_text())["workspace"]["package"]["version"])
    return "unknown"


VERSION: Final = _version()
