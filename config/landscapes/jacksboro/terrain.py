"""Projects the terrain of the Jacksboro Fault to square cells, and writes a part as a GeoTIFF.

pip install matplotlib rasterio
python terrain.py OUT.tif
"""

import sys
from pathlib import Path

import numpy as np
import rasterio
from matplotlib import cbook
from rasterio.transform import from_bounds
from rasterio.warp import Resampling, calculate_default_transform, reproject

CELL = 180.0  # metres; about twice the 3 arc seconds of the source
PROJECTION = "EPSG:32616"
MARGIN = 6  # width of the edge, in cells, that the projection leaves without data
#: First row, first column and side of the written part, in the fires' cells of 360 m.
TOP, LEFT, SIDE = 10, 8, 64


def main(out: Path) -> None:
    """Writes the elevation of the part in metres; each cell is the mean of four."""
    terrain, transform = projected_terrain()
    rows, columns = (slice(2 * first, 2 * (first + SIDE)) for first in (TOP, LEFT))
    part = terrain[rows, columns].reshape(SIDE, 2, SIDE, 2).mean(axis=(1, 3))
    transform *= rasterio.Affine.translation(2 * LEFT, 2 * TOP) * rasterio.Affine.scale(2)
    profile = {"driver": "GTiff", "dtype": "float32", "crs": PROJECTION, "transform": transform}
    with rasterio.open(out, "w", **profile, count=1, height=SIDE, width=SIDE) as file:
        file.write(part, 1)


def projected_terrain() -> tuple[np.ndarray, rasterio.Affine]:
    """Returns the elevation in metres on square cells, and their transform to the projection."""
    file = cbook.get_sample_data("jacksboro_fault_dem.npz")
    elevation = file["elevation"].astype(np.float32)
    # The file stores the northern edge as `ymin`.
    west, north, east, south = (float(file[key]) for key in ("xmin", "ymin", "xmax", "ymax"))
    rows, columns = elevation.shape
    bounds = (west, south, east, north)
    source = {
        "src_crs": "EPSG:4326",
        "src_transform": from_bounds(*bounds, columns, rows),
    }
    transform, width, height = calculate_default_transform(
        "EPSG:4326", PROJECTION, columns, rows, *bounds, resolution=CELL
    )
    terrain = np.zeros((height, width), np.float32)
    target = {"dst_crs": PROJECTION, "dst_transform": transform}
    reproject(elevation, terrain, **source, **target, resampling=Resampling.bilinear)
    inner = terrain[MARGIN:-MARGIN, MARGIN:-MARGIN].copy()
    return inner, transform * rasterio.Affine.translation(MARGIN, MARGIN)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
