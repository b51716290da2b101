"""Builds the package with maturin, which makes a wheel of programs or of a module, not of both.

So the wheel of the programs is made first; from there they go into that of the module as files.
"""

import shutil
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import maturin
from maturin import (
    build_sdist,
    get_requires_for_build_editable,
    get_requires_for_build_sdist,
    get_requires_for_build_wheel,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]

# Each hook of maturin fails without the folder that `data` names; git keeps none.
Path(maturin.get_config()["data"]).mkdir(exist_ok=True)


def build_wheel(folder: str, settings: Any = None, metadata: str | None = None) -> str:
    """Of the module, the programs and the Python files."""
    _build_programs(settings)
    return maturin.build_wheel(folder, settings, metadata)


def build_editable(folder: str, settings: Any = None, metadata: str | None = None) -> str:
    """The same, with links to the Python files."""
    _build_programs(settings)
    return maturin.build_editable(folder, settings, metadata)


def _build_programs(settings: Any) -> None:
    """Puts the programs where `data` of pyproject.toml expects them."""
    scripts = Path(maturin.get_config()["data"]) / "scripts"
    shutil.rmtree(scripts, ignore_errors=True)
    scripts.mkdir(parents=True)
    flags = [*maturin.get_maturin_pep517_args(settings), "--bindings", "bin"]
    with tempfile.TemporaryDirectory() as folder:
        wheel = Path(folder) / maturin.build_wheel(folder, {"build-args": flags})
        with zipfile.ZipFile(wheel) as file:
            for member in file.infolist():
                path = Path(member.filename)
                if path.parent.name == "scripts":
                    (scripts / path.name).write_bytes(file.read(member))
                    (scripts / path.name).chmod(0o755)
