"""Rasters of fires become recorded worlds: each format, kind and grid yields the same fire."""

import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray
from numpy.typing import NDArray
from pyproj import CRS
from rasters import (
    ARRIVAL,
    NEVER,
    UTM,
    X,
    Y,
    ascii_grid,
    changed,
    geotiff,
    masks,
    netcdf,
    world,
    worlds,
)

from emberwatch.landscape.__main__ import main
from emberwatch.landscape.inputs import stacks

ROOT = Path(__file__).parents[3]
STEP = ("--step", "10 min")
ARRIVALS = ("--kind", "arrival", *STEP, "--burning", "2")
MINUTES = (*ARRIVALS, "--unit", "min")
MASKS = ("--kind", "mask", *STEP, "--burning", "2")
STATES = ("--kind", "states", *STEP)
#: The first 10-minute step that shows each cell burning: step 4 for an arrival at 35 minutes.
BEGIN = np.where(ARRIVAL == NEVER, 99, np.ceil(ARRIVAL / 10))
#: The states of all six steps, in which a cell burns for two steps.
FIRE = np.array([(BEGIN <= k) + (BEGIN + 2 <= k).astype(int) for k in range(6)], np.uint8)


def with_never(value: float, scale: float = 1) -> NDArray[np.float64]:
    return np.where(ARRIVAL == NEVER, value, ARRIVAL * scale)


def same_arrivals(f: Path) -> list[tuple[object, ...]]:
    np.save(f / "fire.npy", with_never(np.nan))
    np.savez(f / "fire.npz", fire=with_never(np.nan), other=np.zeros(3))
    minutes = ("--unit", "min")
    scaled = geotiff(f / "scaled.tif", with_never(NEVER, 0.2) + 2 * (ARRIVAL != NEVER))
    files: list[tuple[object, ...]] = [
        (geotiff(f / "fire.tif"), *minutes),
        (geotiff(f / "inf.tif", with_never(np.inf)), *minutes),
        (ascii_grid(f / "fire.asc"), *minutes),
        (ascii_grid(f / "oblong.asc", side="dx 30\ndy 40"), *minutes, "--oblong"),
        (netcdf(f / "fire.nc"),),
        (netcdf(f / "hours.nc", with_never(NEVER, 1 / 60), "hours"),),
        (netcdf(f / "packed.nc", with_never(NEVER, 8), scale=0.125),),
        (netcdf(f / "dates.nc", with_never(np.nan), "minutes since 2020-08-01"),),
        (f / "fire.npy", *minutes),
        (f / "fire.npz", *minutes, "--variable", "fire"),
        (changed(scaled, scales=[5.0], offsets=[-10.0]), *minutes),
        # The first step is that of the earliest arrival.
        (geotiff(f / "later.tif", with_never(NEVER) + 1234 * (ARRIVAL != NEVER)), *minutes),
        (geotiff(f / "none.tif", nodata=None), *minutes, "--nodata", -1, "--nodata", NEVER),
        (geotiff(f / "low.tif", with_never(-9999.9), nodata=None), *minutes, "--nodata=-9999.9"),
    ]
    for values, numbers in (  # rotations caused by rounding
        (ARRIVAL, (30, 6e-17, 500_000, 6e-17, -30, 4_000_000)),
        (ARRIVAL[::-1, ::-1], (-30, 4e-15, 500_000, 4e-15, 30, 4_000_000)),
    ):
        file = geotiff(f / f"{len(files)}.tif", values)
        files.append((changed(file, transform=rasterio.Affine(*numbers)), *minutes))
    return files


def test_arrival_times_do_not_depend_on_the_format(tmp_path: Path) -> None:
    for file, *flags in same_arrivals(tmp_path):
        np.testing.assert_array_equal(world(file, *ARRIVALS, *flags), FIRE, str(file))


def test_rows_run_from_the_north_and_columns_from_the_west(tmp_path: Path) -> None:
    east, south = 500_000 + 4 * 30, 4_000_000 - 3 * 30
    for values, corner, cell in (
        (ARRIVAL[:, ::-1], (east, 4_000_000), (-30, 30)),
        (ARRIVAL[::-1], (500_000, south), (30, -30)),
        (ARRIVAL[::-1, ::-1], (east, south), (-30, -30)),
    ):
        file = geotiff(tmp_path / "fire.tif", values, corner=corner, cell=cell)
        np.testing.assert_array_equal(world(file, *MINUTES), FIRE)


def test_each_arrival_file_or_layer_folder_is_a_sequence(tmp_path: Path) -> None:
    files = geotiff(tmp_path / "b.tif"), geotiff(tmp_path / "a.tif", with_never(NEVER, 2))
    first, other = worlds(*files, *MINUTES)
    np.testing.assert_array_equal(first, FIRE)
    assert other.shape == (11, 3, 4)
    for name, n_layers in (("a", 3), ("b", 4)):
        (tmp_path / name).mkdir()
        geotiff(tmp_path / name / "fire.tif", *masks(n_layers), nodata=None)
    first, second = worlds(tmp_path / "a", tmp_path / "b", *MASKS)
    np.testing.assert_array_equal(first, FIRE[:3])
    np.testing.assert_array_equal(second, FIRE[:4])


def test_masks_from_files_bands_and_times_are_equal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layers, folder = masks(), tmp_path / "folder"
    folder.mkdir()
    for k, layer in enumerate(layers):
        geotiff(folder / f"step_{k + 8}.tif", layer, nodata=None)
    (folder / "step_9.tif.aux.xml").write_text("not a layer")
    assert [
        file.stem[5:] for file in stacks([folder], one_file_each=False)[0]
    ] == "8 9 10 11".split()
    for given in (
        (folder,),
        (geotiff(tmp_path / "bands.tif", *layers * 255, nodata=None),),
        (geotiff(tmp_path / "zero.tif", *layers, nodata=0),),
        (netcdf(tmp_path / "fire.nc", layers, times=[0, 600, 1200, 1800]),),
    ):
        np.testing.assert_array_equal(world(*given, *MASKS), FIRE[:4], str(given[0]))
    told = capsys.readouterr().out
    assert f"4 files in this order: {folder / 'step_8.tif'} to {folder / 'step_11.tif'}" in told
    n_missing = np.count_nonzero(layers == 0)
    assert f"zero.tif, band 1: {n_missing} cells of layers have no value, and count as" in told


def test_burning_masks_and_codes_show_burnt_cells(tmp_path: Path) -> None:
    burning = geotiff(tmp_path / "burning.tif", *(FIRE == 1), nodata=None)
    np.testing.assert_array_equal(world(burning, "--kind", "burning", *STEP), FIRE)
    codes = np.array([7, 3, 5], np.uint8)[FIRE]
    file = geotiff(tmp_path / "codes.tif", *codes, nodata=None)
    np.testing.assert_array_equal(world(file, *STATES, "--codes", "7,3,5"), FIRE)


def test_a_step_shows_the_last_layer_at_or_before_its_time(tmp_path: Path) -> None:
    states = np.zeros((4, 3, 4), np.uint8)
    for k in range(1, 4):
        states[k:, 0, k] = 1
    cases: list[tuple[list[float], str, tuple[object, ...], list[int]]] = [
        ([0, 10, 20, 30], "minutes since 2020-08-01", ("--step", "20 min"), [0, 2, 3]),
        ([0, 10, 20, 30], "minutes", ("--step", "15 min"), [0, 1, 3]),
        ([0, 10, 20, 30], "min", ("--step", "1 h"), [0, 3]),
        ([0, 10, 20, 30], "minutes", ("--step", "5 min"), [0, 0, 1, 1, 2, 2, 3]),
        ([600, 1200, 3000, 3600], "seconds", ("--step", "10 min"), [0, 1, 1, 1, 2, 3]),
        ([7, 7.3333, 7.6667, 9], "hours", ("--step", "20 min"), [0, 1, 2, 2, 2, 2, 3]),
        ([0, 600, 1800, 2400], "", ("--step", "10 min", "--unit", "s"), [0, 1, 1, 2, 3]),
        ([0, 10, 30, 35], "", ("--step", "7 d"), [0, 1, 2, 3]),
    ]
    for times, unit, flags, shown in cases:
        file = netcdf(tmp_path / "fire.nc", states, times=times, time_unit=unit)
        got = world(file, "--kind", "states", *flags)
        np.testing.assert_array_equal(got, states[shown], str((times, unit, flags)))


def test_files_with_different_reference_dates_are_ordered(tmp_path: Path) -> None:
    folder = tmp_path / "days"
    folder.mkdir()
    for day, part in ((1, FIRE[:2]), (2, FIRE[2:4])):
        unit = f"hours since 2020-08-0{day} 00:00:00"
        netcdf(folder / f"{day}.nc", part, times=[0, 12], time_unit=unit)
    np.testing.assert_array_equal(world(folder, *STATES, "--step", "12 h"), FIRE[:4])


def test_the_description_states_when_a_sequence_begins(tmp_path: Path) -> None:
    for unit, begin in (
        ("minutes since 2020-08-01 12:00 -07:00", "2020-08-01 20:30:00 UTC"),
        ("minutes", None),
    ):
        file = netcdf(tmp_path / "a.nc", masks(), times=[90, 100, 110, 120], time_unit=unit)
        later = netcdf(
            tmp_path / "b.nc", ARRIVAL + 5 * (ARRIVAL != NEVER), "minutes since 2020-08-01"
        )
        world(file, *MASKS)
        text = (tmp_path / "new" / "world.toml").read_text("utf-8")
        expected = [] if begin is None else [f"# states_000 begins at {begin}"]
        assert re.findall("(?m)^# .*", text) == expected
    worlds(netcdf(tmp_path / "a.nc"), later, *ARRIVALS)
    text = (tmp_path / "new" / "world.toml").read_text("utf-8")
    assert re.findall("(?m)^# .*", text) == ["# states_001 begins at 2020-08-01 00:05:00 UTC"]


def test_sequences_may_differ_in_place_and_in_the_size_of_cells(tmp_path: Path) -> None:
    first = geotiff(tmp_path / "a.tif")
    other = geotiff(tmp_path / "b.tif", cell=(60, 60), crs="EPSG:32611")
    doubled = ARRIVAL.repeat(2, axis=0).repeat(2, axis=1)
    small = geotiff(tmp_path / "c.tif", doubled, cell=(15, 15), corner=(100_000, 3_000_000))
    for states in (*worlds(first, other, *MINUTES), *worlds(first, small, *MINUTES, "--cell", 30)):
        np.testing.assert_array_equal(states, FIRE)


def test_a_larger_cell_burns_while_any_input_cell_does(tmp_path: Path) -> None:
    states = np.zeros((5, 6, 8), np.uint8)
    states[1:, 0, 0], states[3:, 0, 0] = 1, 2  # burns in steps 1 and 2
    states[2:, 1, 1], states[4:, 1, 1] = 1, 2  # burns in steps 2 and 3
    file = geotiff(tmp_path / "fire.tif", *states, nodata=None)
    for flags in (("--height", 3), ("--cell", 60)):
        small = world(file, *STATES, *flags)
        assert small.shape == (5, 3, 4)
        assert small[:, 0, 0].tolist() == [0, 1, 1, 1, 2]
        assert not small[:, 1:].any() and not small[:, :, 1:].any()
    large = world(file, *STATES, "--height", 12)
    np.testing.assert_array_equal(large, states.repeat(2, axis=1).repeat(2, axis=2))


def test_the_output_is_described_and_summarized(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / 'fire "\U0001f525" \\ \x7f.npz'
    main([str(flag) for flag in (geotiff(tmp_path / "f.tif"), *MINUTES, "--out", out)])
    text = tomllib.loads(out.with_suffix(".toml").read_text("utf-8"))
    assert text.keys() == {"name", "step", "states", "observations"}
    assert (text["name"], text["step"]) == (out.stem, "10 min")
    names = ["unburnt", "burning", "burnt"]
    assert [state["name"] for state in text["states"]] == names
    assert [observation["name"] for observation in text["observations"]] == names
    assert [state["reward"] for state in text["states"]] == [0, 1, 0]
    for number, state in enumerate(text["states"]):
        assert np.argmax(state["observed_as"]) == number
        assert sum(state["observed_as"]) == pytest.approx(1)
    words = "6 steps of 3 x 4 cells: at most 4 burn, at step 2; 75.0 % have burnt at the end"
    assert words in capsys.readouterr().out


def test_the_documents_list_the_flags_of_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    for words, name, end in (
        ([], "landscapes", "## Perimeters"),
        (["land"], "land", "## Slope and wind"),
    ):
        page = (ROOT / "docs" / f"{name}.md").read_text("utf-8")
        with pytest.raises(SystemExit):
            main([*words, "--help"])
        rows = re.findall(r"(?m)^\| `.*?\|", page[page.index("## Options") : page.index(end)])
        in_help = set(re.findall(r"^  (--[a-z-]+)", capsys.readouterr().out, re.MULTILINE))
        assert in_help == set(re.findall("--[a-z-]+", " ".join(rows))) and len(in_help) > 10


def test_the_shipped_landscape_is_imported_again(tmp_path: Path) -> None:
    folder = ROOT / "config" / "landscapes" / "jacksboro"
    names = []
    with np.load(folder / "jacksboro.npz") as file:
        for name, states in file.items():  # on cells of 180 m, as `simulate.py` writes them
            names.append(tmp_path / name)
            names[-1].mkdir()
            states = states[::100].repeat(2, axis=1).repeat(2, axis=2)
            geotiff(names[-1] / "fire.tif", *states, nodata=None, cell=(180, 180))
        for got, (name, states) in zip(
            worlds(*names, *STATES, "--cell", 360), file.items(), strict=True
        ):
            np.testing.assert_array_equal(got, states[::100], name)


METRES, EAST, NORTH = {"units": "m"}, {"units": "degrees_east"}, {"units": "degrees_north"}
#: Variables and coordinates of one NetCDF fire, whose rows run from the north unless told.
LAYOUTS: dict[str, tuple[tuple[str, str], Any, dict[str, Any]]] = {
    "no coordinates, from the south": (("y", "x"), ARRIVAL[::-1], {}),
    "columns before rows": (("x", "y"), ARRIVAL.T, {"y": ("y", Y, METRES), "x": ("x", X, METRES)}),
    "columns before rows by units": (
        ("a", "b"), ARRIVAL.T,
        {"a": ("a", np.arange(4.0), EAST), "b": ("b", 2 - np.arange(3.0), NORTH)},
    ),
    "rising rows and falling columns": (
        ("y", "x"), ARRIVAL[::-1, ::-1],
        {"y": ("y", Y[::-1], METRES), "x": ("x", X[::-1], METRES)},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LAYOUTS)
def test_axes_of_netcdf_files_are_recognized(name: str, tmp_path: Path) -> None:
    over, values, coordinates = LAYOUTS[name]
    file = tmp_path / "a.nc"
    values = np.where(values == NEVER, np.nan, values)
    xarray.Dataset({"v": (over, values, {"units": "min"})}, coordinates).to_netcdf(file)
    np.testing.assert_array_equal(world(file, *ARRIVALS, "--oblong"), FIRE)


def test_netcdf_files_in_kilometres_or_with_a_grid_mapping_are_on_one_grid(tmp_path: Path) -> None:
    folder = tmp_path / "fire"
    folder.mkdir()
    crs = ((), 0, {"crs_wkt": CRS(UTM).to_wkt()})
    for k, (size, unit) in enumerate(((1, "m"), (1000, "km"))):
        axes = {"y": ("y", Y / size, {"units": unit}), "x": ("x", X / size, {"units": unit})}
        time = ((), [7.0, 10.0][k], {"units": "minutes since 2020-08-01"})
        mask = {"v": (("y", "x"), FIRE[2 * k], {"grid_mapping": "crs"})}
        xarray.Dataset(mask, axes | {"crs": crs, "time": time}).to_netcdf(folder / f"{k}.nc")
    states = world(folder, "--kind=states", "--step=1 min", "--cell=30")
    assert [len(states), *states[:, 1, 1]] == [4, 0, 0, 0, 1]
