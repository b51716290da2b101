"""Rasters of fires become recorded worlds: each format, kind and grid yields the same fire."""

import io
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
import rasterio
import xarray
from numpy.typing import NDArray
from PIL import Image
from rasters import ARRIVAL, NEVER, ascii_grid, geotiff, masks, netcdf

from emberwatch.landscape.__main__ import main
from emberwatch.landscape.world import arrays

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


def imported(out: Path, *flags: object) -> list[NDArray[np.uint8]]:
    main([str(flag) for flag in (*flags, "--out", out, "--force")])
    with np.load(out) as file:
        assert list(file) == [f"states_{number:03}" for number in range(len(file))]
        return [file[name] for name in file]


def one(out: Path, *flags: object) -> NDArray[np.uint8]:
    (sequence,) = imported(out, *flags)
    assert sequence.dtype == np.uint8
    return sequence


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "new" / "world.npz"


def changed(file: Path, **properties: object) -> Path:
    with rasterio.open(file, "r+") as opened:
        for name, value in properties.items():
            setattr(opened, name, value)
    return file


def with_never(value: float, scale: float = 1) -> NDArray[np.float64]:
    return np.where(ARRIVAL == NEVER, value, ARRIVAL * scale)


def same_arrivals(f: Path) -> list[tuple[object, ...]]:
    np.save(f / "fire.npy", with_never(np.nan))
    minutes = ("--unit", "min")
    scaled = geotiff(f / "scaled.tif", with_never(NEVER, 0.2) + 2 * (ARRIVAL != NEVER))
    files: list[tuple[object, ...]] = [
        (geotiff(f / "fire.tif"), *minutes),
        (geotiff(f / "inf.tif", with_never(np.inf)), *minutes),
        (geotiff(f / "-inf.tif", with_never(-np.inf)), *minutes, "--begin", 0),
        (ascii_grid(f / "fire.asc"), *minutes),
        (ascii_grid(f / "oblong.asc", side="dx 30\ndy 40"), *minutes, "--oblong"),
        (netcdf(f / "fire.nc", at=ARRIVAL),),
        (netcdf(f / "up.nc", at=ARRIVAL, southward=False),),
        (netcdf(f / "hours.nc", at=with_never(NEVER, 1 / 60), unit="hours"),),
        (f / "fire.npy", *minutes),
        (changed(scaled, scales=[5.0], offsets=[-10.0]), *minutes),
        # The first step is that of the earliest arrival.
        (geotiff(f / "later.tif", with_never(NEVER) + 1234 * (ARRIVAL != NEVER)), *minutes),
        (geotiff(f / "none.tif", nodata=None), *minutes, "--nodata", -1, "--nodata", NEVER),
    ]
    for number in ("-9999.9", "-3.4028235e+38", "-3.40282347e+38"):  # as rounded by the file
        values = with_never(float(number)).astype(np.float32)
        np.save(f / f"{number}.npy", values)
        for file in (geotiff(f / f"{number}.tif", values, nodata=None), f / f"{number}.npy"):
            files.append((file, *minutes, f"--nodata={number}"))
    for word in ("nan", "-9999.00"):  # both mean "no value"
        file = ascii_grid(f / f"{len(files)}.asc")
        file.write_text(file.read_text().replace("value -9999.0", f"value {word}"))
        files.append((file, *minutes))
        if word == "nan":
            file.write_text(file.read_text().replace("-9999.0", word))
    for values, numbers in (  # rotations caused by rounding
        (ARRIVAL, (30, 6e-17, 500_000, 6e-17, -30, 4_000_000)),
        (ARRIVAL[::-1, ::-1], (-30, 4e-15, 500_000, 4e-15, 30, 4_000_000)),
    ):
        file = geotiff(f / f"{len(files)}.tif", values)
        files.append((changed(file, transform=rasterio.Affine(*numbers)), *minutes))
    return files


def test_arrival_times_do_not_depend_on_the_format(tmp_path: Path, out: Path) -> None:
    for file, *flags in same_arrivals(tmp_path):
        np.testing.assert_array_equal(one(out, file, *ARRIVALS, *flags), FIRE, str(file))


def test_rows_run_from_the_north_and_columns_from_the_west(tmp_path: Path, out: Path) -> None:
    east, south = 500_000 + 4 * 30, 4_000_000 - 3 * 30
    for values, corner, cell in (
        (ARRIVAL[:, ::-1], (east, 4_000_000), (-30, 30)),
        (ARRIVAL[::-1], (500_000, south), (30, -30)),
        (ARRIVAL[::-1, ::-1], (east, south), (-30, -30)),
    ):
        file = geotiff(tmp_path / "fire.tif", values, corner=corner, cell=cell)
        np.testing.assert_array_equal(one(out, file, *MINUTES), FIRE)
        part = one(out, file, *MINUTES, "--crop=0,1,2,3", "--begin=0")
        np.testing.assert_array_equal(part, FIRE[: len(part), :2, 1:])


def test_each_arrival_file_or_layer_folder_is_a_sequence(tmp_path: Path, out: Path) -> None:
    files = geotiff(tmp_path / "b.tif"), geotiff(tmp_path / "a.tif", with_never(NEVER, 2))
    first, other = imported(out, *files, *MINUTES)
    np.testing.assert_array_equal(first, FIRE)
    assert other.shape == (11, 3, 4)
    for name, n_layers in (("a", 3), ("b", 4)):
        (tmp_path / name).mkdir()
        geotiff(tmp_path / name / "fire.tif", *masks(n_layers), nodata=None)
    first, second = imported(out, tmp_path / "a", tmp_path / "b", *MASKS)
    np.testing.assert_array_equal(first, FIRE[:3])
    np.testing.assert_array_equal(second, FIRE[:4])


def test_masks_from_files_bands_and_times_are_equal(tmp_path: Path, out: Path) -> None:
    layers, folder = masks(), tmp_path / "folder"
    folder.mkdir()
    for k, layer in enumerate(layers):
        geotiff(folder / f"step_{k + 8}.tif", layer, nodata=None)  # step_10 comes after step_9
    # Auxiliary files are not read as layers.
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False),
        rasterio.open(folder / "step_8.tif", "r+") as file,
    ):
        file.write_mask(np.ones((3, 4), bool))
    assert (folder / "step_8.tif.msk").exists()
    for end in "tif.ovr tif.aux.xml tif.vat.dbf qml tfw png prj xml".split():
        (folder / f"step_9.{end}").write_text("")
    np.savez(tmp_path / "fire.npz", burnt=layers.astype(bool), other=np.zeros(3))
    xarray.Dataset({"burnt": (("time", "y", "x"), layers[:, ::-1].astype(bool))}).to_netcdf(
        tmp_path / "bool.nc"
    )
    for given in (
        (folder,),
        (tmp_path / "bool.nc",),
        (geotiff(tmp_path / "bands.tif", *layers * 255, nodata=None),),
        (geotiff(tmp_path / "zero.tif", *layers, nodata=0), "--missing-is-unburnt"),
        (netcdf(tmp_path / "fire.nc", times=[0, 600, 1200, 1800], mask=layers),),
        (tmp_path / "fire.npz", "--variable", "burnt"),
    ):
        np.testing.assert_array_equal(one(out, *given, *MASKS), FIRE[:4], str(given[0]))


def test_burning_masks_and_codes_show_burnt_cells(tmp_path: Path, out: Path) -> None:
    burning = geotiff(tmp_path / "burning.tif", *(FIRE == 1), nodata=None)
    np.testing.assert_array_equal(one(out, burning, "--kind", "burning", *STEP), FIRE)
    codes = np.array([7, 3, 5], np.uint8)[FIRE]
    file = geotiff(tmp_path / "codes.tif", *codes, nodata=None)
    np.testing.assert_array_equal(one(out, file, *STATES, "--codes", "7,3,5"), FIRE)
    every = (*STATES, "--codes", "7,3,5", "--step", "20 min", "--every", 2)
    np.testing.assert_array_equal(one(out, file, *every), FIRE[[0, 2, 4, 5]])


def test_a_step_shows_the_last_layer_at_or_before_its_time(tmp_path: Path, out: Path) -> None:
    states = np.zeros((4, 1, 4), np.uint8)
    for k in range(1, 4):
        states[k:, 0, k] = 1
    cases: list[tuple[list[float], str | None, tuple[object, ...], list[int]]] = [
        ([0, 10, 20, 30], "minutes since 2020-08-01", ("--step", "20 min"), [0, 2, 3]),
        ([0, 10, 20, 30], "minutes", ("--step", "15 min"), [0, 1, 3]),
        ([0, 10, 20, 30], "minutes", ("--step", "1 h"), [0, 3]),
        ([0, 10, 20, 30], "minutes", ("--step", "5 min"), [0, 0, 1, 1, 2, 2, 3]),
        ([600, 1200, 3000, 3600], "seconds", ("--step", "10 min"), [0, 1, 1, 1, 2, 3]),
        ([7, 7.3333, 7.6667, 9], "hours", ("--step", "20 min"), [0, 1, 2, 2, 2, 2, 3]),
        ([0, 600, 1800, 2400], None, ("--step", "10 min", "--unit", "s"), [0, 1, 1, 2, 3]),
        ([0, 10, 20, 30], None, ("--step", "7 d"), [0, 1, 2, 3]),
    ]
    for times, unit, flags, shown in cases:
        file = netcdf(tmp_path / "fire.nc", times=times, time_unit=unit, state=states)
        got = one(out, file, "--kind", "states", *flags, "--oblong")
        np.testing.assert_array_equal(got, states[shown], str((times, unit, flags)))


def test_files_with_different_reference_dates_are_ordered(tmp_path: Path, out: Path) -> None:
    folder = tmp_path / "days"
    folder.mkdir()
    for day, part in ((1, FIRE[:2]), (2, FIRE[2:4])):
        unit = f"hours since 2020-08-0{day} 00:00:00"
        netcdf(folder / f"{day}.nc", times=[0, 12], time_unit=unit, state=part)
    np.testing.assert_array_equal(one(out, folder, *STATES, "--step", "12 h"), FIRE[:4])


#: Units of time and their calendars, and the time 90 minutes after the first one.
BEGINS: list[tuple[str, str | None, str | None]] = [
    ("minutes since 2020-08-01", None, "2020-08-01 01:30:00 UTC"),
    ("minutes since 2020-8-1 0:0:0.0", "gregorian", "2020-08-01 01:30:00 UTC"),
    ("minutes since 2020-08-01T12:00:00Z", None, "2020-08-01 13:30:00 UTC"),
    ("minutes since 2020-08-01 12:00 -07:00", None, "2020-08-01 20:30:00 UTC"),
    ("minutes since 2020-08-01 12:00 -0330", None, "2020-08-01 17:00:00 UTC"),
    ("minutes since 2020-08-01 12:00 -00:30", None, "2020-08-01 14:00:00 UTC"),
    ("minutes since 2020-02-29", "noleap", None),
    ("minutes since 2020-02-28 23:00", "noleap", "2020-03-01 00:30:00 UTC (noleap calendar)"),
    ("minutes since 2020-02-31", None, None),
    ("minutes since ignition", None, None),
    ("hours since 1-1-1", None, "0001-01-04 18:00:00 UTC"),
    ("minutes", None, None),
]


def test_the_description_states_when_a_sequence_begins(tmp_path: Path, out: Path) -> None:
    for unit, calendar, begin in BEGINS:
        times = {"times": [90, 100, 110, 120], "time_unit": unit, "calendar": calendar}
        one(out, netcdf(tmp_path / "fire.nc", **times, mask=masks()), *MASKS)
        lines = out.with_suffix(".toml").read_text("utf-8").splitlines()
        expected = [] if begin is None else [f"# states_000 begins at {begin}"]
        assert [line for line in lines if line.startswith("#")] == expected, unit
    later = with_never(NEVER) + 5 * (ARRIVAL != NEVER)
    unit = "minutes since 2020-08-01 12:00"
    files = netcdf(tmp_path / "a.nc", at=ARRIVAL), netcdf(tmp_path / "b.nc", at=later, unit=unit)
    imported(out, *files, *ARRIVALS)
    text = out.with_suffix(".toml").read_text("utf-8")
    assert re.findall("(?m)^# .*", text) == ["# states_001 begins at 2020-08-01 12:05:00 UTC"]


def test_sequences_need_equal_cells_unless_mixed(tmp_path: Path, out: Path) -> None:
    first = geotiff(tmp_path / "a.tif")
    other = geotiff(tmp_path / "b.tif", cell=(60, 60), crs="EPSG:32611")
    elsewhere = geotiff(tmp_path / "c.tif", corner=(100_000, 3_000_000))
    doubled = ARRIVAL.repeat(2, axis=0).repeat(2, axis=1)
    small = geotiff(tmp_path / "d.tif", doubled, cell=(15, 15))
    for states in (
        *imported(out, first, other, *MINUTES, "--mixed"),
        *imported(out, first, elsewhere, small, *MINUTES, "--cell", 30),
    ):
        np.testing.assert_array_equal(states, FIRE)


def test_a_larger_cell_burns_while_any_input_cell_does(tmp_path: Path, out: Path) -> None:
    states = np.zeros((5, 6, 8), np.uint8)
    states[1:, 0, 0], states[3:, 0, 0] = 1, 2  # burns in steps 1 and 2
    states[2:, 1, 1], states[4:, 1, 1] = 1, 2  # burns in steps 2 and 3
    file = geotiff(tmp_path / "fire.tif", *states, nodata=None)
    for flags in (("--height", 3), ("--width", 4), ("--cell", 60)):
        small = one(out, file, *STATES, *flags)
        assert small.shape == (5, 3, 4)
        assert small[:, 0, 0].tolist() == [0, 1, 1, 1, 2]
        assert not small[:, 1:].any() and not small[:, :, 1:].any()


def test_nearest_uses_the_middle_cell_and_repeats_it(tmp_path: Path, out: Path) -> None:
    states = np.zeros((3, 3, 3), np.uint8)
    states[1:, 1, 1], states[1:, 0, 0] = 1, 2
    file = geotiff(tmp_path / "fire.tif", *states, nodata=None)
    flags = (*STATES, "--resample", "nearest")
    assert one(out, file, *flags, "--height", 1).ravel().tolist() == [0, 1, 1]
    doubled = states.repeat(2, axis=1).repeat(2, axis=2)
    np.testing.assert_array_equal(one(out, file, *flags, "--height", 6), doubled)
    flags = (*flags, "--resample", "earliest")
    np.testing.assert_array_equal(one(out, file, *flags, "--height", 6), doubled)


def test_the_input_can_be_cropped(tmp_path: Path, out: Path) -> None:
    part = one(out, geotiff(tmp_path / "fire.tif"), *MINUTES, "--crop", "1,0,2,3")
    np.testing.assert_array_equal(part, FIRE[1:5, 1:, :3])
    layers = masks().astype(np.float32)
    layers[:, 0, 0] = np.nan  # cropped away
    file = geotiff(tmp_path / "fire.tif", *layers, nodata=None)
    np.testing.assert_array_equal(one(out, file, *MASKS, "--crop", "1,1,2,3"), FIRE[:4, 1:, 1:])


def test_sequence_names_sort_in_order() -> None:
    file = io.BytesIO()
    arrays([np.zeros((2, 1, 1), np.uint8)] * 1001)(file)
    file.seek(0)
    names = list(np.load(file))
    assert names == sorted(names) and (names[0], names[-1]) == ("states_0000", "states_1000")


def test_the_description_has_the_states_of_the_sequences(tmp_path: Path, out: Path) -> None:
    name = 'fire "\U0001f525" \\ \x7f\n'
    one(out, geotiff(tmp_path / "f.tif"), *MINUTES, "--name", name)
    text = tomllib.loads(out.with_suffix(".toml").read_text("utf-8"))
    assert text.keys() == {"name", "step", "states", "observations"}
    assert (text["name"], text["step"]) == (name, "10 min")
    names = ["unburnt", "burning", "burnt"]
    assert [state["name"] for state in text["states"]] == names
    assert [observation["name"] for observation in text["observations"]] == names
    assert [state["reward"] for state in text["states"]] == [0, 1, 0]
    for number, state in enumerate(text["states"]):
        assert state.keys() == {"name", "color", "observed_as", "reward"}
        assert np.argmax(state["observed_as"]) == number
        assert sum(state["observed_as"]) == pytest.approx(1)


def test_output_is_reproducible_drawn_and_summarized(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, picture = geotiff(tmp_path / "fire.tif"), tmp_path / "fire.png"
    outputs = [tmp_path / "a" / "world.npz", tmp_path / "b" / "world.npz"]
    for output in outputs:
        one(output, file, *MINUTES, "--picture", picture)
    assert outputs[0].read_bytes() == outputs[1].read_bytes()
    assert sorted(path.name for path in outputs[0].parent.iterdir()) == ["world.npz", "world.toml"]
    words = "6 steps of 3 x 4 cells: at most 4 burn, at step 2; 75.0 % have burnt at the end"
    assert words in capsys.readouterr().out
    colors = Image.open(picture).convert("RGB").getcolors(1 << 20) or []
    most = {color for count, color in colors if count > 1000}
    assert {(0x3B, 0x6E, 0xA5), (0xC8, 0x37, 0x1B), (0x4A, 0x4A, 0x4A)} <= most


def test_the_documents_list_the_flags_of_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    for words, name, end in (
        ([], "landscapes", "## Time and grid"),
        (["land"], "land", "## Slope and wind"),
    ):
        page = (ROOT / "docs" / f"{name}.md").read_text("utf-8")
        with pytest.raises(SystemExit):
            main([*words, "--help"])
        rows = re.findall(r"(?m)^\| `.*?\|", page[page.index("## Options") : page.index(end)])
        in_help = set(re.findall(r"^  (--[a-z-]+)", capsys.readouterr().out, re.MULTILINE))
        assert in_help == set(re.findall("--[a-z-]+", " ".join(rows))) and len(in_help) > 15


def test_the_shipped_landscape_matches_its_description() -> None:
    folder = ROOT / "config" / "landscapes" / "jacksboro"
    text = tomllib.loads((folder / "jacksboro.toml").read_text("utf-8"))
    with np.load(folder / "jacksboro.npz") as file:
        sequences = [file[name] for name in file]
    assert len({sequence.shape[1:] for sequence in sequences}) == 1
    for states in sequences:
        assert states.dtype == np.uint8 and states.max() < len(text["states"])
        assert (np.diff(states.astype(int), axis=0) >= 0).all()
        assert (states[-1] == 1).any()
