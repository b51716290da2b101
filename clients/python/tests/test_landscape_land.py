"""Model files with maps from elevation, wind and other rasters."""

import math
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import geopandas
import numpy as np
import pytest
from numpy.typing import NDArray
from rasters import EASTWARD, geotiff, made, netcdf, refused

from emberwatch.landscape.terrain import slope_and_wind
from emberwatch.model import Model

WIND = ("--wind-speed", 5, "--wind-from", "wsw")
FOOT = 0.3048
SECOND = 1 / 3600
#: Length of a second of arc in metres; a sphere is accurate to 0.2 degrees of slope.
ARC = 111_200 / 3600


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
    rise, speed, towards = rng.normal(0, 0.4, (2, 4, 5)), rng.uniform(0, 20), rng.uniform(-360, 360)
    got = slope_and_wind(rise, speed, towards)
    for row, col, at, to in np.ndindex(got.shape):
        down, right = row - 1, col - 1
        here = tuple(rise[:, at, to].tolist())
        expected = by_hand(down, right, here, speed, towards) if down or right else 1
        assert got[row, col, at, to] == pytest.approx(expected)


def test_the_model_is_the_built_in_one_with_a_map(tmp_path: Path) -> None:
    model = made(tmp_path, geotiff(tmp_path / "dem.tif", EASTWARD), *WIND)
    factors = maps(tmp_path)["slope_wind"]
    assert (model["name"], factors.shape) == ("land", (3, 3, 4, 5))
    assert model["transitions"][0]["times"] == ["slope_wind"]
    rise = math.tan(math.radians(10))
    expected = by_hand(0, 1, (rise, 0.0), 5, 22.5)
    np.testing.assert_allclose(factors[1, 2], expected, rtol=5e-3)
    feet = netcdf(tmp_path / "b.nc", EASTWARD / FOOT, "feet", y=("y", 15 + 30.0 * np.arange(4)))
    made(tmp_path, feet, "--cell", 30, *WIND)
    np.testing.assert_allclose(maps(tmp_path)["slope_wind"], factors, rtol=5e-3)
    # The wind of `wildfire-burnout` is left out.
    table = np.array(model["transitions"][0]["near"]["burning"])
    assert len(set(table[[0, 1, 1, 2], [1, 0, 2, 1]])) == len(set(table[::2, ::2].flat)) == 1


class Map(NamedTuple):
    crs: str | None
    cell: float
    """Side in units of the map."""
    corner: tuple[float, float]
    ground: tuple[float, float] = (30.0, 30.0)
    """Width and height of a cell in metres."""
    flags: str = ""
    height: float = 1.0
    """Length of the unit of height in metres."""


SLOPES: dict[str, Map] = {
    "feet": Map("EPSG:2263", 100, (1e6, 2e5), (30.48, 30.48), "--height-unit ft", FOOT),
    "degrees at 60 N": Map("EPSG:4326", SECOND, (10, 60), (ARC / 2, ARC), "--oblong"),
    "no projection": Map(None, SECOND, (-120, 38), flags="--cell 30"),
    "Web Mercator at 60 N": Map("EPSG:3857", 60, (1.6e6, 8.4e6 - 2e4)),
    "a plane": Map('LOCAL_CS["mine",UNIT["metre",1]]', 30, (0, 0), flags="--cell 30"),
}


@pytest.mark.parametrize("case", SLOPES)
def test_a_slope_is_the_same_in_every_unit_and_projection(case: str, tmp_path: Path) -> None:
    place = SLOPES[case]
    rows, columns = np.indices((12, 12))
    east, north = columns * place.ground[0], -rows * place.ground[1]
    heights = ((0.6 * east + 0.8 * north) * math.tan(math.radians(10)) + 500) / place.height
    cell = place.cell, place.cell
    file = geotiff(tmp_path / "dem.tif", heights, crs=place.crs, corner=place.corner, cell=cell)
    made(tmp_path, file, *place.flags.split())
    factors = maps(tmp_path)["slope_wind"]
    # Degrees up from the neighbour in the west, and from the one in the south.
    for row, col, share in ((1, 0, 0.6), (2, 1, 0.8)):
        expected = math.degrees(math.atan(share * math.tan(math.radians(10))))
        assert np.log(factors[row, col]) / 0.078 == pytest.approx(expected, abs=0.2)


def test_classes_of_fuel_have_their_factors(tmp_path: Path) -> None:
    values, towns = [[3, 3, 1], [8, 3, 8]], [[0, 0, 2.5], [np.nan, 0, 1]]
    fuel = geotiff(tmp_path / "fuel.tif", values, nodata=None)
    no_fly = array(tmp_path / "no.npy", towns)
    flags = ("--fuel", fuel, "--factors=3=2.5,8=0", "--no-fly", no_fly)
    model = made(tmp_path, *flags)
    assert model["transitions"][0]["times"] == ["fuel"]
    assert maps(tmp_path)["fuel"].tolist() == [[2.5, 2.5, 1], [0, 2.5, 0]]
    no_fly = Model.named(tmp_path / "new" / "land.toml").airspace.no_fly
    assert no_fly is not None and no_fly.tolist() == [[0, 0, 1], [0, 0, 1]], "no value: free"
    dem = array(tmp_path / "z.npy", [[0.0, 10.0, 20.0]] * 2)
    made(tmp_path, dem, "--cell=30", *flags)
    assert set(maps(tmp_path)) == {"fuel", "slope_wind"}
    made(tmp_path, "--fuel", geotiff(fuel, [[1, 1], [-9999, 1]], nodata=None), "--factors=-9999=0")
    assert maps(tmp_path)["fuel"].tolist() == [[1, 1], [0, 1]]


def test_the_command_reports_its_output(tmp_path: Path) -> None:
    dem, out = geotiff(tmp_path / "dem.tif", EASTWARD), tmp_path / "hill.toml"
    command = [sys.executable, "-m", "emberwatch.landscape", "land", dem, "--out", out]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        f"{out}: 4 x 5 cells, maps: slope_wind",
        f"{dem}: cells of 30 x 30 metres; steepest slope 10.0 degrees",
        f"{dem}: heights in m (assumed, as the raster names no unit; --height-unit sets it)",
    ]
    assert out.read_text().startswith("# python -m emberwatch.landscape land: 'dem.tif'; wind ")


DEM = "dem.tif"
HOLE = np.where(EASTWARD == EASTWARD[0, 1], np.nan, EASTWARD)
LOW = np.where(EASTWARD > 20, -9999.0, EASTWARD)


def _square(path: Path) -> Path:
    """Writes a perimeter."""
    shape = geopandas.GeoSeries.from_wkt(["POLYGON ((0 0, 0 1, 1 1, 1 0, 0 0))"], crs=4326)
    geopandas.GeoDataFrame({"time": ["2020-01-01"]}, geometry=shape).to_file(path)
    return path


def refusals(f: Path) -> dict[str, tuple[object, ...]]:
    dem, npy, hole = geotiff(f / DEM, EASTWARD), array(f / "dem.npy", EASTWARD), f / "hole.npy"
    fuel = array(f / "fuel.npy", [[1, 2], [3, 4]])
    low = geotiff(f / "low.tif", LOW, nodata=None)
    array(hole, HOLE)
    return {
        "rasters: expected at least one of ELEVATION, --fuel and --no-fly, got none": (),
        "expected a projection, which gives the size of cells, got none; give --cell": (npy,),
        "--cell: expected 30 metres, as ": (dem, "--cell=90"),
        f"--factors: expected classes that occur in {fuel}, got 9": (
            "--fuel", fuel, "--factors=1=2,9=0",
        ),
        "--fuel: expected both --fuel and --factors, or neither": ("--fuel", fuel),
        "wind: expected both a --wind-speed above 0 and --wind-from, or neither": (
            dem, "--wind-speed=3",
        ),
        "--wind-from: expected one of N, NNE, NE, ": (dem, "--wind-speed=3", "--wind-from=up"),
        "hole.npy: expected a class in each cell, got none in 4 cells, the first in row 0, col": (
            "--fuel", hole, "--factors=1=2",
        ),
        "column 1; fill them (gdal_fillnodata), or use a part": (hole, "--cell=30"),
        "expected heights of -1000 to 10000 metres, got -9999; give --nodata if": (low,),
        "expected whole numbers of at least 0, each a class of fuel, got -9999; give --nodata": (
            "--fuel", low, "--factors=0=2",
        ),
        "low.tif: expected numbers of at least 0, got -9999; give --nodata": ("--no-fly", low),
        "expected at least 2 x 2 cells, as a slope needs two neighbours, got 1 x 1": (
            array(f / "one.npy", [[1.0]]), "--cell=30",
        ),
        "expected heights in one of m, ft, us-ft, got 'm2 s-2'; give --height-": (
            netcdf(f / "geopotential.nc", EASTWARD[:3, :4], "m2 s-2"), "--cell=30",
        ),
        "expected square cells, got 30 x 60 metres on the ground; ": (
            geotiff(f / "ob.tif", EASTWARD, cell=(30, 60)),
        ),
        "projection WGS 84: expected cells on the Earth, got ": (
            geotiff(f / "far.tif", EASTWARD, crs="EPSG:4326", corner=(0, 900)),
        ),
        "other.tif: expected the extent of ": (
            dem, "--no-fly", geotiff(f / "other.tif", EASTWARD, corner=(0, 0)),
        ),
        "l.npy: expected at most 4096 x 4096 cells": (
            "--fuel", array(f / "l.npy", np.ones((1, 4097))), "--factors=1=2",
        ),
        "expected --kind arrival and --cell METRES": (_square(f / "square.geojson"),),
        "expected one layer, got several; choose with --band": (
            array(f / "two.npy", [EASTWARD, EASTWARD]), "--cell=30",
        ),
    }  # fmt: skip


def test_refusals_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, mine = ["--out", tmp_path / "out" / "land.toml"], tmp_path / "mine.toml"
    mine.write_text("mine")
    rows = {words: (*flags, *out) for words, flags in refusals(tmp_path).items()}
    rows["mine.toml exists already; --force replaces it"] = (tmp_path / DEM, "--out", mine)
    for words, flags in rows.items():
        assert words in refused(capsys, "land", *flags)
        assert not out[1].parent.exists() and mine.read_text() == "mine"
