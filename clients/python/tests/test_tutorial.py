"""Runs the tutorial of the documentation site as a user would."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]


@pytest.mark.slow
def test_the_tutorial_prints_the_documented_output(tmp_path: Path) -> None:
    command = [sys.executable, ROOT / "scripts/notebook.py", ROOT / "docs/tutorial.ipynb"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
