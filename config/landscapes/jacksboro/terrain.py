"""The terrain of the Jacksboro Fault on square cells, and a part of it as a GeoTIFF.

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

CELL = 180.0  # metres: twice the 3 arc seconds of the terrain
PROJECTION = "EPSG:32616"
MARGIN = 6  # cells that lie outside the terrain after its projection
#: Of the part: its first row and column, and its side, in cells of 360 m as the fires have them.
TOP, LEFT, SIDE = 10, 8, 64


def main(out: Path) -> None:
    """Writes the part's elevation in metres, each cell the mean of four."""
    terrain, transform = projected_terrain()
    rows, columns = (slice(2 * first, 2 * (first + SIDE)) for first in (TOP, LEFT))
    part = terrain[rows, columns].reshape(SIDE, 2, SIDE, 2).mean(axis=(1, 3))
    transform *= rasterio.Affine.translation(2 * LEFT, 2 * TOP) * rasterio.Affine.scale(2)
    profile = {"driver": "GTiff", "dtype": "float32", "crs": PROJECTION, "transform": transform}
    with rasterio.open(out, "w", **profile, count=1, height=SIDE, width=SIDE) as file:
        file.write(part, 1)


def projected_terrain() -> tuple[np.ndarray, rasterio.Affine]:
    """Elevation in metres on square cells, and where they are."""
    file = cbook.get_sample_data("jacksboro_fault_dem.npz")
    elevation = file["elevation"].astype(np.float32)
    # The file has the northern edge as `ymin`.
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
