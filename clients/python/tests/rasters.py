"""Small rasters of fires for the tests of the importer, in each format that it reads."""

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray
from numpy.typing import ArrayLike, NDArray

from emberwatch.landscape.__main__ import main

NEVER = -9999.0
#: Minutes until each cell of a 3 x 4 grid begins to burn.
ARRIVAL = np.array([[0, 10, 20, NEVER], [10, 20, 35, NEVER], [NEVER, 30, 40, 50]])
UTM = "EPSG:32610"
#: Elevation in metres that rises by 10 degrees to the east on cells of 30 m.
EASTWARD = np.tile(np.arange(5) * 30 * math.tan(math.radians(10)), (4, 1))
X, Y = 500_015 + 30.0 * np.arange(4), 4_000_075 - 30.0 * np.arange(3)


def worlds(*flags: object) -> list[NDArray[np.uint8]]:
    """Imports files that the flags name. Returns the sequences."""
    out = Path(str(flags[0])).parent / "new" / "world.npz"
    main([str(flag) for flag in (*flags, "--out", out, "--force")])
    with np.load(out) as file:
        assert list(file) == [f"states_{number:03}" for number in range(len(file))]
        return [file[name] for name in file]


def world(*flags: object) -> NDArray[np.uint8]:
    (states,) = worlds(*flags)
    assert states.dtype == np.uint8
    return states


def made(folder: Path, *flags: object) -> dict[str, Any]:
    """Makes a model of land. Returns the content of its file."""
    out = folder / "new" / "land.toml"
    main([str(flag) for flag in ("land", *flags, "--out", out, "--force")])
    return tomllib.loads(out.read_text("utf-8"))


def refused(capsys: pytest.CaptureFixture[str], *flags: object) -> str:
    """Returns the line with which the command refuses the flags."""
    with pytest.raises(SystemExit) as stopped:
        main([str(flag) for flag in flags])
    (line,) = capsys.readouterr().err.splitlines()
    assert stopped.value.code == 2 and line.startswith("python -m emberwatch.landscape")
    return line


def geotiff(
    path: Path,
    *bands: ArrayLike,
    nodata: float | None = NEVER,
    crs: str | None = UTM,
    corner: tuple[float, float] = (500_000, 4_000_090),
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


def changed(file: Path, **properties: object) -> Path:
    """Sets properties of a GeoTIFF."""
    with rasterio.open(file, "r+") as opened:
        for name, value in properties.items():
            setattr(opened, name, value)
    return file


def ascii_grid(path: Path, values: NDArray[Any] = ARRIVAL, *, side: str = "cellsize 30") -> Path:
    rows = [" ".join(str(value) for value in row) for row in values.tolist()]
    head = f"ncols {values.shape[1]}\nnrows {len(values)}\nxllcorner 0\nyllcorner 0\n{side}\n"
    path.write_text(f"{head}NODATA_value {NEVER}\n" + "\n".join(rows) + "\n")
    return path


def netcdf(
    path: Path,
    values: ArrayLike = ARRIVAL,
    unit: str = "min",
    *,
    times: Sequence[float] | None = None,
    time_unit: str = "",
    over: Sequence[str] = ("time", "y", "x"),
    scale: float = 1,
    **coordinates: Any,
) -> Path:
    """Writes a variable `v` with coordinates, `y` and `x` in metres unless others are given."""
    values = np.asarray(values)
    coordinates = coordinates or {"y": ("y", Y, {"units": "m"}), "x": ("x", X, {"units": "m"})}
    if times is not None:
        coordinates["time"] = "time", np.array(times, "f8"), {"units": time_unit}
    array = xarray.DataArray(values, coordinates, over[-values.ndim :], attrs={"units": unit})
    encoding = {"_FillValue": NEVER} if values.dtype.kind == "f" else {}
    if scale != 1:
        array.attrs["scale_factor"] = scale
    array.to_dataset(name="v").to_netcdf(path, encoding={"v": encoding})
    return path


def masks(n_layers: int = 4) -> NDArray[np.uint8]:
    """Returns masks of the cells that have burnt so far, every 10 minutes."""
    burnt = [(ARRIVAL != NEVER) & (ARRIVAL <= 10 * k) for k in range(n_layers)]
    return np.array(burnt, np.uint8)
