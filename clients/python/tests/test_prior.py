"""Simulated priors: equal to the agent program's, cached, and safe with signals and forks."""

import signal
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import find, script

from emberwatch.belief.prior import simulated_prior
from emberwatch.model import Model

MODEL = Model.wildfire()
WORLD: dict[str, Any] = {"height": 5, "width": 7, "burn_in": 40}

#: A script whose simulation takes hours.
ENDLESS = """
from emberwatch.model import Model
from emberwatch.belief.prior import simulated_prior
print("begun", flush=True)
simulated_prior(Model.wildfire(), height=64, width=64, burn_in=1 << 40)
"""


def test_the_prior_equals_the_agents(tmp_path: Path) -> None:
    file = tmp_path / "prior.npy"
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in WORLD.items()]
    command = [find("emberwatch-agent"), "prior", "--model=wildfire", *flags, f"--out={file}"]
    subprocess.run(command, check=True, capture_output=True)
    found, expected = simulated_prior(MODEL, **WORLD), np.load(file)
    assert found.dtype == expected.dtype == np.float32
    assert np.array_equal(found, expected)
    assert simulated_prior(Model.wildfire(), **WORLD) is found, "simulated once"
    with pytest.raises(ValueError, match="read-only"):
        found[:] = 0


def test_ctrl_c_ends_the_simulation() -> None:
    process = script(ENDLESS)
    assert process.line() == "begun"
    process.signal(signal.SIGINT)
    code, _, error = process.end()
    assert code in (1, 130, -signal.SIGINT) and "KeyboardInterrupt" in error
