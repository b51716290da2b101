"""Models of lively worlds with a sensor, no-fly cells and maps."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from environments import LIVELY
from numpy.typing import NDArray

Cells = NDArray[np.bool_]

#: Cells of a 7 x 5 grid where no robot may be; the corner (0, 4) is enclosed.
NO_FLY: Cells = np.array(
    [
        [0, 0, 0, 1, 0],
        [0, 1, 0, 1, 1],
        [0, 1, 0, 0, 0],
        [0, 0, 0, 1, 0],
        [1, 1, 0, 0, 0],
        [0, 0, 0, 0, 1],
        [0, 1, 0, 0, 0],
    ],
    np.bool_,
)


def model(*, radius: int = 0, no_fly: Cells | str | None = None) -> str:
    """Returns the text of a model with an exact sensor. The map may be the name of a file."""
    keys = [f"sensor = {{ radius = {radius} }}"]
    keys += [f"no_fly = {_rows(no_fly)}"] if no_fly is not None else []
    text = Path(LIVELY).read_text()
    for state, old in enumerate(("[0.98, 0.01, 0.01]", "[0.80, 0.15, 0.05]", "[0.01, 0.01, 0.98]")):
        text = text.replace(old, str(np.eye(3)[state].tolist()))
    return text.replace("kernel_size = [3, 3]\n", "kernel_size = [3, 3]\n" + "\n".join(keys) + "\n")


def maps(key: int) -> dict[str, NDArray[np.float32]]:
    """Returns random maps of a 7 x 5 grid."""
    rng = np.random.default_rng(key)
    fuel = rng.uniform(0.5, 2.0, (7, 5))
    wind = rng.uniform(0.0, 3.0, (3, 3, 7, 5))
    return {"fuel": fuel.astype(np.float32), "wind": wind.astype(np.float32)}


def write_hazards(folder: Path, key: int) -> Path:
    """Writes a model of hazards with `maps(key)`. Returns its path."""
    text = (Path(LIVELY).parents[3] / "config/models/wildfire-burnout.toml").read_text()
    text = text.replace("states = [", 'maps = "land.npz"\nstates = [', 1)
    path = folder / "hazards.toml"
    path.write_text(text.replace("near.", 'times = ["fuel", "wind"]\nnear.', 1))
    np.savez(folder / "land.npz", **maps(key))  # pyright: ignore
    return path


def _rows(cells: NDArray[Any] | str) -> str:
    return f'"{cells}"' if isinstance(cells, str) else str(cells.astype(int).tolist())


def cells_of(start: Sequence[int], moves: Sequence[int], no_fly: Cells) -> list[tuple[int, int]]:
    cells = [(int(start[0]), int(start[1]))]
    for move in moves:
        down, right = ((-1, 0), (1, 0), (0, -1), (0, 1))[move]
        row, col = cells[-1][0] + down, cells[-1][1] + right
        is_on_grid = 0 <= row < no_fly.shape[0] and 0 <= col < no_fly.shape[1]
        cells.append((row, col) if is_on_grid and not no_fly[row, col] else cells[-1])
    return cells


def legal_moves(cell: tuple[int, int], no_fly: Cells) -> list[bool]:
    """Returns which moves leave a cell; all moves if none does."""
    leaves = [cells_of(cell, [move], no_fly)[1] != cell for move in range(4)]
    return leaves if any(leaves) else [True] * 4
