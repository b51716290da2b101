"""Perimeters and detections become arrivals on a grid, or are refused with one line."""

from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest
from numpy.typing import NDArray
from rasters import refused, world
from shapely import MultiPolygon, Point, Polygon, box

ROOT = Path(__file__).parents[3]
WEST, SOUTH = 500_000, 4_000_000
DAYS = ["2020-08-29T18:00:00Z", "2020-08-30T18:00:00Z", "2020-08-31T18:00:00Z"]
#: Squares of 2, 4 and 6 cells of 100 m around one centre.
SQUARES = [box(WEST - r, SOUTH - r, WEST + r, SOUTH + r) for r in (100, 200, 300)]
FLAGS = ("--kind=arrival", "--step=1 d", "--burning=1", "--cell=100")


def perimeters(path: Path, shapes: list[Any], crs: Any = "EPSG:32610", **columns: Any) -> Path:
    columns = columns or {"date": DAYS[: len(shapes)]}
    geopandas.GeoDataFrame(columns, geometry=shapes, crs=crs).to_file(path)
    return path


def first_steps(file: Path, *flags: str) -> NDArray[np.int64]:
    """Returns the step in which each cell begins to burn, without the land around; 9: never."""
    states = world(file, *FLAGS, *flags)
    assert not states[:, [0, -1]].any() and not states[:, :, [0, -1]].any(), "land around the fire"
    rows, columns = np.nonzero(states.any(axis=0))
    begun = np.where(states.any(axis=0), (states > 0).argmax(axis=0), 9)
    return begun[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]


RINGS = np.array([[max(abs(2 * r - 5), abs(2 * c - 5)) // 2 for c in range(6)] for r in range(6)])


@pytest.mark.parametrize("ending", ["geojson", "gpkg", "shp"])
def test_a_cell_burns_from_the_first_perimeter_that_has_its_centre(
    ending: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    crs = "EPSG:4326" if ending == "geojson" else "EPSG:32610"
    shapes = geopandas.GeoSeries(SQUARES, crs="EPSG:32610").to_crs(crs)
    file = perimeters(tmp_path / f"fire.{ending}", list(shapes), crs)
    assert (first_steps(file) == RINGS).all()
    assert "times from the column date\n" in capsys.readouterr().out
    assert "begins at 2020-08-29 18:00:00 UTC" in (tmp_path / "new" / "world.toml").read_text()


def test_perimeters_may_shrink_have_holes_and_come_in_any_order(tmp_path: Path) -> None:
    small, middle, large = SQUARES
    shrinks = perimeters(tmp_path / "a.gpkg", [middle, small, large])
    assert (first_steps(shrinks) == np.where(RINGS == 2, 2, 0)).all()
    ring = MultiPolygon([Polygon(large.exterior, [middle.exterior.coords])])
    growth = perimeters(tmp_path / "b.gpkg", [ring, middle], date=[DAYS[2], DAYS[0]])
    assert (first_steps(growth) == np.where(RINGS == 2, 2, 0)).all()
    hole = perimeters(tmp_path / "c.gpkg", [small, ring])
    assert (first_steps(hole) == np.array([0, 9, 1])[RINGS]).all()
    x, y = np.array([-300, 300, 300, -300]) + WEST, np.array([-300, 300, -300, 300]) + SOUTH
    bow = Polygon(zip(x.tolist(), y.tolist(), strict=True))
    crossing = perimeters(tmp_path / "d.gpkg", [small, bow])
    assert (first_steps(crossing) < 9).sum() > 12


@pytest.mark.parametrize(
    ("flags", "n_steps", "columns"),
    [
        ((), 3, {"day": [20200830, 20200831, 20200901]}),
        ((), 3, {"DateCur": ["2020/08/29 00:00:00.0", "2020/08/30 00:00:00.0", "2020/08/31"]}),
        ((), 2, {"date": ["2020-08-29T23:00:00-07:00", DAYS[1], "2020-08-31T08:00:00+02:00"]}),
        (("--time-column=hours", "--unit=h"), 3, {"hours": [36.0, 60.0, 84.0], "date": DAYS}),
    ],
)
def test_times_may_have_other_forms(
    flags: tuple[str, ...], n_steps: int, columns: dict[str, Any], tmp_path: Path
) -> None:
    file = perimeters(tmp_path / "a.gpkg", SQUARES, **columns)
    assert len(world(file, *FLAGS, *flags)) == n_steps


@pytest.mark.parametrize(
    ("flags", "words", "quiet"),
    [
        ("--step=6h", "in 3 of 9 steps", "1 to 3, 5 to 7"),
        ("--step=6h --burning=4", "in 3 of 9 steps", None),
        ("--step=30 d", "in 2 of 2 steps", None),
        ("--begin=1598551200", "in 3 of 5 steps", "0 to 1"),
    ],
)
def test_times_and_steps_without_fire_are_reported(
    flags: str, words: str, quiet: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags_ = flags.replace(" --", "|--").split("|")
    world(perimeters(tmp_path / "fire.gpkg", SQUARES), *FLAGS, *flags_)
    told = capsys.readouterr().out
    times = "at 3 times from 2020-08-29 18:00:00 UTC to 2020-08-31 18:00:00 UTC"
    assert f"cells begin to burn {times}, {words}\n" in told
    assert told.count("warning: ") == (quiet is not None)
    assert quiet is None or f"\nwarning: no cell burns in steps {quiet}\n" in told


#: Words of the error, shapes, and columns.
REFUSED: list[tuple[str, list[Any], dict[str, Any]]] = [
    ("a polygon in each row, got Point in row 1", [SQUARES[0], Point(WEST, SOUTH)], {}),
    ("a polygon in each row, got none in row 0", [None, SQUARES[0]], {}),
    ("expected a coordinate reference system, got none; set it", SQUARES, {"crs": None}),
    ("got 0 (number); choose with --time-column", SQUARES, {"number": [1, 2, 3]}),
    ("got 2 (made, seen); choose with --time-column", SQUARES, {"made": DAYS, "seen": DAYS}),
    ("seen: expected times such as 2020-08-31T12:00:00Z in each row, got '' in row 1", SQUARES,
        {"seen": [DAYS[0], None, DAYS[2]]}),
    ("centres of cells in perimeters, got none in the first perimeters; use a smaller --cell",
        [box(WEST + 1, SOUTH + 1, WEST + 9, SOUTH + 9), SQUARES[0]], {}),
    ("perimeters on at most 4096 x 4096 cells, got", [SQUARES[0], box(0, 0, 9e6, 9e6)], {}),
    ("expected degrees in a zone of UTM, got coordinates of [499700.0, 3999700.0", SQUARES,
        {"crs": "EPSG:4326"}),
    ("fire.gpkg: expected perimeters, got:", [], {}),
    ("expected --kind arrival and --cell METRES, the side of the cells to draw", SQUARES, {}),
]  # fmt: skip


@pytest.mark.filterwarnings("ignore:'crs' was not provided")
@pytest.mark.parametrize(("words", "shapes", "columns"), REFUSED)
def test_other_perimeters_are_refused(
    words: str,
    shapes: list[Any],
    columns: dict[str, Any],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file, flags = tmp_path / "fire.gpkg", FLAGS[:3] if "and --cell METRES" in words else FLAGS
    if shapes:
        perimeters(file, shapes, **columns)
    else:
        file.write_text("hello")
    assert words in refused(capsys, file, *flags, "--out", tmp_path / "world.npz")


HEAD = "latitude,longitude,scan,track,acq_date,acq_time,instrument,confidence\n"
ROWS = (
    "36.14,-123,0.4,0.4,2020-08-30,0905,VIIRS,n\n",
    "36.14,-122.99,0.4,0.4,2020-08-31,905,VIIRS,h\n",
)


def test_a_cell_burns_from_its_first_detection(tmp_path: Path) -> None:
    file = tmp_path / "firms.csv"
    file.write_text(HEAD + "".join(ROWS))
    states = world(file, *FLAGS)
    assert "begins at 2020-08-30 09:05:00 UTC" in (tmp_path / "new" / "world.toml").read_text()
    cells = [(states[0] > 0).sum(), (states[1] > 0).sum()]
    assert cells == pytest.approx([16, 32], abs=4), "footprints of 4 x 4 cells"
    columns = np.nonzero((states[0] == 0) & (states[1] > 0))[1]
    assert columns.min() > np.nonzero(states[0])[1].max(), "the second is in the east"


@pytest.mark.parametrize(
    ("words", "old", "new"),
    [
        ("latitude, longitude, scan, track, acq_date, acq_time, got no scan", "scan", "size"),
        ("latitude: expected -90 to 90 in each row, got '36.14x' in row 0", "36.14", "36.14x"),
        ("acq_time: expected times such as 2020-08-31T12:00:00Z in each row, got '2020-08-30 2505'",
         "0905", "2505"),
    ],
)  # fmt: skip
def test_other_detections_are_refused(
    words: str, old: str, new: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "firms.csv"
    file.write_text((HEAD + "".join(ROWS)).replace(old, new))
    assert words in refused(capsys, file, *FLAGS, "--out", tmp_path / "world.npz")


def test_the_example_of_the_page_is_a_world(tmp_path: Path) -> None:
    page = (ROOT / "docs/landscapes.md").read_text("utf-8")
    code = page.partition("```python\n")[2].partition("```")[0]
    assert "perimeters.geojson" in code
    code = code.replace("config/", f"{ROOT}/config/").replace("perimeters.geo", f"{tmp_path}/p.geo")
    exec(compile(code, "page", "exec"), {})
    states = world(tmp_path / "p.geojson", *FLAGS, "--cell=360", "--step=6 h", "--burning=8")
    with np.load(ROOT / "config/landscapes/jacksboro/jacksboro.npz") as file:
        last = file["states_000"][384] > 0
    assert (states[-1] > 0).sum() == last.sum()
