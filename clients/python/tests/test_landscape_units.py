"""Land in any unit: conversion of map units and heights to metres, and the assumptions made."""

import math
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import rasterio
from pyproj import CRS
from rasters import EASTWARD, UTM, ascii_grid, geotiff, made, netcdf
from test_landscape_netcdf import Variable, written

from emberwatch.errors import InvalidArgumentError
from emberwatch.landscape.__main__ import main
from emberwatch.landscape.compass import bearing
from emberwatch.landscape.lengths import side, unit_named
from emberwatch.model import Model

FOOT, SURVEY_FOOT = 0.3048, 1200 / 3937
#: Length of a degree in metres; a sphere is accurate to 0.2 degrees of slope.
DEGREE = 111_200.0
SECOND = 1 / 3600
LAT_60 = math.cos(math.radians(60))
SAY = "got none; give --height-unit ft"
MAY_BE_DEGREES = "no projection, and coordinates that may be degrees; give --cell METRES, or set"
SINUSOIDAL = "+proj=sinu +R=6371007.181 +units=m"


class Map(NamedTuple):
    crs: str | None
    cell: float
    """Side in units of the map."""
    corner: tuple[float, float]
    ground: tuple[float, float]
    """Width and height of a cell in metres."""
    flags: str = ""
    height: float = 1.0
    """Length of the unit of height in metres."""
    unit: str | None = None
    """Unit of heights, as the raster states it."""
    ending: str = ".tif"


M30, NEW_YORK, OREGON = (30.0, 30.0), (1e6, 2e5), (8e5, 9e5)
ARC = (DEGREE * SECOND, DEGREE * SECOND)
SECONDS_60 = (ARC[0] * LAT_60, ARC[1])
MERCATOR_60 = (1.6e6, 8.4e6 - 2e4)

SLOPES: dict[str, Map] = {
    "metres": Map(UTM, 30, (5e5, 4e6), M30),
    "US survey feet by projection": Map("EPSG:2263", 100, NEW_YORK, (30.48, 30.48),
        "--height-unit us-ft", SURVEY_FOOT),
    "US survey feet by flags": Map(None, 100, NEW_YORK, (30.48, 30.48),
        "--cell 100us-ft --height-unit us-ft", SURVEY_FOOT),
    "international feet, in a file beside an ASCII grid": Map("EPSG:2992", 100, OREGON,
        (30.48, 30.48), "--height-unit ft", FOOT, ending=".asc"),
    "metres, heights in feet by projection": Map("EPSG:32610+8228", 30, (5e5, 4e6), M30, "", FOOT,
        ending=".asc"),
    "metres, heights in feet by flag against the band": Map(UTM, 30, (5e5, 4e6), M30,
        "--height-unit ft", FOOT, "metre"),
    "degrees at 60 N": Map("EPSG:4326", SECOND, (10, 60), SECONDS_60, "--oblong"),
    "degrees of no projection": Map(None, SECOND, (-120, 38), M30, "--cell 30"),
    "Web Mercator at 60 N": Map("EPSG:3857", 60, MERCATOR_60, M30),
    # Widths shrink by cos(60) / cos(30), and heights grow by the same factor.
    "equal areas at 60 N": Map("EPSG:6933", 30, (1e6, 6.33e6),
        (30 / 3**-0.5 * 3**-1.0, 30 * 3**0.5), "--oblong"),
}  # fmt: skip


def raster(path: Path, place: Map) -> Path:
    """Writes a raster of heights that rise by 10 degrees to the north-east."""
    rows, columns = np.indices((12, 12))
    east, north = columns * place.ground[0], -rows * place.ground[1]
    metres = (0.6 * east + 0.8 * north) * math.tan(math.radians(10))
    heights = (metres + 500) / place.height
    file = path.with_suffix(place.ending)
    if place.ending == ".tif":
        cell = place.cell, place.cell
        geotiff(file, heights, crs=place.crs, corner=place.corner, cell=cell)
    else:
        x, y = place.corner[0], place.corner[1] - 12 * place.cell
        ascii_grid(file, heights, side=f"cellsize {place.cell:.15g}")
        text = file.read_text().replace("xllcorner 0", f"xllcorner {x:.12f}")
        file.write_text(text.replace("yllcorner 0", f"yllcorner {y:.12f}"))
        if place.crs is not None:
            file.with_suffix(".prj").write_text(CRS(place.crs).to_wkt("WKT1_GDAL"))
    if place.unit is not None:
        with rasterio.open(file, "r+") as opened:
            opened.units = (place.unit,)
    return file


@pytest.mark.parametrize("case", SLOPES)
def test_a_slope_is_the_same_in_every_unit_and_projection(case: str, tmp_path: Path) -> None:
    place = SLOPES[case]
    file = raster(tmp_path / "dem", place)
    made(tmp_path, file, *place.flags.split())
    factors = Model.named(tmp_path / "new" / "land.toml").maps["slope_wind"]
    # Degrees up from the neighbour in the west, and from the one in the south.
    for row, col, share in ((1, 0, 0.6), (2, 1, 0.8)):
        expected = math.degrees(math.atan(share * math.tan(math.radians(10))))
        assert np.log(factors[row, col]) / 0.078 == pytest.approx(expected, abs=0.2)


def notes(capsys: pytest.CaptureFixture[str]) -> str:
    return capsys.readouterr().out


def refused(capsys: pytest.CaptureFixture[str], folder: Path, *flags: object) -> str:
    with pytest.raises(SystemExit):
        made(folder, *flags)
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_assumed_units_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assumed = "heights in metres (assumed, as the raster names no unit; --height-unit sets it)"
    model, dem = tmp_path / "new" / "land.toml", geotiff(tmp_path / "dem.tif", EASTWARD)
    made(tmp_path, dem)
    assert assumed in notes(capsys) and f"# {assumed}" in model.read_text()
    for unit, words in (("ft", "international feet"), ("US survey foot", "US survey feet")):
        with rasterio.open(dem, "r+") as file:
            file.units = (unit,)
        made(tmp_path, dem)
        assert f"heights in {words} (from the raster)" in notes(capsys)
    made(tmp_path, dem, "--height-unit=cm")
    words = "heights in centimetres (from --height-unit instead of the raster's US survey feet)"
    assert words in notes(capsys)
    made(tmp_path, netcdf(tmp_path / "dem.nc", z=EASTWARD, unit="1"))
    assert assumed in notes(capsys)
    made(tmp_path, geotiff(tmp_path / "no.tif", EASTWARD, crs=None))
    words = "cells of 30 x 30 metres, as the raster names no other unit (--cell sets the size); st"
    assert words in notes(capsys)


#: Georeferences of rasters, flags, and words of the error.
NO_PLACE: list[tuple[dict[str, Any], str, str]] = [
    *(
        ({"crs": crs, "cell": (100, 100)}, flags, f"a unit of heights, as cells are in feet, {SAY}")
        for crs, flags in (
            ("EPSG:2263", ""),
            ('LOCAL_CS["mine",UNIT["foot",0.3048]]', ""),
            (None, "--cell=100ft"),
        )
    ),
    *(
        ({"crs": None, "corner": corner, "cell": (cell, cell)}, "", MAY_BE_DEGREES)
        for corner, cell in (((-120, 38), SECOND), ((179.9, -16), 0.1), ((0, 91), 0.5))
    ),
    # Far from the central meridian, as in California, rows are not perpendicular to columns.
    ({"crs": SINUSOIDAL, "corner": (-1e7, 4e6)}, "",
        "dem.tif: expected square cells, got rows and columns at 139 degrees; reproject it"),
    ({"crs": "EPSG:4326", "corner": (0, 900), "cell": (1, 1)}, "",
        "projection WGS 84: expected cells on the Earth, got one at 2.5, 898"),
]  # fmt: skip


def test_cells_of_unknown_size_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for place, flags, words in NO_PLACE:
        dem = geotiff(tmp_path / "dem.tif", EASTWARD, **place)
        assert words in refused(capsys, tmp_path, dem, *flags.split())
    degrees = {"crs": None, "corner": (-120, 38), "cell": (SECOND, SECOND)}
    fire = geotiff(tmp_path / "fire.tif", **degrees)
    flags = "--kind=arrival --unit=min --burning=2 --cell=60".split()
    with pytest.raises(SystemExit):
        main([str(fire), *flags, "--step=10 min", "--out", str(tmp_path / "fire.npz")])
    assert "coordinates that may be degrees; use --height" in capsys.readouterr().err
    place = {"crs": "EPSG:3857", "corner": (0, 9e6), "cell": (20_000, 20_000)}
    mercator = geotiff(tmp_path / "web.tif", np.zeros((40, 40)), **place)
    words = "web.tif: expected cells of one size on the ground, got "
    assert words in refused(capsys, tmp_path, mercator)
    made(tmp_path, mercator, "--oblong")


def test_a_grid_turned_from_true_north_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made(tmp_path, geotiff(tmp_path / "c.tif", EASTWARD, crs="EPSG:3979", corner=(-2e6, 8e5)))
    assert "the grid's north is 27 degrees west of true north" in notes(capsys)
    made(tmp_path, geotiff(tmp_path / "utm.tif", EASTWARD, corner=(3e5, 4e6)))
    assert "north" not in notes(capsys)


def test_the_wind_can_be_given_as_a_compass_point(tmp_path: Path) -> None:
    words = {"N": 270, "wsw": 22.5, "north-west": 315, "South South East": 112.5, "250": 20}
    for comes_from, towards in words.items():
        assert bearing(comes_from) == (270 - towards) % 360
    dem, wind = geotiff(tmp_path / "dem.tif", EASTWARD), "--wind-speed=5"
    models = [made(tmp_path, dem, wind, it) for it in ("--wind-from=wsw", "--wind-towards=22.5")]
    assert models[0] == models[1]


def test_common_spellings_of_units_are_known() -> None:
    for unit, spellings in {
        "m": "m Meter metres",
        "ft": "foot Feet",
        "us-ft": "US_survey_foot ftUS",
    }.items():
        assert all(unit_named(spelling) == unit for spelling in spellings.split())
    for word in ("", "1", "ms", "m s-1", "m2 s-2", "furlong", "s", "min", "K"):
        assert unit_named(word) is None, word
    assert side("--cell", "98.4 ft").metres == 98.4 * FOOT
    assert side("--cell", "1e2us-ft") == (100 * SURVEY_FOOT, "us-ft")
    for text in ("ft", "-3", "nan", "inf", "0", "3 4", "1e999"):
        with pytest.raises(InvalidArgumentError, match="expected at least 0.001 metres, such as"):
            side("--cell", text)


def mapped(path: Path, unit: str, factor: float, corner: tuple[float, float], **mapping: Any):
    """Writes heights on cells of 60 map units, with coordinates in units of `factor` map units."""
    x, y = (corner[0] + np.arange(5) * 60) / factor, (corner[1] - np.arange(4) * 60) / factor
    x = Variable(x, "f8", ("x",), {"standard_name": "projection_x_coordinate", "units": unit})
    y = Variable(y, "f8", ("y",), {"standard_name": "projection_y_coordinate", "units": unit})
    z = Variable(EASTWARD, "f8", ("y", "x"), {"units": "m", "grid_mapping": "crs"})
    return written(path, x=x, y=y, z=z, crs=Variable(0, "i4", (), mapping))


def test_a_grid_mapping_sets_the_size_of_netcdf_cells(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mercator = {"grid_mapping_name": "mercator", "standard_parallel": 0.0}
    mercator |= {"longitude_of_projection_origin": 0.0}
    feet = {"crs_wkt": CRS("EPSG:2263").to_wkt()}
    for unit, factor, corner, mapping, size in (
        ("m", 1.0, (1.6e6, 8.3625e6), mercator, 30.0),
        ("km", 1e3, (1.6e6, 8.3625e6), mercator, 30.0),
        ("m", 1.0, (3e5, 6e4), feet, 60.0),
        ("US_survey_foot", 1.0, NEW_YORK, feet, 60 * SURVEY_FOOT),
        ("", 1.0, NEW_YORK, feet, 60 * SURVEY_FOOT),
    ):
        file = mapped(tmp_path / "dem.nc", unit, factor, corner, **mapping)
        made(tmp_path, file)
        cells = re.search(r"cells of (\S+) x (\S+) metres on the ground", notes(capsys))
        assert cells is not None
        assert [float(one) for one in cells.groups()] == pytest.approx([size] * 2, rel=5e-3)
    file = mapped(tmp_path / "dem.nc", "m", 1.0, NEW_YORK, crs_wkt=CRS("EPSG:4326").to_wkt())
    words = "expected coordinates in degrees, as its grid mapping or columns, got metres"
    assert words in refused(capsys, tmp_path, file)
    file = mapped(tmp_path / "dem.nc", "m", 1.0, NEW_YORK, grid_mapping_name="mine")
    words = "expected a grid mapping of CF, got Unsupported grid mapping name: mine"
    assert words in refused(capsys, tmp_path, file)
