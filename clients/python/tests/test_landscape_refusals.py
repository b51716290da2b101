"""Input that the importer refuses, each with one line about the expected and given values."""

import io
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rasters import ARRIVAL, NEVER, ascii_grid, geotiff, masks, netcdf

from emberwatch.landscape.__main__ import main
from emberwatch.landscape.fire import MOST_STATES
from emberwatch.landscape.layers import MOST_CELLS

ARRIVALS = ("--kind", "arrival", "--step", "10 min", "--burning", "2", "--unit", "min")
MASKS = ("--kind", "mask", "--step", "10 min", "--burning", "2")
BURNING = ("--kind", "burning", "--step", "10 min")
STATES = ("--kind", "states", "--step", "10 min")

Flags = tuple[object, ...]


def two(folder: Path, **second: object) -> Flags:
    first = geotiff(folder / "a.tif", masks()[0], nodata=None)
    return first, geotiff(folder / "b.tif", masks()[1], **({"nodata": None} | second)), *MASKS  # type: ignore


def text(path: Path, words: str) -> Path:
    path.write_text(words)
    return path


def stack(folder: Path, *layers: object) -> Path:
    return geotiff(folder / "stack.tif", *np.array(layers, np.float32), nodata=None)


def array(folder: Path, values: np.ndarray) -> Path:
    np.save(folder / "fire.npy", values)
    return folder / "fire.npy"


def edited(path: Path, old: str, new: str) -> Path:
    path.write_text(path.read_text().replace(old, new))
    return path


def folder(path: Path) -> Path:
    path.mkdir()
    return path


def folder_with(folder: Path, name: str) -> Path:
    geotiff(folder / "fire.tif", *masks(), nodata=None)
    text(folder / name, "hello")
    return folder


def days(folder: Path, *units: str | None) -> list[Path]:
    return [
        netcdf(folder / f"{k}.nc", times=[0, 1], time_unit=unit, mask=masks()[2 * k : 2 * k + 2])
        for k, unit in enumerate(units)
    ]


ONE, NONE = np.eye(3, 4), np.zeros((3, 4))

Case = Callable[[Path], Flags]


def arrivals(*flags: object, bands: object = (), **properties: object) -> Case:
    return lambda f: (geotiff(f / "a.tif", *bands, **properties), *ARRIVALS, *flags)  # type: ignore


def layers(kind: Flags, *bands: object, flags: Flags = ()) -> Case:
    return lambda f: (stack(f, *bands), *kind, *flags)


def ascii_file(old: str, new: str) -> Case:
    """Writes an ASCII grid of arrival times, with the text `old` replaced."""
    return lambda f: (edited(ascii_grid(f / "a.asc"), old, new), *ARRIVALS)


def at(*times: float) -> Case:
    return lambda f: (netcdf(f / "a.nc", times=times, mask=masks()), *MASKS)


#: Words of the error, and the flags for a folder.
CASES: list[tuple[str, Case]] = [
    ("expected a file or folder, got none", lambda f: (f / "no.tif", *ARRIVALS)),
    ("expected rasters in this folder, got none", lambda f: (f, *MASKS)),
    ("a.tif: expected each file once, got this one twice",
        lambda f: (geotiff(f / "a.tif"), f / "." / "a.tif", *MASKS)),
    ("expected a NetCDF file, got", lambda f: (text(f / "a.nc", "CDF\1"), *ARRIVALS)),
    ("a.asc: expected 12 numbers for 3 x 4 cells, got 14", ascii_file("20.0", "20.0 20.0")),
    ("ESRI ASCII grid, got: could not convert string to float: b'x'",
        ascii_file("35.0", "x")),
    ("expected a NumPy file, got", lambda f: (text(f / "a.npz", "hello"), *MASKS)),
    ("expected real numbers, got complex64",
        arrivals(bands=[ARRIVAL], dtype="complex64", nodata=None)),
    ("expected one band of arrival times, got 3; choose with --band",
        arrivals(bands=[ARRIVAL, ARRIVAL, ARRIVAL])),
    ("--band: expected 1 to 1 for ", arrivals("--band", 2)),
    ("expected one variable, got 2 (at, wind); choose with --variable",
        lambda f: (netcdf(f / "a.nc", at=ARRIVAL, wind=ARRIVAL), *ARRIVALS)),
    ("a.nc (at), got 'lat'",
        lambda f: (netcdf(f / "a.nc", at=ARRIVAL), *ARRIVALS, "--variable", "lat")),
    ("has no variables, got 'at'; leave the flag out", arrivals("--variable", "at")),
    ("b.tif: expected the extent of", lambda f: two(f, corner=(500_030, 4_000_000))),
    ("WGS 84 / UTM zone 10N, got WGS 84 / UTM zone 11N", lambda f: two(f, crs="EPSG:32611")),
    ("expected rows from west to east, got a rotated grid",
        lambda f: (rotated(f / "a.tif", 30, 5, 0, 5, -30, 0), *ARRIVALS)),
    ("expected a value in each cell, got none in 9 cells, the first in row 0, column 1",
        lambda f: (geotiff(f / "a.tif", ONE, ONE, nodata=0), *MASKS)),
    ("band 2: expected burning cells not to become unburnt, got 3 that are unburnt again",
        layers(MASKS, ONE, NONE)),
    ("band 3: expected burnt cells to stay burnt, got 3 that burn again",
        layers(BURNING, ONE, NONE, ONE)),
    ("expected a later time than 600, got 300", at(0, 600, 300, 900)),
    ("band 2: expected a time, got nan", at(0, float("nan"), 1200, 1800)),
    ("expected times 600 apart, like the first ones, got 1200", at(0, 600, 1200, 2400)),
    ("band 1: expected a later time than 2020-08-02 01:00:00 UTC, got 2020-08-01 00:00:00",
        lambda f: (*days(f, "hours since 2020-08-02", "hours since 2020-08-01"), *MASKS)),
    ("expected times in 'hours since 2020-08-01' (standard) as in ",
        lambda f: (*days(f, "hours since 2020-08-01", "hours since start"), *MASKS)),
    ("--every: expected only with layers without times, got 2: ",
        lambda f: (days(f, "hours", None)[0], *MASKS, "--every", 2)),
    ("expected the time of the layer, got none; leave out --unit s",
        layers(MASKS, NONE, ONE, flags=("--unit", "s"))),
    ("--unit: expected h, as in ", lambda f: (days(f, "hours", None)[0], *MASKS, "--unit", "s")),
    ("band 2: expected 0 and only one other number in all layers, 1, got 2 in row 0, column 0",
        layers(MASKS, ONE, 2 * ONE)),
    ("band 2: expected the codes 0, 1, 2, got 3 in row 0, column 0", layers(STATES, ONE, 3 * ONE)),
    ("expected times of at least 0, got -9999 in row 0, column 3; if it means never",
        arrivals(nodata=None)),
    ("--begin: applies only with --kind arrival, got --kind states",
        layers(STATES, ONE, flags=("--begin", 2))),
    ("expected cells that burn, got none", arrivals(bands=[np.full((3, 4), NEVER)])),
    ("expected a variable with the dimensions time, rows and columns, got one with member",
        lambda f: (netcdf(f / "a.nc", at=np.zeros((2, 3, 4)), times=[0, 1], over=("member", "y",
        "x")), *MASKS)),
    ("--step: too short for times up to 50, got ", arrivals("--step", "1e-310 s", dtype="int16")),
    ("--resample: no cell burns on the grid of 1 x 1 cells; use 'earliest'",
        lambda f: (stack(f, ONE, ONE), *MASKS, "--resample=nearest", "--height=1",
        "--crop=0,1,3,3")),
    ("expected at least 2 steps, got 1: all cells that burn begin in it; use a shorter --step, or",
        layers(MASKS, ONE)),
    ("--begin: expected a number in the unit of arrival times (for dates, seconds since 1970: ",
        arrivals("--begin", "2020-10-14")),
    ("--begin: expected a number", arrivals("--begin", "inf")),
    ("bytes of states, got 5000000001 steps of 3 x 4",
        arrivals(bands=[np.where(ARRIVAL < 0, NEVER, ARRIVAL * 1e9)], dtype="float64")),
    ("at most 4096 x 4096 cells, the server's maximum, got 4097 x 5463",
        arrivals("--height", 4097)),
    ("projection that gives their size, got no place on the ground; use --height",
        lambda f: (array(f, masks()), *MASKS, "--cell", 60)),
    ("--cell: cannot be combined with --height or --width",
        arrivals("--cell", 60, "--height", 3)),
    ("b.tif: expected 3 x 4 cells as in the first sequence, got 2 x 4",
        lambda f: (geotiff(f / "a.tif"), geotiff(f / "b.tif", ARRIVAL[:2]), *ARRIVALS)),
    ("b.tif: expected the projection of the first sequence, WGS 84 / UTM zone 10N, got WGS 84",
        lambda f: (geotiff(f / "a.tif"), geotiff(f / "b.tif", crs="EPSG:32611"), *ARRIVALS)),
    ("--unit: expected ms, s, min, h or d, as ", lambda f: (geotiff(f / "a.tif"), *ARRIVALS[:-2])),
    ("--burning: required with --kind arrival: the number of steps that a cell burns",
        lambda f: (geotiff(f / "a.tif"), *ARRIVALS[:4])),
    ("--step: expected a number and s, min, h or d, such as '10 min', got '10'",
        lambda f: (stack(f, ONE), "--kind", "states", "--step", "10")),
    ("--picture: expected a .png file, got ", lambda f: arrivals("--picture", f / "a.gif")(f)),
    (r"has its letters, such as LC_ALL=C.UTF-8, got '\udcff'", arrivals("--name", "\udcff")),
    ("a.tif: expected a GeoTIFF, got", lambda f: (text(f / "a.tif", "hello"), *ARRIVALS)),
]  # fmt: skip


def rotated(path: Path, *numbers: float) -> Path:
    import rasterio

    geotiff(path)
    with rasterio.open(path, "r+") as file:
        file.transform = rasterio.Affine(*numbers)
    return path


def refused(flags: Flags, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as ended:
        main([str(flag) for flag in flags])
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_broken_input_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, (words, case) in enumerate(CASES):
        out = tmp_path / "out" / "world.npz"
        line = refused((*case(folder(tmp_path / f"{number}")), "--out", out), capsys)
        assert words in line and "Traceback" not in line, line
        assert not out.parent.exists(), "nothing is written"


def test_existing_or_unwritable_output_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, file = tmp_path / "world.npz", geotiff(tmp_path / "a.tif")
    for there in (out, out.with_suffix(".toml")):
        there.write_text("mine")
        line = refused((file, *ARRIVALS, "--out", out), capsys)
        assert f"--out: {there} exists already; --force replaces it" in line
        assert there.read_text() == "mine"
        there.unlink()
    picture = tmp_path / "a.png"
    picture.write_text("mine")
    line = refused((file, *ARRIVALS, "--out", out, "--picture", picture), capsys)
    assert f"--picture: {picture} exists already; --force replaces it" in line
    line = refused((file, *ARRIVALS, "--out", tmp_path / "world.zip"), capsys)
    assert "--out: expected a .npz file, got " in line
    picture.unlink()
    assert "a.tif" in refused((file, *ARRIVALS, "--out", file / "world.npz"), capsys)
    flags = (*ARRIVALS, "--out", out, "--picture", file / "a.png")
    assert "a.tif" in refused((file, *flags), capsys)
    assert list(tmp_path.iterdir()) == [file], "nothing is written"


def test_a_missing_library_names_the_extra(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for file, name in (
        (geotiff(tmp_path / "a.tif"), "rasterio"),
        (netcdf(tmp_path / "a.nc", at=ARRIVAL), "netCDF4"),
    ):
        monkeypatch.setitem(sys.modules, name, None)
        line = refused((file, *ARRIVALS, "--out", tmp_path / "world.npz"), capsys)
        assert f"reading it needs {name}, got: " in line
        assert line.endswith("pip install emberwatch[landscape]")


@pytest.mark.parametrize("ending", [".npy", ".npz"])
def test_damaged_numpy_files_never_crash_the_reader(
    ending: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = io.BytesIO()
    np.save(whole, masks()) if ending == ".npy" else np.savez_compressed(whole, fire=masks())
    rng = np.random.default_rng(7)
    file, flags = tmp_path / f"fire{ending}", (*MASKS, "--out", tmp_path / "world.npz", "--force")
    told = set[str]()
    for _ in range(100):
        damaged = np.frombuffer(whole.getvalue(), np.uint8).copy()
        at = rng.integers(0, len(damaged), rng.integers(1, 6))
        damaged[at] = rng.integers(0, 256, len(at))
        file.write_bytes(damaged.tobytes())
        try:
            main([str(flag) for flag in (file, *flags)])
        except SystemExit as ended:
            assert ended.code == 2
            (line,) = capsys.readouterr().err.splitlines()
            told.add(line.partition("got: ")[2])
    assert len(told) > 3, told


def test_the_limits_are_documented() -> None:
    page = (Path(__file__).parents[3] / "docs/landscapes.md").read_text("utf-8")
    for words in (
        f"more than {MOST_STATES >> 30} GiB of states",
        f"a layer of more than {MOST_CELLS:,} cells",
    ):
        assert words in page
