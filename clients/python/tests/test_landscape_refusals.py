"""Input that the importer refuses, each with one line about the expected and given values."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray
from rasterio.enums import ColorInterp
from rasters import ARRIVAL, NEVER, X, Y, changed, geotiff, masks, netcdf, refused

from emberwatch.landscape.fire import MOST_STATES

ARRIVALS = ("--kind", "arrival", "--step", "10 min", "--burning", "2", "--unit", "min")
MASKS = ("--kind", "mask", "--step", "10 min", "--burning", "2")
BURNING = ("--kind", "burning", "--step", "10 min")
STATES = ("--kind", "states", "--step", "10 min")
ONE, NONE = np.eye(3, 4), np.zeros((3, 4))

Flags = tuple[object, ...]
Case = Callable[[Path], Flags]


def arrivals(*flags: object, bands: object = (), **properties: object) -> Case:
    return lambda f: (geotiff(f / "a.tif", *bands, **properties), *ARRIVALS, *flags)  # type: ignore


def two(kind: Flags, first: object = ARRIVAL, second: object = ARRIVAL, **more: object) -> Case:
    return lambda f: (
        geotiff(f / "a.tif", first), geotiff(f / "b.tif", second, **more), *kind  # type: ignore
    )  # fmt: skip


def layers(kind: Flags, *bands: object, flags: Flags = ()) -> Case:
    return lambda f: (geotiff(f / "stack.tif", *bands, nodata=None), *kind, *flags)  # type: ignore


def timed(*times: float, unit: str = "", flags: Flags = ()) -> Case:
    return lambda f: (
        netcdf(f / "a.nc", masks(), times=times, time_unit=unit), *MASKS, *flags
    )  # fmt: skip


def placed(x: object = X, values: object = ONE, over: Any = ("y", "x"), unit: str = "s") -> Case:
    def case(folder: Path) -> Flags:
        axes = {"x": ("x", x, {"units": "m"})} | ({"y": Y} if values is ONE else {})
        given = {"v": (over, values, {"units": unit})}
        xarray.Dataset(given, axes).to_netcdf(folder / "a.nc")
        return folder / "a.nc", *ARRIVALS[:-2]

    return case


def text(name: str, words: str) -> Case:
    def case(folder: Path) -> Flags:
        (folder / name).write_text(words)
        return folder / name, *ARRIVALS

    return case


def array(folder: Path, values: np.ndarray) -> Path:
    np.save(folder / "fire.npy", values)
    return folder / "fire.npy"


#: Words of the error, and the flags for a folder.
CASES: list[tuple[str, Case]] = [
    ("expected a file or folder, got none", lambda f: (f / "no.tif", *ARRIVALS)),
    ("expected rasters in this folder, got none", lambda f: (f, *MASKS)),
    ("expected one of .tif, .tiff, .asc", text("a.xyz", "")),
    ("expected a NetCDF file, got: ", text("a.nc", "CDF\1")),
    ("expected a NumPy file, got: ", text("a.npz", "hello")),
    ("a.nc, x: expected cells of one size side by side, got some of 30 and some of 90",
        placed([15.0, 45, 75, 165])),
    ("a.nc, x: expected cells of one size side by side, got some of nan",
        placed([15, 45, np.nan, 105])),
    ("expected a variable with the dimensions time, rows and columns, got one with level, y, x",
        placed(values=masks(), over=("level", "y", "x"))),
    ("a.nc: expected cells, got an array of shape (0, 4)", placed(values=masks()[0, :0])),
    ("a.nc: expected one variable, got 0 (none)", placed(values=ARRIVAL[0], over="x")),
    ("a.nc: expected a NetCDF file, got: ", placed(unit="fires since 2020-08-01")),
    ("expected times in days or smaller units, got 'm'; give the", placed(unit="m")),
    ("expected a GeoTIFF, got: ", text("a.tif", "hello")),
    ("expected one band of arrival times, got 3; choose with --band",
        arrivals(bands=[ARRIVAL, ARRIVAL, ARRIVAL])),
    ("expected bands of layers, got the alpha band 2; choose with --band",
        lambda f: (changed(geotiff(f / "a.tif", ARRIVAL, ARRIVAL),
            colorinterp=[ColorInterp.gray, ColorInterp.alpha]), *ARRIVALS)),
    ("--band: expected 1 to 1 for ", arrivals("--band", 2)),
    ("a.nc (v), got 'lat'", lambda f: (netcdf(f / "a.nc"), *ARRIVALS, "--variable", "lat")),
    ("has no variables, got 'at'; leave the flag out", arrivals("--variable", "at")),
    ("b.tif: expected the extent of", two(MASKS, ONE, ONE, corner=(500_030, 4_000_000))),
    ("WGS 84 / UTM zone 10N, got WGS 84 / UTM zone 11N", two(MASKS, ONE, ONE, crs="EPSG:32611")),
    ("expected rows from west to east, got a rotated grid",
        lambda f: (changed(geotiff(f / "a.tif"),
            transform=rasterio.Affine(30, 5, 0, 5, -30, 0)), *ARRIVALS)),
    ("band 2: expected cells that burn once and stay burnt, got 3 that burn or are unburnt",
        layers(MASKS, ONE, NONE)),
    ("band 3: expected cells that burn once and stay burnt, got 3 that",
        layers(BURNING, ONE, NONE, ONE)),
    ("expected a later time than 600, got nan",
        timed(0, 600, float("nan"), 900, flags=("--unit", "s"))),
    ("band 3: expected a later time than 2020-08-02 01:00:00 UTC, got 2020-08-02 00:00:00 UTC",
        timed(0, 25, 24, 26, unit="hours since 2020-08-01")),
    ("expected the time of the layer, got none; leave out --unit s",
        layers(MASKS, NONE, ONE, flags=("--unit", "s"))),
    ("--unit: expected h, as in ", timed(0, 1, 2, 3, unit="hours", flags=("--unit", "s"))),
    ("band 2: expected 0 and only one other number, above 0, in all layers, got 2 in row 0",
        layers(MASKS, ONE, 2 * ONE)),
    ("expected 0 and only one other number, above 0, in all layers, got -9999 in row 0, column 0;",
        layers(MASKS, NEVER * ONE)),
    ("band 2: expected the codes 0, 1, 2, got 3 in row 0, column 0", layers(STATES, ONE, 3 * ONE)),
    ("expected times of at least 0, got -9999 in row 0, column 3; if it means never",
        arrivals("--begin=0", nodata=None)),
    ("expected times of at least 0, got -5 in row 0, column 0",
        arrivals(bands=[ARRIVAL - 5], nodata=NEVER - 5)),
    ("--begin: applies only with --kind arrival, got --kind states",
        layers(STATES, ONE, flags=("--begin", 2))),
    ("expected cells that burn, got none", arrivals(bands=[np.full((3, 4), NEVER)])),
    ("expected cells that burn, got none", layers(MASKS, NONE, NONE)),
    ("--step: too short for times up to 50, got ", arrivals("--step", "1e-310 s")),
    ("--step: expected a number and s, min, h or d, such as '10 min', got '3 weeks'",
        arrivals("--step", "3 weeks")),
    ("expected at least 2 steps, got 1: all cells that burn begin in it; use a shorter --step, or",
        layers(MASKS, ONE)),
    ("to 1000000000000000000, got 2020-10-14", arrivals("--begin", "2020-10-14")),
    ("--burning: expected a whole number, 1 to 999999999, got 0", arrivals("--burning", 0)),
    ("--cell: expected metres, 0.001 to 1000000000, got 0", arrivals("--cell", 0)),
    ("--codes: expected three different numbers, got 1,2",
        layers(STATES, ONE, flags=("--codes=1,2",))),
    ("bytes of states, got 5000000001 steps of 3 x 4",
        arrivals(bands=[np.where(ARRIVAL < 0, NEVER, ARRIVAL * 1e9)], dtype="float64")),
    ("at most 4096 x 4096 cells, the server's maximum, got 4097 x 5463",
        arrivals("--height", 4097)),
    ("expected the proportions of 3 x 4 cells, got 1 x 1", arrivals("--height", 1)),
    ("expected input with a projection, which gives the size of its cells, got none; use --height",
        lambda f: (array(f, masks()), *MASKS, "--cell", 60)),
    ("--cell: cannot be combined with --height", arrivals("--cell", 60, "--height", 3)),
    ("b.tif: expected (3, 4) cells as in the first sequence, got (2, 4); use --height",
        two(ARRIVALS, second=ARRIVAL[:2])),
    ("--unit: expected ms, s, min, h or d, as ", lambda f: (geotiff(f / "a.tif"), *ARRIVALS[:-2])),
    ("--burning: required with --kind arrival: the number of steps that a cell burns",
        lambda f: (geotiff(f / "a.tif"), *ARRIVALS[:4])),
    ("expected numbers of shape (rows, columns) or (layers, rows, columns), got float64 (3,)",
        lambda f: (array(f, np.zeros(3)), *ARRIVALS)),
]  # fmt: skip


@pytest.mark.parametrize(("words", "case"), CASES)
def test_other_input_is_refused(
    words: str, case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out" / "world.npz"
    folder = tmp_path / "in"
    folder.mkdir()
    assert words in refused(capsys, *case(folder), "--out", out)
    assert not out.parent.exists(), "nothing is written"


def test_existing_or_unwritable_output_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, file = tmp_path / "world.npz", geotiff(tmp_path / "a.tif")
    for there in (out, out.with_suffix(".toml")):
        there.write_text("mine")
        line = refused(capsys, file, *ARRIVALS, "--out", out)
        assert f"--out: {there} exists already; --force replaces it" in line
        assert there.read_text() == "mine"
        there.unlink()
    line = refused(capsys, file, *ARRIVALS, "--out", tmp_path / "world.zip")
    assert "--out: expected a .npz file, got " in line
    assert "a.tif" in refused(capsys, file, *ARRIVALS, "--out", file / "world.npz")
    assert list(tmp_path.iterdir()) == [file], "nothing is written"


def test_a_missing_library_names_the_extra(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rasterio", None)
    file = tmp_path / "a.tif"
    file.touch()
    line = refused(capsys, file, *ARRIVALS, "--out", tmp_path / "world.npz")
    assert "rasterio" in line and line.endswith("; pip install emberwatch[landscape]")


def test_the_limits_are_documented() -> None:
    page = (Path(__file__).parents[3] / "docs/landscapes.md").read_text("utf-8")
    assert f"more than {MOST_STATES >> 30} GiB of states" in page
