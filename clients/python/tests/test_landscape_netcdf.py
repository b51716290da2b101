"""CF attributes of NetCDF variables and coordinates are applied, or refused by name."""

from pathlib import Path
from typing import Any, NamedTuple

import netCDF4
import numpy as np
import pytest
import rasterio
from numpy.typing import ArrayLike, NDArray
from rasters import geotiff

from emberwatch.landscape.__main__ import main

#: Seconds until each cell begins to burn. The fire begins in the north-west.
ARRIVAL = np.array([[0, 60, 120, 180], [60, 120, 180, 240], [120, 180, 240, 300]])
MASKS = np.array([ARRIVAL <= 60 * k for k in range(4)], "u1")
KIND = {2: ("--kind=arrival",), 3: ("--kind=mask",)}


class Variable(NamedTuple):
    values: ArrayLike
    kind: str
    over: tuple[str, ...] = ()
    given: dict[str, Any] = {}  # noqa: RUF012

    def told(self, **given: Any) -> "Variable":
        return self._replace(given=self.given | given)


X = Variable(500_015 + 30.0 * np.arange(4), "f8", ("x",), {"units": "m", "axis": "X"})
Y = Variable(4_000_075 - 30.0 * np.arange(3), "f8", ("y",), {"units": "m", "axis": "Y"})
AXES = {"y": Y, "x": X}
LON = Variable(0.1 * np.arange(4) - 0.1, "f8", ("lon",), {"units": "degrees_east"})
LAT = Variable(0.2 - 0.1 * np.arange(3), "f8", ("lat",), {"units": "degrees_north"})
TIME = Variable(np.arange(4.0), "f8", ("time",), {"units": "minutes since 2020-08-01"})
TIMES = Variable(MASKS, "u1", ("time", "y", "x"))
ONE = Variable(ARRIVAL, "i2", ("y", "x"), {"units": "s"})


def written(path: Path, group: str = "", /, **variables: Variable) -> Path:
    """Writes a file of these variables, in a group. Dimensions have the size of their variables."""
    with netCDF4.Dataset(path, "w") as root:
        file = root.createGroup(group) if group else root
        for name, (values, kind, over, given) in variables.items():
            values = np.asarray(values)
            for dimension, size in zip(over, values.shape, strict=True):
                if dimension not in root.dimensions:
                    root.createDimension(dimension, size)
            fill = given.get("_FillValue")
            variable = file.createVariable(name.replace("__", ":"), kind, over, fill_value=fill)
            variable.set_auto_maskandscale(False)
            variable.setncatts({key: told for key, told in given.items() if key != "_FillValue"})
            variable[...] = values
    return path


def imported(file: Path, n_dimensions: int, *flags: str) -> NDArray[np.uint8]:
    out = file.with_suffix(".npz")
    burning = () if "--kind=states" in flags else ("--burning=9",)
    kind = () if "--kind=states" in flags else KIND[n_dimensions]
    main([str(file), *kind, "--step=1 min", *burning, f"--out={out}", "--force", *flags])
    with np.load(out) as world:
        return world["states_000"]


def steps(arrival: NDArray[Any]) -> NDArray[np.uint8]:
    """Returns the states for these arrival times, of which -1 means never."""
    n_steps = int(arrival.max()) // 60 + 1
    return np.array([(arrival >= 0) & (arrival <= 60 * k) for k in range(n_steps)], np.uint8)


FIRE = steps(ARRIVAL)
WITHOUT_FIRST = steps(np.where(ARRIVAL < 60, -1, ARRIVAL - 60))
WITHOUT_LAST = steps(np.where(ARRIVAL > 240, -1, ARRIVAL))

Variables = dict[str, Variable]


def grid(variable: Variable, **coordinates: Variable) -> Variables:
    return {**AXES, **coordinates, "v": variable}


def numbers(values: ArrayLike, **given: Any) -> Variables:
    return grid(ONE._replace(values=values).told(**given))


def packed(**given: Any) -> Variables:
    return numbers(ARRIVAL * 10, scale_factor=0.1, **given)


def timed(kind: str, values: ArrayLike, **given: Any) -> Variables:
    return grid(TIMES, time=TIME._replace(kind=kind, values=values).told(**given))


#: Contents of a file, and the states of its fire.
APPLIED: dict[str, tuple[Variables, NDArray[np.uint8]]] = {
    "nothing": (grid(ONE), FIRE),
    # Numbers.
    "scale": (packed(), FIRE),
    "limit as packed": (packed(valid_max=np.int16(2400)), WITHOUT_LAST),
    "limit as unpacked": (packed(valid_max=1500.0), FIRE),
    # Time.
    "time": (timed("f8", [0, 1, 2, 3]), FIRE[:4]),
    "both of time": (timed("i1", [0, 1, 2, 3], scale_factor=1 / 60, add_offset=5.0, units="hours"),
        FIRE[:4]),
    "nanoseconds": (
        timed("i8", np.array([0, 1, 3, 4]) * 60 * 10**9, units="nanoseconds since 2020-08-01"),
        FIRE[[0, 1, 1, 2, 3]]),
    "time beside its dimension": (
        grid(TIMES._replace(over=("n", "y", "x")).told(coordinates="when"),
        when=TIME._replace(values=[0, 60_000, 180_000, 240_000], over=("n",)).told(units="msec")),
        FIRE[[0, 1, 1, 2, 3]]),
    # Axes.
    "columns before rows": (grid(ONE._replace(values=ARRIVAL.T, over=("x", "y"))), FIRE),
    "columns before rows by units": (
        {"a": LON._replace(over=("a",)), "b": LAT._replace(over=("b",)),
        "v": ONE._replace(values=ARRIVAL.T, over=("a", "b"))}, FIRE),
    "time last": (
        grid(TIMES._replace(values=np.moveaxis(MASKS, 0, 2), over=("y", "x", "time")), time=TIME),
        FIRE[:4]),
    "rising rows and falling columns": (
        grid(ONE._replace(values=ARRIVAL[::-1, ::-1]),
        **{name: it._replace(values=np.asarray(it.values)[::-1]) for name, it in AXES.items()}),
        FIRE),
    "packed coordinates": (
        grid(ONE, x=Variable([0, 1, 2, 3], "i2", ("x",), {**X.given, "scale_factor": 30.0})), FIRE),
    "kilometres": (grid(ONE, x=X._replace(values=np.asarray(X.values) / 1000).told(units="km")),
        FIRE),
    "longitudes across 360": (
        {"lat": LAT, "lon": LON._replace(values=np.asarray(LON.values) % 360),
        "v": ONE._replace(over=("lat", "lon"))}, FIRE),
}  # fmt: skip


@pytest.mark.parametrize("case", APPLIED)
def test_cf_attributes_are_applied(case: str, tmp_path: Path) -> None:
    variables, expected = APPLIED[case]
    file = written(tmp_path / "fire.nc", **variables)
    states = imported(file, len(variables["v"].over), "--oblong")
    np.testing.assert_array_equal(states, expected)


def test_any_file_name_can_be_read(tmp_path: Path) -> None:
    for name in ('a"b', "a'b", "a:b", "a#b", "a b"):
        file = written(tmp_path / "plain.nc", **grid(ONE)).rename(tmp_path / f"{name}.nc")
        np.testing.assert_array_equal(imported(file, 2, "--name=fire"), FIRE)


def test_variable_names_may_have_colons_and_groups(tmp_path: Path) -> None:
    other = ONE._replace(values=ARRIVAL * 2)
    file = written(tmp_path / "a.nc", y=Y, x=X, at__s=ONE, other=other)
    np.testing.assert_array_equal(imported(file, 2, "--variable=at:s"), FIRE)
    file = written(tmp_path / "b.nc", **grid(ONE))
    with netCDF4.Dataset(file, "a") as root:
        inner = root.createVariable("model/run:1/at", "i2", ("x", "y"))
        inner[:], inner.units = 2 * ARRIVAL.T, "s"
    assert len(imported(file, 2, "--variable=v")) == 6
    doubled = imported(file, 2, "--variable=model/run:1/at")
    np.testing.assert_array_equal(doubled > 0, steps(2 * ARRIVAL) > 0)


def layer_files(folder: Path, first: Variables, second: Variables) -> NDArray[np.uint8]:
    (folder / "fire").mkdir()
    for k, variables in enumerate((first, second)):
        mask = Variable(MASKS[2 * k], "u1", ("y", "x"), variables.pop("v").given)
        written(folder / "fire" / f"{k}.nc", **variables, v=mask)
    return imported(folder / "fire", 3, "--oblong")


def test_scalar_times_apply_to_layers(tmp_path: Path) -> None:
    mask = ONE._replace(given={"coordinates": "run when"})
    files = [
        grid(
            mask,
            run=Variable(0, "f8", (), {"standard_name": "forecast_reference_time", "units": "h"}),
            when=Variable(minutes, "f8", (), TIME.given),
        )
        for minutes in (7, 10)
    ]
    np.testing.assert_array_equal(layer_files(tmp_path, *files), MASKS[[0, 0, 0, 2]])


def test_longitudes_of_0_to_360_degrees_are_wrapped(tmp_path: Path) -> None:
    west, east = (
        {
            "y": Variable(LAT.values, "f8", ("y",), LAT.given),
            "x": Variable(np.asarray(LON.values) + shift, "f8", ("x",), LON.given),
            "v": ONE,
        }
        for shift in (-120, 240)
    )
    np.testing.assert_array_equal(layer_files(tmp_path, west, east), MASKS[[0, 2]])


def test_a_grid_mapping_is_the_projection(tmp_path: Path) -> None:
    folder = tmp_path / "both"
    folder.mkdir()
    place = {"corner": (500_000, 4_000_090)}
    wkt = rasterio.open(geotiff(folder / "0.tif", MASKS[0], nodata=None, **place)).crs.to_wkt()
    mapping = Variable(0, "i4", (), {"grid_mapping_name": "transverse_mercator", "crs_wkt": wkt})
    mask = Variable(MASKS[2], "u1", ("y", "x"), {"grid_mapping": "crs"})
    written(folder / "1.nc", **grid(mask), crs=mapping)
    np.testing.assert_array_equal(imported(folder, 3), MASKS[[0, 2]])


CURVED = Variable(np.zeros((3, 4)), "f8", ("y", "x"), {"units": "degrees_north"})

#: Words of the error, contents of the file, and flags.
REFUSED: list[tuple[Any, ...]] = [
    ("a.nc, x: expected cells of one size side by side, got some of 30 and some of 90",
        grid(ONE, x=X._replace(values=[15, 45, 75, 165]))),
    ("a.nc, x: expected cells of one size side by side, got some of nan",
        grid(ONE, x=X._replace(values=[15, 45, -1, 105]).told(missing_value=-1.0))),
    ("a.nc, x: expected cells of one size side by side, got some of 30 and some of inf",
        grid(ONE, x=X._replace(values=[-np.inf, 45, 75, np.inf]))),
    ("a.nc, x, units: expected degrees, m, km or feet, got 'furlongs'",
        grid(ONE, x=X.told(units="furlongs"))),
    ("a.nc, Lat, units: expected degrees, m, km or feet, got ''",
        {"Lat": Variable(LAT.values, "f8", ("Lat",)), "lon": LON, "v": ONE._replace(over=("Lat",
        "lon"))}),
    ("a.nc: expected coordinates in degrees, as its grid mapping or columns, got metres",
        grid(ONE, x=X.told(units="degrees_east"))),
    ("a.nc: expected a variable with the dimensions time, rows and columns, got one with y, x",
        grid(ONE, y=Y.told(axis="X"))),
    ("a.nc, y: expected one axis, got X and Y", grid(ONE, y=Y.told(standard_name="longitude"))),
    ("a.nc: expected a variable with the dimensions time, rows and columns, got one with z",
        grid(TIMES._replace(over=("z", "y", "x")), z=Variable(np.arange(4), "f8", ("z",),
        {"axis": "Z"}))),
    ("a.nc: expected coordinates with one dimension, got lat with y, x; reproject it",
        {"lat": CURVED, "v": ONE.told(coordinates="lat lon")}),
    ("a.nc: expected real numbers, got uint8 (0, 3, 4)",
        {"v": Variable(np.zeros((0, 3, 4)), "u1", ("time", "y", "x"))}),
    ("a.nc, v, valid_range: expected two numbers, got 3",
        grid(ONE.told(valid_range=np.int16(3)))),
    ("expected times in days or smaller units, got 'months since 2020-08-01'; give the",
        timed("f8", [0, 1, 2, 3], units="months since 2020-08-01")),
    ("a.nc, band 3: expected a time, got nan", timed("f8", [0, 1, -1, 3], missing_value=-1.0)),
    ("a.nc, time: expected no climatology, got 'edges'",
        timed("f8", [0, 1, 2, 3], climatology="edges")
        | {"edges": Variable(np.zeros((4, 2)), "f8", ("time", "two"))}),
]  # fmt: skip


def test_unsupported_attributes_are_refused_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, variables, *flags in REFUSED:
        file = written(tmp_path / "a.nc", **variables)
        with pytest.raises(SystemExit):
            imported(file, len(variables["v"].over), *(flags[0] if flags else ()))
        (line,) = capsys.readouterr().err.splitlines()
        assert words in line
        assert list(tmp_path.iterdir()) == [file], "nothing is written"
