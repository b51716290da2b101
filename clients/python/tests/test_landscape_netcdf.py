"""CF attributes of NetCDF variables and coordinates are applied, or refused by name."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
from pyproj import CRS
from rasters import X, Y, refused, world

#: Seconds until each cell begins to burn. The fire begins in the north-west.
ARRIVAL = np.array([[0, 60, 120, 180], [60, 120, 180, 240], [120, 180, 240, 300]], "i2")
FIRE = np.array([ARRIVAL <= 60 * k for k in range(6)], np.uint8)
FLAGS = ("--kind=arrival", "--step=1 min", "--burning=9", "--oblong")
METRES, LON, LAT = {"units": "m"}, {"units": "degrees_east"}, {"units": "degrees_north"}

Case = tuple[tuple[str, str], Any, dict[str, Any], dict[str, Any]]


def case(
    over: tuple[str, str] = ("y", "x"),
    values: Any = ARRIVAL,
    given: dict[str, Any] | None = None,
    **coordinates: Any,
) -> Case:
    return over, values, {"units": "s"} | (given or {}), coordinates


def axes(x: Any = X, y: Any = Y, **given: Any) -> dict[str, Any]:
    return {"y": ("y", y, METRES | given), "x": ("x", x, METRES | given)}


#: Files of this fire.
APPLIED: dict[str, Case] = {
    "no coordinates, from the south": case(values=ARRIVAL[::-1]),
    "coordinates": case(**axes()),
    "scale": case(values=ARRIVAL * 10, given={"scale_factor": 0.1}, **axes()),
    "columns before rows": case(("x", "y"), ARRIVAL.T, **axes()),
    "columns before rows by units": case(
        ("a", "b"), ARRIVAL.T, a=("a", np.arange(4.0), LON), b=("b", 2 - np.arange(3.0), LAT)
    ),
    "rising rows and falling columns": case(values=ARRIVAL[::-1, ::-1], **axes(X[::-1], Y[::-1])),
    "kilometres": case(**axes(X / 1000, Y / 1000, units="km")),
}


def written(path: Path, what: Case, **others: Any) -> Path:
    over, values, given, coordinates = what
    dataset = xarray.Dataset({"v": (over, values, given)}, coordinates | others)
    dataset.to_netcdf(path)
    return path


@pytest.mark.parametrize("name", APPLIED)
def test_cf_attributes_are_applied(name: str, tmp_path: Path) -> None:
    file = written(tmp_path / "a.nc", APPLIED[name])
    np.testing.assert_array_equal(world(file, *FLAGS), FIRE)


def test_a_file_in_kilometres_or_with_a_grid_mapping_is_on_the_same_grid(tmp_path: Path) -> None:
    folder = tmp_path / "fire"
    folder.mkdir()
    mapping = ((), 0, {"crs_wkt": CRS("EPSG:32610").to_wkt()})
    for k, coordinates in enumerate((axes(), axes(X / 1000, Y / 1000, units="km"))):
        mask = case(values=FIRE[2 * k], given={"grid_mapping": "crs"}, **coordinates)
        minutes = ((), [7.0, 10.0][k], {"units": "minutes since 2020-08-01"})
        written(folder / f"{k}.nc", mask, crs=mapping, time=minutes)
    states = world(folder, "--kind=mask", *FLAGS[1:], "--cell=30")
    np.testing.assert_array_equal(states, FIRE[[0, 0, 0, 2]])


def test_unsupported_attributes_are_refused_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, what in (
        ("a.nc, x: expected cells of one size side by side, got some of 30 and some of 90",
         case(**axes([15.0, 45, 75, 165]))),
        ("a.nc, x: expected cells of one size side by side, got some of nan",
         case(**axes([15, 45, np.nan, 105]))),
        ("expected a variable with the dimensions time, rows and columns, got one with level, y, x",
         case(("level", "y", "x"), FIRE[:4])),
        ("a.nc: expected cells, got an array of shape (0, 4)", case(values=ARRIVAL[:0])),
        ("a.nc: expected one variable, got 0 (none)", case(("y",), ARRIVAL[:, 0])),
        ("a.nc: expected a NetCDF file, got: ", case(given={"units": "fires since 2020-08-01"})),
        ("expected times in days or smaller units, got 'm'; give the", case(given={"units": "m"})),
    ):  # fmt: skip
        file = written(tmp_path / "a.nc", what)
        line = refused(capsys, file, *FLAGS, "--out", tmp_path / "a.npz")
        assert words in line
        assert list(tmp_path.iterdir()) == [file], "nothing is written"
