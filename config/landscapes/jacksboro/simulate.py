"""Simulates the fires of this landscape with PyTorchFire, on the terrain of the Jacksboro Fault.

pip install "pytorchfire==1.0.3.post2" matplotlib rasterio torch
python simulate.py RAW
"""

import sys
from pathlib import Path

import numpy as np
import rasterio
import torch
from pytorchfire import WildfireModel
from pytorchfire.utils import calculate_slope
from terrain import CELL, PROJECTION, projected_terrain

N_STEPS = 400
#: The fires: ignition point (shares of the rows and columns), wind speed in m/s, direction in which
#: the wind blows (degrees from the east towards the north), and seed.
FIRES = (
    ((0.55, 0.30), 6.0, 20.0, 1),
    ((0.35, 0.65), 4.0, 230.0, 2),
    ((0.75, 0.60), 7.0, 110.0, 3),
    ((0.30, 0.30), 5.0, 320.0, 5),
)
#: As in Alexandridis et al. (2008, doi 10.1016/j.amc.2008.06.046), but cells burn for longer, and
#: fires spread more slowly.
PARAMETERS = {"a": 0.078, "p_h": 0.06, "c_1": 0.045, "c_2": 0.131, "p_continue": 0.85}
#: Assumption: ground steeper than `STEEP` degrees is forest, the rest is farmed land.
STEEP, FOREST, FARMED = 5.0, 0.4, -0.4


def main(raw: Path) -> None:
    """Writes a GeoTIFF for each fire, with a band of states for each step."""
    torch.set_num_threads(1)
    terrain, transform = projected_terrain()
    slope = calculate_slope(torch.from_numpy(terrain), torch.tensor(CELL))
    for number, fire in enumerate(FIRES):
        states = simulated(slope, *fire)
        folder = raw / str(number)
        folder.mkdir(parents=True, exist_ok=True)
        profile = {"driver": "GTiff", "dtype": "uint8", "compress": "deflate"}
        n_steps, height, width = states.shape
        profile |= {"interleave": "band", "crs": PROJECTION, "transform": transform}
        shape = {"count": n_steps, "height": height, "width": width}
        with rasterio.open(folder / "fire.tif", "w", **profile, **shape) as file:
            file.write(states)


def simulated(
    slope: torch.Tensor,
    start: tuple[float, float],
    wind: float,
    towards: float,
    seed: int,
) -> np.ndarray:
    """Returns the states of one fire, (steps, rows, columns): 0 unburnt, 1 burning, 2 burnt."""
    shape = slope.shape[:2]
    ignition = torch.zeros(shape, dtype=torch.bool)
    row, column = int(start[0] * shape[0]), int(start[1] * shape[1])
    ignition[row : row + 3, column : column + 3] = True
    steepest = slope.abs().amax(dim=(2, 3))
    world = {
        "p_veg": torch.where(steepest > STEEP, FOREST, FARMED),
        "wind_velocity": torch.full(shape, wind),
        "wind_towards_direction": torch.full(shape, towards),
        "slope": slope,
        "initial_ignition": ignition,
    }
    model = WildfireModel(world, {name: torch.tensor(x) for name, x in PARAMETERS.items()})
    model.eval()
    model.reset(seed)
    states = np.empty((N_STEPS, *shape), np.uint8)
    with torch.no_grad():
        for step in states:
            burning, burnt = model.state.numpy()
            step[:] = burning + 2 * burnt
            model.compute()
    return states


if __name__ == "__main__":
    main(Path(sys.argv[1]))
