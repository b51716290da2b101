"""Simulated priors: cached, and safe with signals and forks."""

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import eventually, script

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


def test_a_prior_is_simulated_once_and_cannot_be_changed() -> None:
    found = simulated_prior(MODEL, **WORLD)
    assert found.dtype == np.float32 and found.shape == (3, 5, 7)
    assert np.allclose(found.sum(axis=0), 1.0)
    assert simulated_prior(Model.wildfire(), **WORLD) is found
    with pytest.raises(ValueError, match="read-only"):
        found[:] = 0


def test_ctrl_c_ends_the_simulation() -> None:
    process = script(ENDLESS)
    assert process.line() == "begun"
    process.signal(signal.SIGINT)
    code, _, error = process.end()
    assert code in (1, 130, -signal.SIGINT) and "KeyboardInterrupt" in error


def test_the_next_process_simulates_if_one_is_killed_and_ctrl_c_ends_the_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first = script(ENDLESS)
    assert first.line() == "begun"
    assert eventually(lambda: list(tmp_path.rglob("*.lock")))
    waits, next_one = script(ENDLESS), script(ENDLESS)
    assert [waits.line(), next_one.line()] == ["begun", "begun"]
    waits.signal(signal.SIGINT)
    code, _, error = waits.end()
    assert code in (1, 130, -signal.SIGINT) and "KeyboardInterrupt" in error
    before, begun = cpu_seconds(next_one.pid), cpu_seconds(first.pid)
    assert eventually(lambda: cpu_seconds(first.pid) > begun + 1)
    assert cpu_seconds(next_one.pid) < before + 0.3  # it waits
    first.signal(signal.SIGKILL)
    assert eventually(lambda: cpu_seconds(next_one.pid) > before + 0.5)


def cpu_seconds(pid: int) -> float:
    """Returns the processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
