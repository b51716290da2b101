"""Filters on twelve fires of a published benchmark (docs/filters.md)."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

FIRES = Path(__file__).parent / "data" / "fires"
BENCHMARK = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "filter_benchmark.py"))

#: Bounds on each belief's NLL if all trees, a tenth or a window are seen: measured + .002.
BOUNDS = {
    "known": (0.026, 0.2641, 0.3874),
    "known+cavities": (0.026, 0.2328, 0.3500),
    "known+spatial+cavities": (0.0275, 0.1910, 0.3420),
}


@pytest.mark.slow
@pytest.mark.parametrize(("at", "which"), list(enumerate(["all", "tenth", "window"])))
def test_the_loss_of_each_kind_is_as_measured(at: int, which: str) -> None:
    fires = list(BENCHMARK["recorded"](FIRES / f"fires-{which}.npz"))
    assert len(fires) == 12
    for kind, bounds in BOUNDS.items():
        figures = BENCHMARK["figures"](BENCHMARK["model"](), fires, kind)
        loss = np.mean([loss for _, loss, _ in figures])
        assert bounds[at] - 0.004 < loss < bounds[at], f"{kind}: {loss}"
