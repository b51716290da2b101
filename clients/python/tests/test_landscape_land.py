"""Model files with zones from elevation, wind and other rasters."""

import math
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rasters import EASTWARD, ascii_grid, geotiff, made, netcdf

from emberwatch.landscape.__main__ import main
from emberwatch.landscape.terrain import factors, zones
from emberwatch.landscape.zoned import toml

CONFIG = Path(__file__).parents[3] / "config"
BURNOUT = tomllib.loads((CONFIG / "models/wildfire-burnout.toml").read_text("utf-8"))
#: Mean weights of burning neighbours in the base model: at the cell's sides, and its corners.
SIDE, CORNER = (0.04 + 0.10 + 0.02 + 0.04) / 4, (0.06 + 0.02 + 0.06 + 0.02) / 4
SLOPE = "10 degrees up to the east, aspect W"
WIND = ("--wind-speed", 5, "--wind-towards", 20)


def array(path: Path, values: Any) -> Path:
    np.save(path, values)
    return path


def weights(model: dict[str, Any], zone: str, **states: str) -> np.ndarray:
    """Returns the weights of the only entry with these states. The key `from_` means `from`."""
    wanted = {"zone": zone} | {key.strip("_"): name for key, name in states.items()}
    (entry,) = (e for e in model["kernel"] if wanted.items() <= e.items())
    return np.array(entry["weights"])


def spread(model: dict[str, Any], zone: str) -> np.ndarray:
    return weights(model, zone, own="unburnt", from_="burning", to="burning")


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
    for size in [(3, 3), (1, 5), (5, 3)] * 5:
        rise, speed, towards = rng.normal(0, 0.4, 2), rng.uniform(0, 20), rng.uniform(-360, 360)
        got = factors(rise, speed, towards, size)
        for row, col in np.ndindex(*size):
            down, right = row - size[0] // 2, col - size[1] // 2
            expected = by_hand(down, right, tuple(rise), speed, towards) if down or right else 1
            assert got[row, col] == pytest.approx(expected)


def test_each_cell_is_in_the_zone_of_its_slope_and_aspect() -> None:
    rng = np.random.default_rng(2)
    rise = rng.normal(0, 0.2, (2, 9, 11))
    cells, found = zones(rise, None, shape=(9, 11), step=5)
    names = "east north-east north north-west west south-west south south-east".split()
    aspects = "W SW S SE E NE N NW".split()  # downhill
    for row, col in np.ndindex(9, 11):
        east, north = rise[:, row, col]
        degrees = 5 * round(math.degrees(math.atan(math.hypot(east, north))) / 5)
        angle = math.degrees(math.atan2(north, east))
        eighths = round(angle / 45) % 8
        name = f"{degrees} degrees up to the {names[eighths]}, aspect {aspects[eighths]}"
        assert found[cells[row, col]].name == (name if degrees else "flat")
    assert cells.dtype == np.uint8 and set(cells.flat) == set(range(len(found)))
    assert len({zone.name for zone in found}) == len(found)
    for number, zone in enumerate(found):
        np.testing.assert_allclose(zone.rise, rise[:, cells == number].mean(axis=1))


def test_a_uniform_slope_is_one_zone_with_scaled_weights(tmp_path: Path) -> None:
    model = made(tmp_path, geotiff(tmp_path / "dem.tif", EASTWARD), *WIND)
    assert [zone["name"] for zone in model["zones"]] == [SLOPE]
    assert model["name"] == "land" and model["zone_map"] == np.zeros((4, 5)).tolist()
    name, rise = model["zones"][0]["name"], math.tan(math.radians(10))
    got = spread(model, name)
    for row, col in np.ndindex(3, 3):
        if (row, col) == (1, 1):
            assert got[1, 1] == 0
            continue
        base = SIDE if 1 in (row, col) else CORNER
        expected = base * by_hand(row - 1, col - 1, (rise, 0.0), 5, 20)
        assert got[row, col] == pytest.approx(expected, rel=1e-5)
    around = np.array([[CORNER, SIDE, CORNER], [SIDE, 0, SIDE], [CORNER, SIDE, CORNER]])
    burnt = weights(model, name, own="unburnt", from_="burnt", to="unburnt")
    np.testing.assert_allclose(burnt, around)
    assert weights(model, name, own="burning", from_="burning", to="burning")[1, 1] == 0.96
    assert len(model["kernel"]) == len(BURNOUT["kernel"])
    for key in ("states", "observations", "kernel_size"):
        assert model[key] == BURNOUT[key]


def test_elevation_is_the_same_from_each_format(tmp_path: Path) -> None:
    files = [
        (geotiff(tmp_path / "a.tif", EASTWARD),),
        (geotiff(tmp_path / "up.tif", EASTWARD[::-1], cell=(30, -30)),),
        (ascii_grid(tmp_path / "a.asc", EASTWARD.astype("f4")),),
        (netcdf(tmp_path / "a.nc", z=EASTWARD, unit="m"),),
        (netcdf(tmp_path / "b.nc", z=EASTWARD, y2=EASTWARD, unit="m"), "--variable", "z"),
        (array(tmp_path / "a.npy", EASTWARD), "--cell", 30),
    ]
    first, *others = (made(tmp_path, *flags) for flags in files)
    for other in others:
        assert other["zones"] == first["zones"] and other["zone_map"] == first["zone_map"]
        np.testing.assert_allclose(spread(other, other["zones"][0]["name"]),
                                   spread(first, first["zones"][0]["name"]), rtol=1e-4)  # fmt: skip


def test_zones_of_a_raster_keep_the_base_models_kernels(tmp_path: Path) -> None:
    values, towns = [[3, 3, -1], [8, 3, 8]], [[0, 0, 2.5], [0, 0, -1]]
    flags = ("--zones", geotiff(tmp_path / "fuel.tif", values, nodata=None), "--unburnable", 8)
    model = made(tmp_path, *flags, "--no-fly", array(tmp_path / "no.npy", towns))
    names = [zone["name"] for zone in model["zones"]]
    assert names == ["zone -1", "zone 3", "zone 8, never burns"]
    assert model["zone_map"] == [[1, 1, 0], [2, 1, 2]]
    assert model["no_fly"] == [[0, 0, 1], [0, 0, 1]]
    for name in names[:2]:
        entries = [dict(entry) for entry in model["kernel"] if entry["zone"] == name]
        assert all(entry.pop("zone") for entry in entries)
        assert entries == BURNOUT["kernel"]
    river = [entry for entry in model["kernel"] if entry["zone"] == names[2]]
    centre = [[0, 0, 0], [0, 1, 0], [0, 0, 0]]
    states = ["unburnt", "burning", "burnt"]
    assert [(e["own"], e["from"], e["to"], e["weights"]) for e in river] == [
        (state, state, "unburnt", centre) for state in states
    ]


def test_slopes_divide_only_zones_that_burn(tmp_path: Path) -> None:
    steep = "zone 1, 60 degrees up to the east, aspect W"
    step = np.where(np.arange(6) < 3, 0.0, 100.0) * np.ones((2, 1))
    values = array(tmp_path / "z.npy", [[1] * 6, [2] * 6])
    dem = geotiff(tmp_path / "dem.tif", step)
    model = made(tmp_path, dem, "--zones", values, "--unburnable", 2, "--slope-step", 30)
    names = [zone["name"] for zone in model["zones"]]
    assert names == ["zone 1, flat", steep, "zone 2, never burns"]
    assert model["zone_map"] == [[0, 0, 1, 1, 0, 0], [2] * 6]


def test_kernels_without_own_states_are_adapted(tmp_path: Path) -> None:
    dem = geotiff(tmp_path / "dem.tif", EASTWARD)
    model = made(tmp_path, dem, "--model", "wildfire", "--base-wind")
    base = tomllib.loads((CONFIG / "models/wildfire.toml").read_text("utf-8"))
    for entry, old in zip(model["kernel"], base["kernel"], strict=True):
        expected = np.array(old["weights"])
        if (old["from"], old["to"]) == ("fire", "fire"):
            expected = expected * factors(np.array([math.tan(math.radians(10)), 0]), 0, 0, (3, 3))
        np.testing.assert_allclose(entry["weights"], expected, rtol=1e-5)
        assert entry.get("scale") == old.get("scale")


def test_large_maps_are_written_to_separate_files(tmp_path: Path) -> None:
    values = np.arange(300 * 300).reshape(300, 300) // 30_000
    rasters = ("--zones", array(tmp_path / "z.npy", values))
    model = made(tmp_path, *rasters, "--no-fly", array(tmp_path / "n.npy", values == 1))
    for key, expected in (("zone_map", values), ("no_fly", values == 1)):
        assert model[key] == f"land.{key}.npy"
        cells = np.load(tmp_path / "new" / model[key])
        assert cells.dtype == np.uint8
        np.testing.assert_array_equal(cells, expected)


def test_the_text_has_maps_first_and_allows_any_string() -> None:
    model: dict[str, Any] = {"name": 'a "\\ \x7f\n', "sensor": {"radius": 2, "on": True}}
    model |= {"states": [{"x": 1e-05}, {"x": [[1, 2.5]]}], "kernel": [], "zone_map": [[0], [1]]}
    model |= {"rings": {"rings": [{"a": 1, "b": "c"}]}}
    assert tomllib.loads(toml(model)) == model


def test_the_command_reports_its_output(tmp_path: Path) -> None:
    dem, out = geotiff(tmp_path / "dem.tif", EASTWARD), tmp_path / "hill.toml"
    command = [sys.executable, "-m", "emberwatch.landscape", "land", dem, "--out", out]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        f"{out}: 4 x 5 cells, zones: 1",
        f"{dem}: cells of 30 x 30 metres on the ground; steepest slope 10.0 degrees",
        f"{dem}: heights in metres (assumed, as the raster names no unit; --height-unit sets it)",
    ]
    assert out.read_text().startswith("# python -m emberwatch.landscape land: 'dem.tif'; model ")


def test_the_shipped_land_has_all_kernels_of_each_zone() -> None:
    file = (CONFIG / "models/wildfire-terrain.toml").read_bytes()
    model = tomllib.loads(file.decode())
    names = [zone["name"] for zone in model["zones"]]
    zone_map = np.array(model["zone_map"])
    assert zone_map.shape == (64, 64) and set(zone_map.flat) == set(range(len(names)))
    assert len(model["kernel"]) == len(names) * len(BURNOUT["kernel"])
    # Level ground: only the wind counts, as the mean slope of `flat` is below a quarter degree.
    around = np.array([[CORNER, SIDE, CORNER], [SIDE, 0, SIDE], [CORNER, SIDE, CORNER]])
    expected = around * factors(np.zeros(2), 5, 20, (3, 3))
    np.testing.assert_allclose(spread(model, "flat"), expected, rtol=0.02)
    uphill = spread(model, "15 degrees up to the north")
    assert uphill[2, 1] > 2 * spread(model, "flat")[2, 1] > 8 * uphill[0, 1]


DEM = "dem.tif"
FUEL = np.array([[1, 2], [3, 4]])


def refusals(f: Path) -> dict[str, tuple[object, ...]]:
    dem, npy = geotiff(f / DEM, EASTWARD), array(f / "dem.npy", EASTWARD)
    fuel = array(f / "fuel.npy", FUEL)
    hole = EASTWARD.copy()
    hole[1, 2] = np.nan
    low = np.where(EASTWARD > 20, -9999.0, EASTWARD)
    zoned = f / "zoned.toml"
    zoned.write_text((CONFIG / "models/wildfire.toml").read_text() + "\n")
    unpaid = f / "unpaid.toml"
    unpaid.write_text(zoned.read_text().replace("reward = 1.0", ""))
    biased = f / "biased.toml"
    biased.write_text(zoned.read_text().replace("reward = 1.0", "reward = 1.0\nbias = 0.1"))
    closed = f / "closed.toml"
    closed.write_text("no_fly = [[0, 0, 1]]\n" + zoned.read_text())
    many = array(f / "many.npy", np.arange(300).reshape(15, 20))
    return {
        "rasters: expected at least one of ELEVATION, --zones and --no-fly, got none": (),
        f"{f}/none.tif: expected a file or folder, got none": (f / "none.tif",),
        f"{f}/a.png: expected one of .tif, ": (array(f / "a.npy", FUEL).rename(f / "a.png"),),
        "got no place on the ground; give --cell METRES, or set its projection": (npy,),
        "--cell: expected 30 metres, as ": (dem, "--cell=90"),
        "--cell: expected at least 0.001 metres, such as 30 or '98.4 ft' (m, ": (npy, "--cell=0"),
        "got '30 furlongs'": (npy, "--cell=30 furlongs"),
        "--cell: applies only with ELEVATION": ("--zones", fuel, "--cell=30"),
        "--oblong: applies only with ELEVATION": ("--zones", fuel, "--oblong"),
        "--unburnable: applies only with --zones": (dem, "--unburnable=3"),
        f"--unburnable: expected values that occur in {fuel}, got 9": (
            "--zones", fuel, "--unburnable=1,9",
        ),
        "--slope-step: expected 0.1 to 90 degrees, got 0.0": (dem, "--slope-step=0"),
        "--wind-speed: expected 0 to 100 m/s, got nan": (dem, "--wind-speed=nan"),
        "wind: expected both a --wind-speed above 0 and --wind-from (or --wind-towards), or ne": (
            dem, "--wind-speed=3",
        ),
        "or neither, got only one of them": (dem, "--wind-towards=3"),
        "--wind-towards: expected -360 to 360 degrees, got inf": (
            dem, "--wind-speed=3", "--wind-towards=inf",
        ),
        "wind: expected --wind-towards or --wind-from, got both": (dem, *WIND, "--wind-from=N"),
        "--wind-from: expected one of N, NNE, NE, ": (dem, "--wind-speed=3", "--wind-from=up"),
        "or -360 to 360 degrees, got '370'": (dem, "--wind-speed=3", "--wind-from=370"),
        "--missing-zone: expected at most 1000000000000000, got 9": (
            "--zones", fuel, f"--missing-zone={'9' * 400}",
        ),
        "--missing-zone: applies only with --zones": (dem, "--missing-zone=0"),
        "hole.npy: expected a number in each cell, got none in 1 cells, the first in row 1, col": (
            "--zones", array(f / "hole.npy", hole),
        ),
        "column 2; --missing-zone N gives them the number N": ("--zones", f / "hole.npy"),
        "column 2; fill them (gdal_fillnodata), or use a part": (f / "hole.npy", "--cell=30"),
        "hole.tif: expected a height in each cell, got none in 1 cells, the first in row 1, col": (
            geotiff(f / "hole.tif", hole),
        ),
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
        "two.tif: expected one layer, got several; choose with --band": (
            geotiff(f / "two.tif", EASTWARD, EASTWARD),
        ),
        "fuel.npy: expected 4 x 5 cells as in ": (dem, "--zones", fuel),
        "other.tif: expected the extent of ": (
            dem, "--no-fly", geotiff(f / "other.tif", EASTWARD, corner=(0, 0)),
        ),
        "half.npy: expected whole numbers, each a zone, got 0.5": (
            "--zones", array(f / "half.npy", [[0.5, 1.0]]),
        ),
        "zones: expected at most 256, got 300": ("--zones", many),
        "ones.npy: expected a cell of 0, where robots may be, got none": (
            "--zones", fuel, "--no-fly", array(f / "ones.npy", np.ones((2, 2))),
        ),
        "expected at most 4096 x 4096 cells": ("--zones", array(f / "l.npy", np.ones((1, 4097)))),
        "model file ash: No such file": (dem, "--model=ash"),
        "--state: expected one of unburnt, burning, burnt, got 'ash'": (dem, "--state=ash"),
        "expected a kernel by which 'burnt' spreads to neighbours": (dem, "--state=burnt"),
        "--state: expected the state that spreads, as no state pays": (dem, "--model", unpaid),
        'model "wildfire": expected a base model without `no_fly`, got': (dem, "--model", closed),
        "--unburnable: expected a model in which only 'normal' has a bias, got one in which 'f": (
            "--zones", fuel, "--unburnable=1", "--model", biased,
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
