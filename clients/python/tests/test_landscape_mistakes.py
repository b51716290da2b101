"""Common traps of fire rasters: each is read right, or refused, or reported; never read wrong."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasters import ARRIVAL, NEVER, geotiff, made, masks
from test_landscape_netcdf import FIRE, timed, written

from emberwatch.landscape.__main__ import main
from emberwatch.landscape.order import ordered

ARRIVALS = ("--kind=arrival", "--burning=2", "--step=10 min", "--unit=min")
MASKS = ("--kind=mask", "--burning=2", "--step=10 min")
DAYS = ("--kind=arrival", "--burning=2", "--step=1 d", "--unit=d")


def world(file: Path, *flags: object) -> NDArray[np.uint8]:
    out = file.with_suffix(".npz")
    main([str(flag) for flag in (file, "--out", out, "--force", *flags)])
    with np.load(out) as sequences:
        return sequences["states_000"]


def refused(capsys: pytest.CaptureFixture[str], file: Path, *flags: object) -> str:
    with pytest.raises(SystemExit):
        world(file, *flags)
    (line,) = capsys.readouterr().err.splitlines()
    return line


def with_bands(path: Path, *bands: Any, colors: str = "", names: str = "") -> Path:
    """Writes bands with these colour interpretations and descriptions."""
    geotiff(path, *bands, nodata=None)
    with rasterio.open(path, "r+") as file:
        if colors:
            file.colorinterp = [ColorInterp[color] for color in colors.split()]
        for band, name in enumerate(names.split("|") if names else (), start=1):
            file.set_band_description(band, name)
    return path


def test_an_alpha_band_says_which_cells_have_a_value(tmp_path: Path) -> None:
    alpha = np.where(ARRIVAL == NEVER, 0, 255)
    file = with_bands(tmp_path / "a.tif", ARRIVAL, alpha, colors="gray alpha")
    plain = world(geotiff(tmp_path / "b.tif"), *ARRIVALS)
    np.testing.assert_array_equal(world(file, *ARRIVALS), plain)
    assert len(world(with_bands(tmp_path / "c.tif", *masks()), *MASKS)) == 4, "no auxiliary band"


def test_other_auxiliary_bands_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    full = np.full((3, 4), 255)
    for words, colors, names in (
        ("band 3, 'alpha'; choose with --band", "gray undefined alpha", ""),
        ("band 3, 'QA'; choose with --band", "", "fire 1|fire 2|QA"),
        ("band 2, 'Data Mask'; choose", "", "fire|Data Mask|fire"),
    ):
        file = with_bands(tmp_path / "a.tif", *masks(2), full, colors=colors, names=names)
        assert f"expected bands of layers, got {words}" in refused(capsys, file, *MASKS)
    one = refused(capsys, file, *MASKS, "--band=1")
    assert "expected at least 2 steps, got 1" in one


def test_several_images_in_a_file_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = geotiff(tmp_path / "a.tif")
    geotiff(file, APPEND_SUBDATASET="YES")
    words = "expected one image, got 2 pages; make bands of them (gdal_merge.py -separate)"
    assert words in refused(capsys, file, *ARRIVALS)


@pytest.mark.parametrize(
    ("start", "unit", "apart"),
    [(1.6e9, "seconds since 1970-01-01", "128"), (26_666_666, "minutes since 1970-01-01", "120")],
)
def test_times_of_too_few_digits_are_refused(
    start: float, unit: str, apart: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times = start + np.arange(4) * (600 if unit.startswith("s") else 10)
    words = f"expected times stored to a tenth of a --step, 60, got floating-point numbers {apart}"
    file = written(tmp_path / "a.nc", **timed("f4", times, units=unit))
    assert f"{words} apart; store times in double precision" in refused(capsys, file, *MASKS)
    if unit.startswith("s"):
        seconds = np.where(ARRIVAL == NEVER, np.nan, start + 60 * ARRIVAL)
        assert words in refused(
            capsys, geotiff(tmp_path / "a.tif", seconds, nodata=None), *ARRIVALS, "--unit=s"
        )
    file = written(tmp_path / "b.nc", **timed("f8", times, units=unit))
    np.testing.assert_array_equal(world(file, *MASKS, "--burning=9"), FIRE[:4])
    days = written(tmp_path / "c.nc", **timed("f4", 44_000 + np.arange(4), units="days since 1900"))
    assert len(world(days, *MASKS, "--step=1 d")) == 4, "rounded by 6 minutes of a day"


def test_numbers_that_are_dates_are_read_as_dates(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    numbers = [20200830.5, 20200831.0, 20200831.5, 20200901.0]
    file = written(tmp_path / "a.nc", **timed("f8", numbers, units="day as %Y%m%d.%f"))
    np.testing.assert_array_equal(world(file, *MASKS, "--step=12 h", "--burning=9"), FIRE[:4])
    assert "begins at 2020-08-30 12:00:00 UTC" in (tmp_path / "a.toml").read_text()
    wrong = written(tmp_path / "b.nc", **timed("f8", [20200830, 20200831, 20200832, 20200901],
        units="day as %Y%m%d.%f"))  # fmt: skip
    assert "b.nc, time: expected days as %Y%m%d.%f, got" in refused(capsys, wrong, *MASKS)
    other = written(tmp_path / "c.nc", **timed("f8", numbers, units="month as %Y%m.%f"))
    words = "expected times in a unit, or 'day as %Y%m%d.%f', got 'month as %Y%m.%f'"
    for flags in ((), ("--unit=d",)):
        assert refused(capsys, other, *MASKS, *flags).endswith(words)


#: Names in order, and the rule by which they are ordered.
NAMES: list[tuple[str, str]] = [
    ("step_2 step_10", "the numbers"),
    ("2020-08-30 2020-08-31 2020-09-01", "the numbers"),
    ("20200830 20200831 20200901", "the numbers"),
    ("2020-08-30-12-15 2020-09-01-10-15", "the numbers"),
    ("30-08-2020 31-08-2020 01-09-2020", "the dates (day-month-year)"),
    ("fire_3_30.08.2020_1200 fire_3_30.08.2020_1300 fire_3_1.9.2020_0100", "the dates (day-m"),
    ("08302020 08312020 09012020", "the dates (month-day-year)"),
    ("30Aug2020 1Sep2020", "the dates (day-month-year)"),
    ("Aug-30-2020 Sep-01-2020", "the dates (day-month-year)"),
    ("30-08-20 31-08-20", "the dates (day-month-year)"),
    ("01-09-2020 02-09-2020", "the dates (day-month-year)"),
]


def test_files_are_in_the_order_of_the_dates_in_their_names(tmp_path: Path) -> None:
    for words, rule in NAMES:
        names = [tmp_path / f"{name}.tif" for name in words.split()]
        files, note = ordered(tmp_path, names[::-1], None)
        assert files == names, words
        assert f"{len(names)} files by {rule}" in note
        assert note.endswith(f"{names[0].name} first, {names[-1].name} last")


def test_unclear_dates_in_names_need_an_order(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    for k, name in enumerate(("12-09-2020", "01-10-2020", "02-11-2020")):
        geotiff(folder / f"{name}.tif", masks()[k], nodata=None)
    words = "--order: expected day-month or month-day, as the dates in the names in"
    assert words in refused(capsys, folder, *MASKS)
    assert len(world(folder, *MASKS, "--order=day-month")) == 3
    assert "by the dates (day-month-year)" in capsys.readouterr().out
    (folder / "last.tif").write_bytes((folder / "02-11-2020.tif").read_bytes())
    words = "last.tif: expected a date (day-month-year) in its name, as in --order, got last.tif"
    assert words in refused(capsys, folder, *MASKS, "--order=day-month")


def test_days_of_the_year_across_new_year(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = geotiff(tmp_path / "a.tif", [[364, 365], [3, 4]])
    assert len(world(file, *DAYS)) == 363
    words = "no cell begins to burn between days 4 and 364; if these are days of the year, give --"
    assert words in capsys.readouterr().out
    states = world(file, *DAYS, "--year-days=365")
    assert (states > 0).argmax(axis=0).tolist() == [[0, 1], [4, 5]]
    words = "days 3 to 4 follow New Year, and days 364 to 365"
    assert words in capsys.readouterr().out
    world(geotiff(tmp_path / "b.tif", [[200, 201], [203, 204]]), *DAYS, "--year-days=365")
    assert "New Year" not in capsys.readouterr().out
    words = "--year-days: expected days 0 to 366 in"
    other = geotiff(tmp_path / "c.tif", [[364, 400]])
    assert f"{words} {other}, got 364 to 400" in refused(capsys, other, *DAYS, "--year-days=365")
    assert "the unit min" in refused(capsys, file, *ARRIVALS, "--year-days=365")


def test_codes_below_zero_are_not_values(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    codes = np.where(ARRIVAL == NEVER, np.nan, ARRIVAL)
    codes[0, 3] = -9999
    arrival = geotiff(tmp_path / "a.tif", codes, nodata=None)
    words = "expected times of at least 0, got -9999 in row 0, column 3; if it means never, give"
    assert words in refused(capsys, arrival, *ARRIVALS, "--begin=0")
    world(arrival, *ARRIVALS, "--begin=0", "--nodata=-9999")
    mask = geotiff(tmp_path / "b.tif", *np.where(masks() == 0, 0, -9999), nodata=None)
    words = "expected 0 and a number above 0, got -9999 in row 0, column 0; if it means no value"
    assert words in refused(capsys, mask, *MASKS)
    raster = geotiff(tmp_path / "c.tif", [[1, 0], [-9999, 1]], nodata=None)
    for flags in (("--fuel", raster, "--unburnable=1"), ("--no-fly", raster)):
        with pytest.raises(SystemExit):
            made(tmp_path, *flags)
        words = "c.tif: expected numbers of at least 0, got -9999; give --nodata if it means no"
        assert words in capsys.readouterr().err
    made(tmp_path, "--fuel", raster, "--unburnable=-9999")
