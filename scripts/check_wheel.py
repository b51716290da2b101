"""Tries a new user's first steps with the installed package. `scripts/wheel` runs it with a PATH without compilers.

Runs the example of docs/environments/wildfire.md, which needs Pillow.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import gymnasium

import emberwatch

ROOT = Path(__file__).resolve().parents[1]
PROGRAMS = ("emberwatch-server", "emberwatch-agent", "emberwatch-dashboard")


def find(name: str) -> str:
    """Returns the path of an installed program."""
    return str(Path(sys.prefix, "bin", name))


def output(*command: str) -> str:
    """Runs a command that must succeed. Returns its output."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout


def check_place() -> None:
    """Checks that PATH contains no compiler, and that the imported package is the installed one."""
    for name in ("cargo", "rustc", "cc", "gcc", "clang"):
        assert shutil.which(name) is None, f"{name} is on the PATH"
    assert Path(emberwatch.__file__).is_relative_to(sys.prefix), emberwatch.__file__


def check_versions() -> None:
    """Checks that the package and the programs have the same version."""
    version = output(sys.executable, "-c", "import emberwatch; print(emberwatch.__version__)").strip()
    for name in PROGRAMS:
        assert output(find(name), "--version").split() == [name, version]


def check_example() -> None:
    """Checks that the example of docs/environments/wildfire.md draws a picture."""
    page = (ROOT / "docs/environments/wildfire.md").read_text("utf-8")
    code = re.search(r"```python\n(.*?)```", page, re.DOTALL)
    assert code is not None
    exec(code[1], {})
    assert Path("wildfire.png").stat().st_size > 1000


def check_vector() -> None:
    """Checks that a vector environment steps many worlds."""
    envs = gymnasium.make_vec("emberwatch/WildfireMoves-v0", num_envs=8)
    envs.reset(seed=1000)
    for _ in range(64):
        rewards = envs.step(envs.action_space.sample())[1]
    envs.close()
    assert rewards.shape == (8,)


def check_training() -> None:
    """Checks that the agent learns a model for a few steps."""
    flags = "train --steps 64 --worlds 2 --height 32 --width 32 --burn-in 500 --out learned"
    output(find("emberwatch-agent"), *flags.split())
    assert Path("learned/checkpoint.safetensors").stat().st_size > 100


def check_dashboard() -> None:
    """Checks that the dashboard's page answers while a server runs."""
    instance = f"wheel-{os.getpid()}"
    server = subprocess.Popen([find("emberwatch-server"), f"--instance={instance}"])
    emberwatch.connect(instance, wait=30).close()
    command = [find("emberwatch-dashboard"), f"--instance={instance}", "--listen=127.0.0.1:0"]
    page = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert page.stdout is not None
    address = next(filter(None, (re.search(r"http://\S+", line) for line in page.stdout)))
    with urllib.request.urlopen(address[0], timeout=30) as answer:
        assert b"<html" in answer.read()
    for program in (page, server):
        program.terminate()
        program.wait(timeout=30)


def main() -> None:
    for check in (
        check_place,
        check_versions,
        check_example,
        check_vector,
        check_training,
        check_dashboard,
    ):
        start = time.monotonic()
        check()
        print(f"{check.__doc__}  {time.monotonic() - start:.1f} s", flush=True)


if __name__ == "__main__":
    main()
