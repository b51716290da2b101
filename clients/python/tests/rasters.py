"""Small rasters of fires for the tests of the importer, in each format that it reads."""

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import rasterio
from numpy.typing import ArrayLike, NDArray

from emberwatch.landscape.__main__ import main

NEVER = -9999.0
#: Minutes until each cell of a 3 x 4 grid begins to burn.
ARRIVAL = np.array([[0, 10, 20, NEVER], [10, 20, 35, NEVER], [NEVER, 30, 40, 50]])
UTM = "EPSG:32610"
#: Elevation in metres that rises by 10 degrees to the east on cells of 30 m.
EASTWARD = np.tile(np.arange(5) * 30 * math.tan(math.radians(10)), (4, 1))


def made(folder: Path, *flags: object) -> dict[str, Any]:
    out = folder / "new" / "land.toml"
    main([str(flag) for flag in ("land", *flags, "--out", out, "--force")])
    return tomllib.loads(out.read_text("utf-8"))


def geotiff(
    path: Path,
    *bands: ArrayLike,
    nodata: float | None = NEVER,
    crs: str | None = UTM,
    corner: tuple[float, float] = (500_000, 4_000_000),
    cell: tuple[float, float] = (30, 30),
    **profile: Any,
) -> Path:
    arrays = np.array(bands or [ARRIVAL], profile.pop("dtype", "float32"))
    place = {
        "transform": rasterio.Affine(cell[0], 0, corner[0], 0, -cell[1], corner[1]),
        "crs": crs,
    }
    count, height, width = arrays.shape
    profile = {"dtype": arrays.dtype, "nodata": nodata} | place | profile
    with rasterio.open(
        path, "w", driver="GTiff", count=count, height=height, width=width, **profile
    ) as file:
        file.write(arrays)
    return path


def ascii_grid(path: Path, values: NDArray[Any] = ARRIVAL, *, side: str = "cellsize 30") -> Path:
    rows = [" ".join(str(value) for value in row) for row in values.tolist()]
    head = f"ncols {values.shape[1]}\nnrows {len(values)}\nxllcorner 0\nyllcorner 0\n{side}\n"
    path.write_text(f"{head}NODATA_value {NEVER}\n" + "\n".join(rows) + "\n")
    return path


def netcdf(
    path: Path,
    *,
    times: Sequence[float] | None = None,
    time_unit: str | None = None,
    calendar: str | None = None,
    unit: str = "min",
    southward: bool = True,
    extra: bool = False,
    over: tuple[str, str, str] = ("time", "y", "x"),
    **variables: ArrayLike,
) -> Path:
    """Writes a NetCDF file of variables over rows and columns, or over the dimensions `over`."""
    file = netCDF4.Dataset(path, "w")
    arrays = {name: np.asarray(values, "f4") for name, values in variables.items()}
    height, width = next(iter(arrays.values())).shape[-2:]
    dimensions = {"y": np.arange(height)[:: -1 if southward else 1] * 30.0 + 15}
    dimensions |= {"x": np.arange(width) * 30.0 + 15}
    if times is not None:
        dimensions = {"time": np.array(times)} | dimensions
    dimensions |= {name: np.arange(2.0) for name in over if times and name not in dimensions}
    if extra:
        dimensions = {"level": np.arange(2.0)} | dimensions
    for name, places in dimensions.items():
        file.createDimension(name, len(places))
        axis = file.createVariable(name, "f8", (name,))
        axis[:] = places
        if name in "xy":
            axis.units, axis.standard_name = "m", f"projection_{name}_coordinate"
        if name == "time" and time_unit is not None:
            axis.units = time_unit
        if name == "time" and calendar is not None:
            axis.calendar = calendar
    names = tuple(dimensions) if times is None or extra else over
    for name, values in arrays.items():
        variable = file.createVariable(name, "f4", names, fill_value=NEVER)
        variable[:] = values if southward else values[..., ::-1, :]
        variable.units = unit
    file.close()
    return path


def masks(n_layers: int = 4) -> NDArray[np.uint8]:
    """Returns masks of the cells that have burnt so far, every 10 minutes."""
    burnt = [(ARRIVAL != NEVER) & (ARRIVAL <= 10 * k) for k in range(n_layers)]
    return np.array(burnt, np.uint8)
