"""Model files with maps from elevation, wind and other rasters."""

import math
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rasters import EASTWARD, ascii_grid, geotiff, made, netcdf

from emberwatch.landscape.__main__ import main
from emberwatch.landscape.terrain import slope_and_wind
from emberwatch.model import Model

CONFIG = Path(__file__).parents[3] / "config"
WIND = ("--wind-speed", 5, "--wind-towards", 20)


def array(path: Path, values: Any) -> Path:
    np.save(path, values)
    return path


def maps(folder: Path) -> dict[str, NDArray[np.float32]]:
    """Returns the maps that `made` wrote."""
    return dict(Model.named(folder / "new" / "land.toml").maps)


def by_hand(row: int, col: int, rise: tuple[float, float], speed: float, towards: float) -> float:
    """Returns the factor of a neighbour `row` rows below the cell and `col` columns to its
    right."""
    distance = math.hypot(row, col)
    # The fire comes from the neighbour: `col` columns to the west, `row` rows to the north.
    east, north = -col / distance, row / distance
    slope = math.degrees(math.atan(east * rise[0] + north * rise[1]))
    angle = math.atan2(north, east) - math.radians(towards)
    return math.exp(0.078 * slope) * math.exp(speed * (0.045 + 0.131 * (math.cos(angle) - 1)))


def test_factors_follow_the_published_formula() -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        rise, speed, towards = (
            rng.normal(0, 0.4, (2, 4, 5)),
            rng.uniform(0, 20),
            rng.uniform(-360, 360),
        )
        got = slope_and_wind(rise, speed, towards)
        for row, col, at, to in np.ndindex(got.shape):
            down, right = row - 1, col - 1
            here = tuple(rise[:, at, to].tolist())
            expected = by_hand(down, right, here, speed, towards) if down or right else 1
            assert got[row, col, at, to] == pytest.approx(expected)


def test_a_uniform_slope_has_the_same_factors_everywhere(tmp_path: Path) -> None:
    model = made(tmp_path, geotiff(tmp_path / "dem.tif", EASTWARD), *WIND)
    rise = math.tan(math.radians(10))
    factors = maps(tmp_path)["slope_wind"]
    assert (model["name"], factors.shape) == ("land", (3, 3, 4, 5))
    assert model["transitions"][0]["times"] == ["slope_wind"]
    for row, col in np.ndindex(3, 3):
        expected = by_hand(row - 1, col - 1, (rise, 0.0), 5, 20) if (row, col) != (1, 1) else 1
        np.testing.assert_allclose(factors[row, col], expected, rtol=5e-3)
    # The wind of `wildfire-burnout` is left out, and nothing else.
    burnout = tomllib.loads((CONFIG / "models/wildfire-burnout.toml").read_text("utf-8"))
    assert model["states"] == burnout["states"]
    assert model["transitions"][1:] == burnout["transitions"][1:]
    table = np.array(model["transitions"][0]["near"]["burning"])
    assert len(set(table[[0, 1, 1, 2], [1, 0, 2, 1]])) == len(set(table[::2, ::2].flat)) == 1


def test_elevation_is_the_same_from_each_format(tmp_path: Path) -> None:
    files = [
        (geotiff(tmp_path / "a.tif", EASTWARD),),
        (geotiff(tmp_path / "up.tif", EASTWARD[::-1], cell=(30, -30)),),
        (ascii_grid(tmp_path / "a.asc", EASTWARD.astype("f4")),),
        (netcdf(tmp_path / "a.nc", z=EASTWARD, unit="m"),),
        (netcdf(tmp_path / "b.nc", z=EASTWARD, y2=EASTWARD, unit="m"), "--variable", "z"),
        (array(tmp_path / "a.npy", EASTWARD), "--cell", 30),
    ]
    found = []
    for flags in files:
        made(tmp_path, *flags)
        found.append(maps(tmp_path)["slope_wind"])
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], rtol=5e-3)


def test_classes_of_fuel_have_their_factors(tmp_path: Path) -> None:
    values, towns = [[3, 3, 1], [8, 3, 8]], [[0, 0, 2.5], [0, 0, 1]]
    fuel = geotiff(tmp_path / "fuel.tif", values, nodata=None)
    no_fly = array(tmp_path / "no.npy", towns)
    flags = ("--fuel", fuel, "--factors=3=2.5", "--unburnable", 8, "--no-fly", no_fly)
    model = made(tmp_path, *flags)
    assert model["transitions"][0]["times"] == ["fuel"]
    assert maps(tmp_path)["fuel"].tolist() == [[2.5, 2.5, 1], [0, 2.5, 0]]
    no_fly = Model.named(tmp_path / "new" / "land.toml").no_fly
    assert no_fly is not None and no_fly.tolist() == [[0, 0, 1], [0, 0, 1]]
    fuel = geotiff(fuel, [[1, 1, -9999], [2, -9999, 2]], nodata=-9999, dtype="int16")
    made(tmp_path, "--fuel", fuel, "--missing-class=0", "--unburnable=0")
    assert maps(tmp_path)["fuel"].tolist() == [[1, 1, 0], [1, 0, 1]]
    towns = geotiff(tmp_path / "towns.tif", [[255, 1, 1], [255, 1, 255]], nodata=255)
    made(tmp_path, "--no-fly", towns)
    no_fly = Model.named(tmp_path / "new" / "land.toml").no_fly
    assert no_fly is not None and no_fly.tolist() == [[0, 1, 1], [0, 1, 0]], "no value: free"
    geotiff(fuel, values, nodata=None)
    dem = array(tmp_path / "z.npy", [[0.0, 10.0, 20.0]] * 2)
    made(tmp_path, dem, "--cell=30", *flags)
    assert set(maps(tmp_path)) == {"fuel", "slope_wind"}


def test_the_command_reports_its_output(tmp_path: Path) -> None:
    dem, out = geotiff(tmp_path / "dem.tif", EASTWARD), tmp_path / "hill.toml"
    command = [sys.executable, "-m", "emberwatch.landscape", "land", dem, "--out", out]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        f"{out}: 4 x 5 cells, maps: slope_wind",
        f"{dem}: cells of 30 x 30 metres on the ground; steepest slope 10.0 degrees",
        f"{dem}: heights in metres (assumed, as the raster names no unit; --height-unit sets it)",
    ]
    assert out.read_text().startswith("# python -m emberwatch.landscape land: 'dem.tif'; wind ")


def test_the_shipped_land_follows_its_wind_and_slopes() -> None:
    factors = Model.named("wildfire-terrain").maps["slope_wind"]
    assert factors.shape == (3, 3, 64, 64) and (factors[1, 1] == 1).all()
    # Factors of opposite neighbours: their slopes cancel, so that only the wind is left.
    for row, col in ((0, 0), (0, 1), (0, 2), (1, 0)):
        both = factors[row, col] * factors[2 - row, 2 - col]
        wind = slope_and_wind(np.zeros((2, 1, 1)), 5, 20)[:, :, 0, 0]
        np.testing.assert_allclose(both, wind[row, col] * wind[2 - row, 2 - col], rtol=0.02)
    assert factors.max() > 4 and factors.min() < 0.2


DEM = "dem.tif"
FUEL = np.array([[1, 2], [3, 4]])


def refusals(f: Path) -> dict[str, tuple[object, ...]]:
    dem, npy = geotiff(f / DEM, EASTWARD), array(f / "dem.npy", EASTWARD)
    fuel = array(f / "fuel.npy", FUEL)
    hole = EASTWARD.copy()
    hole[1, 2] = np.nan
    low = np.where(EASTWARD > 20, -9999.0, EASTWARD)
    return {
        "rasters: expected at least one of ELEVATION, --fuel and --no-fly, got none": (),
        "got no place on the ground; give --cell METRES, or set its projection": (npy,),
        "--cell: expected 30 metres, as ": (dem, "--cell=90"),
        "--cell: expected at least 0.001 metres, such as 30 or '98.4 ft' (m, ": (npy, "--cell=0"),
        f"--factors and --unburnable: expected classes that occur in {fuel}, got 9": (
            "--fuel", fuel, "--unburnable=1,9",
        ),
        "--fuel: expected --factors or --unburnable with it, got neither": ("--fuel", fuel),
        "wind: expected both a --wind-speed above 0 and --wind-from (or --wind-towards), or ne": (
            dem, "--wind-speed=3",
        ),
        "wind: expected --wind-towards or --wind-from, got both": (dem, *WIND, "--wind-from=N"),
        "--wind-from: expected one of N, NNE, NE, ": (dem, "--wind-speed=3", "--wind-from=up"),
        "--missing-class: expected at most 1000000000000000, got 9": (
            "--fuel", fuel, "--unburnable=1", f"--missing-class={'9' * 400}",
        ),
        "hole.npy: expected a number in each cell, got none in 1 cells, the first in row 1, col": (
            "--fuel", array(f / "hole.npy", hole), "--unburnable=1",
        ),
        "column 2; fill them (gdal_fillnodata), or use a part": (f / "hole.npy", "--cell=30"),
        "expected heights of -1000 to 10000 metres, got -9999; give --nodata if it means no": (
            array(f / "low.npy", low), "--cell=30",
        ),
        "expected at least 2 x 2 cells, as a slope needs two neighbours, got 1 x 1": (
            array(f / "one.npy", [[1.0]]), "--cell=30",
        ),
        "expected heights in one of m, km, dm, cm, mm, ft, us-ft, got 'm2 s-2'; give --height-": (
            netcdf(f / "geopotential.nc", z=EASTWARD, unit="m2 s-2"),
        ),
        "expected square cells, got 30 x 60 metres on the ground; ": (
            geotiff(f / "ob.tif", EASTWARD, cell=(30, 60)),
        ),
        "other.tif: expected the extent of ": (
            dem, "--no-fly", geotiff(f / "other.tif", EASTWARD, corner=(0, 0)),
        ),
        "expected at most 4096 x 4096 cells": (
            "--fuel", array(f / "l.npy", np.ones((1, 4097))), "--unburnable=1",
        ),
    }  # fmt: skip


def test_refusals_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, mine = ["--out", tmp_path / "out" / "land.toml"], tmp_path / "mine.toml"
    mine.write_text("mine")
    rows = {words: (*flags, *out) for words, flags in refusals(tmp_path).items()}
    rows["mine.toml exists already; --force replaces it"] = (tmp_path / DEM, "--out", mine)
    rows["a .toml"] = (tmp_path / DEM, "--out", tmp_path / "a.txt")
    for words, flags in rows.items():
        with pytest.raises(SystemExit) as stopped:
            main(["land", *map(str, flags)])
        assert stopped.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert words in line and line.startswith("python -m emberwatch.landscape land: ")
        assert not out[1].parent.exists() and mine.read_text() == "mine"
