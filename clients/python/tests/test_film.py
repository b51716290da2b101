"""Films of recordings: their pictures, and their messages about missing records."""

import json
import sys
from pathlib import Path
from typing import Any

import document
import numpy as np
import pytest
from headers import header
from numpy.typing import NDArray
from PIL import Image, ImageSequence
from test_recording import FILE_HEADER, OLD, deflated, packed

from emberwatch.belief import Belief, known, uniform_prior
from emberwatch.client import wire
from emberwatch.model import Model
from emberwatch.render.film.__main__ import main
from emberwatch.render.palette import ROBOTS

MODEL = Model.wildfire()
HEIGHT, WIDTH, SCALE = 3, 5, 10
#: Left and upper edges of the four panels in pixels: they are 150 wide and 16 apart.
LEFTS, TOP = [14, 180, 346, 512], 68
INFO = document.examples()[1] | {"height": HEIGHT, "width": WIDTH, "n_moves": 2, "n_worlds": 2}
INFO |= {"n_robots": 1, "deadline_millis": 0, "recorded_world": None}
SEEN = np.full((HEIGHT, WIDTH), 255, np.uint8)
SEEN[0, :2], SEEN[1, 1] = [0, 1], 2
TRUTH = np.arange(HEIGHT * WIDTH, dtype=np.uint8).reshape(HEIGHT, WIDTH) % 3
UNSEEN = (0xE2, 0xE2, 0xE2)


def server(**changes: Any) -> bytes:
    info = INFO | {"model": MODEL.toml, "observations": list(MODEL.observation_names)} | changes
    return packed(1, deflated(json.dumps(info).encode()))


def frame(step: int, *, world: int = 0, robots: int = 1, **told: int) -> bytes:
    """Makes a frame: robot r flies right and down from column r of row 0, and sees `SEEN`."""
    episode, hovered, late = (told.get(name, 0) for name in ("episode", "hovered", "late"))
    result = wire.WORLD.pack(step, 7, episode, 2.0, hovered, late, 0, 3, 0, 0, 0)
    sizes = {"n_robots": robots, "height": HEIGHT, "width": WIDTH}
    place = {"world": world, "first_robot": world * robots}
    head = header("FrameHeader", result=result, **place, **sizes)
    results = paths = b""
    for robot in range(robots):
        flew = not (hovered | late) >> robot & 1
        place = (0, robot, 1, robot + 1) if flew else (0, robot, 0, robot)
        results += wire.ROBOT.pack(2.0, 2.0, 3, 0, *place, 1, 2 * flew)
        paths += b"\3\1" * flew
    return packed(2, deflated(head + results + SEEN.tobytes() * robots + paths))


def truth(step: int) -> bytes:
    head = header("TruthHeader", height=HEIGHT, width=WIDTH, step=step, seed=7)
    return packed(3, deflated(head + TRUTH.tobytes()))


def both(*steps: int) -> list[bytes]:
    return [record for step in steps for record in (truth(step), frame(step))]


def end(records: list[bytes]) -> bytes:
    kinds = [int.from_bytes(record[8:12], sys.byteorder) for record in records]
    names = ("n_servers", "n_frames", "n_truths")
    totals = {name: kinds.count(kind) for kind, name in enumerate(names, 1)}
    return packed(
        4, deflated(json.dumps(totals | {"n_lost_frames": 0, "n_lost_truths": 0}).encode())
    )


class Studio:
    """Runs the command on a recording of these records."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self._file, self._capsys = folder / "lab.recording", capsys
        self.gif, self.png = folder / "new/lab.gif", folder / "new/lab.png"

    def film(self, records: list[bytes], *flags: object, cut: bool = False) -> str:
        """Makes a film. Returns the text on standard error."""
        content = FILE_HEADER + b"".join(records) + end(records)
        self._file.write_bytes(content[: -len(end(records)) - 5] if cut else content)
        out = self.png if "--step" in flags else self.gif
        words = [self._file, "--out", out, "--prior", "uniform", "--scale", SCALE, *flags]
        main([str(word) for word in words])
        return self._capsys.readouterr().err

    def fails(self, records: list[bytes], *flags: object) -> str:
        with pytest.raises(SystemExit):
            self.film(records, *flags)
        return self._capsys.readouterr().err

    def still(self, records: list[bytes], *flags: object) -> NDArray[np.uint8]:
        self.film(records, "--step", 1, *flags)
        return np.asarray(Image.open(self.png))

    def pictures(self) -> list[NDArray[np.uint8]]:
        with Image.open(self.gif) as film:
            return [np.asarray(it.convert("RGB")) for it in ImageSequence.Iterator(film)]

    def millis(self) -> list[int]:
        with Image.open(self.gif) as film:
            return [it.info["duration"] for it in ImageSequence.Iterator(film)]


@pytest.fixture
def studio(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Studio:
    return Studio(tmp_path, capsys)


def cells(image: NDArray[np.uint8], panel: int) -> NDArray[np.uint8]:
    """Returns the colour in the upper left corner of each cell of a panel, `(H, W, 3)`."""
    rows = TOP + SCALE * np.arange(HEIGHT)
    cols = LEFTS[panel] + SCALE * np.arange(WIDTH)
    return image[np.ix_(rows, cols)]


def believed() -> Belief:
    kept = known(MODEL, prior=uniform_prior(MODEL, height=HEIGHT, width=WIDTH))
    kept.correct(SEEN)
    kept.predict()
    kept.correct(SEEN)
    return kept


def test_panels_show_truth_frame_belief_and_entropy(studio: Studio) -> None:
    image = studio.still([server(), *both(0, 1)])
    assert (cells(image, 0) == np.array(MODEL.state_colors, np.uint8)[TRUTH]).all()
    seen = np.array([*MODEL.observation_colors, UNSEEN], np.uint8)[np.minimum(SEEN, 3)]
    assert (cells(image, 1) == seen).all()
    kept = believed()
    for panel, shares in ((2, kept.belief[2]), (3, kept.entropy() / np.log(3))):
        lightness = cells(image, panel).astype(int).sum(axis=2).ravel()
        order = np.argsort(shares.ravel())
        assert (np.diff(lightness[order]) <= 0).all()
        levels = np.rint(shares * 23).ravel()
        assert len(set(levels)) == len(set(lightness)) > 1
    robot = image[TOP + 15, LEFTS[0] + 15], image[TOP + 15, LEFTS[2] + 15]
    assert (np.array(robot) == 0x14).all()


def test_a_film_shows_all_steps_and_a_still_one(studio: Studio) -> None:
    records = [server(), *both(0, 1, 2, 3, 4)]
    assert studio.film(records, "--fps", 20) == ""
    assert studio.millis() == [50] * 4 + [1000]
    studio.film(records, "--from", 1, "--to", 4, "--every", 2)
    first, _ = studio.pictures()
    assert studio.millis() == [100, 1000]
    still = studio.still(records)
    assert still.shape == first.shape
    for panel in range(4):  # text has fewer greys in a film
        assert np.abs(cells(still, panel).astype(int) - cells(first, panel)).max() <= 4


def test_the_belief_predicts_through_visible_gaps(studio: Studio) -> None:
    records = [server(), *both(0, 1, 4, 5)]
    words = studio.film(records)
    assert "2 steps are not recorded; the belief is predicted through them" in words
    assert studio.millis() == [100, 100, 1000, 100, 1000]
    gap = studio.pictures()[2]
    assert (cells(gap, 0)[0] == 255).all() and (cells(gap, 1)[0] == 255).all()
    kept = believed()
    for _ in range(2):
        kept.predict()
    shades = cells(gap, 2).astype(int).sum(axis=2)
    levels = np.rint(kept.belief[2] * 23)
    assert len(np.unique(levels)) == len(np.unique(shades)) > 1
    assert (np.argsort(levels.ravel(), kind="stable")[-1:] == np.argmin(shades)).all()
    studio.film(records, "--to", 4, "--every", 4)
    assert studio.millis() == [100, 1000, 1000], "a gap is not left out"


def test_the_belief_resets_with_a_new_episode(studio: Studio) -> None:
    records = [server(), *both(0, 1), frame(0, episode=1)]
    words = studio.film(records, "--step", 0)
    assert "--step: recorded in 2 episodes; showing the first" in words
    studio.film(records)
    first, _, again = (cells(image, 2) for image in studio.pictures())
    assert (first == again).all()
    lacking = cells(studio.pictures()[2], 0)
    assert (lacking[0] == 255).all(), "no hidden states of that step"


def test_missing_parts_are_left_out(studio: Studio) -> None:
    whole = studio.still([server(), *both(1)])
    blind = studio.still([server(), frame(1)])
    assert whole.shape[1] - blind.shape[1] == 166, "no panel of hidden states"
    words = studio.film([server(model=None), *both(1)])
    assert "the belief is left out, as the server hid its model" in words
    assert studio.pictures()[0].shape[1] == 2 * 150 + 16 + 28
    old = MODEL.toml.replace("[[kernel]]", '[[kernel]]\nown = "fire"')
    words = studio.film([server(model=old, zones={"names": ["land"]}), *both(1)])
    assert "left out, as the model has a form of an earlier release; give --model" in words


def test_a_hidden_model_can_be_passed_by_flag(studio: Studio, tmp_path: Path) -> None:
    file = tmp_path / "model.toml"
    file.write_text(MODEL.toml)
    plain, given = ([server(**it), *both(1)] for it in ({}, {"model": None}))
    assert (studio.still(plain) == studio.still(given, "--model", file)).all()
    replaced = studio.still([server(model="?"), *both(1)], "--model", file)
    assert (replaced == studio.still(plain)).all()
    error = studio.fails([server(model=None, n_observations=4), *both(1)], "--model", file)
    assert "--model: expected one with 4 observations, as recorded, got 3" in error


def test_recorded_worlds_have_the_colours_of_their_description(studio: Studio) -> None:
    colors = np.array([[0, 0, 255], [0, 255, 0], [255, 0, 255]], np.uint8)
    lines = ['name = "lab"', 'step = "1 h"']
    for kind, more in (("states", "observed_as = [0.2, 0.3, 0.5]"), ("observations", "")):
        for number, color in enumerate(colors.tolist()):
            hexadecimal = "".join(f"{channel:02x}" for channel in color)
            lines += [f"[[{kind}]]", f'name = "{number}"', f'color = "#{hexadecimal}"', more]
    recorded = {"description": "\n".join(lines), "n_sequences": 1, "n_steps": 9}
    records = [server(model=None, recorded_world=recorded), *both(1)]
    words = studio.film(records)
    assert "the belief is left out, as recorded worlds have no model" in words
    image = studio.still(records)
    assert (cells(image, 0) == colors[TRUTH]).all()
    seen = SEEN < 255
    assert (cells(image, 1)[seen] == colors[SEEN[seen]]).all()


def test_a_recording_of_release_0_2_is_drawn_with_its_belief(tmp_path: Path) -> None:
    film = tmp_path / "old.png"
    main([str(OLD), "--step", "8", "--prior", "uniform", "--scale", "10", "--out", str(film)])
    with Image.open(film) as image:
        # Four panels: truth, frame, belief and entropy.
        assert image.width == 14 + 4 * (160 + 16) - 16 + 14


def test_a_cut_recording_is_shown_up_to_the_cut(studio: Studio) -> None:
    words = studio.film([server(), frame(0), frame(1), frame(2)], cut=True)
    assert "warning" in words and "cut short" in words
    assert len(studio.millis()) == 2


def test_a_film_skips_other_worlds_and_repeated_records(studio: Studio) -> None:
    records = [server(), frame(0), server(pid=9), frame(0), server(pid=7, model=None), frame(1)]
    assert "worlds of another kind follow" in studio.film(records)
    assert len(studio.millis()) == 1, "two alike"
    studio.film([server(), frame(0), frame(1), frame(1), frame(1, world=1), frame(2)])
    assert len(studio.millis()) == 3, "published again"


#: Wrong flags, each with words of its error.
WRONG: list[tuple[list[object], str]] = [
    (["--world", 7], "--world: expected one of the recorded worlds 0, 1, got 7"),
    (["--step", 9], "expected some of the recorded steps 0 to 1, 4 to 4, got 9 to 9"),
    (["--from", 5], "expected some of the recorded steps 0 to 1, 4 to 4, got 5 to inf"),
    (["--from", 5, "--to", 4], "--to: expected 5 to inf, got 4"),
    (["--every", 0], "--every: expected 1 to inf, got 0"),
    (["--fps", 0], "--fps: expected 0.1 to 50, got 0.0"),
    (["--fps", "fast"], "invalid float value: 'fast'"),
    (["--scale", 101], "--scale: expected 1 to 100, got 101"),
    (["--step", 1, "--every", 2], "--step: cannot be combined with --from, --to or --every"),
    (["--out", "lab.mp4"], "--out: expected a .gif, or with --step a .png, got lab.mp4"),
    (["--step", 1, "--out", "a.gif"], "--out: expected a .gif, or with --step a .png"),
    (["--prior", "none"], "invalid choice: 'none'"),
    (["--out", "/dev/null/a.gif"], "/dev/null"),
]


def test_wrong_flags_are_named(studio: Studio) -> None:
    records = [server(), frame(0), frame(1), frame(1, world=1), frame(4)]
    for flags, words in WRONG:
        assert words in studio.fails(records, *flags)
    assert not studio.gif.exists() and not studio.png.exists()


def test_invalid_recordings_are_named(studio: Studio) -> None:
    assert "at byte 16" in studio.fails([b"\0" * 40])
    always = [("[0.98, 0.01, 0.01]", "[1, 0, 0]"), ("[0.80, 0.15, 0.05]", "[1, 0, 0]")]
    toml = MODEL.toml.replace("[0.01, 0.01, 0.98]", "[0, 1, 0]")
    for before, after in always:
        toml = toml.replace(before, after)
    assert "step 0: frame: cell (1, 1): expected" in studio.fails([server(model=toml), frame(0)])


def test_a_missing_pillow_names_the_extra(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "emberwatch.render.film.page", raising=False)
    monkeypatch.setitem(sys.modules, "PIL", None)
    assert "pip install emberwatch[film]" in studio.fails([server(), frame(0)])


def test_a_team_is_drawn_with_paths_and_hovering_robots(studio: Studio) -> None:
    team = server(n_robots=3)
    blank = studio.still([team, frame(1, robots=3, hovered=7)])
    flown = studio.still([team, frame(1, robots=3, hovered=0)])
    some = studio.still([team, frame(1, robots=3, hovered=2, late=4)])
    for robot, color in enumerate(ROBOTS[:3]):
        middles = [(0, robot), (1, robot + 1)]
        for image, (row, col) in ((blank, middles[0]), (flown, middles[1])):
            at = TOP + SCALE * row + SCALE // 2, LEFTS[0] + SCALE * col + SCALE // 2
            assert tuple(image[at]) == color, (robot, row, col)
    # One line of small print names the robots that stayed.
    foot = {
        name: (image[-30:] != 255).sum()
        for name, image in (("flown", flown), ("some", some), ("blank", blank))
    }
    assert foot["flown"] < foot["some"] < foot["blank"]


def test_no_fly_cells_and_footprints_are_drawn(studio: Studio) -> None:
    airspace = {"radius": 1, "no_fly": [[0, 0, 0, 0, 1]] * HEIGHT}
    plain = studio.still([server(model=None), *both(1)])
    image = studio.still([server(model=None, airspace=airspace), *both(1)])
    changed = (image[: TOP + 30] != plain[: TOP + 30]).any(axis=2)[TOP:]
    for left in LEFTS[:2]:
        assert changed[:, left + 40 : left + 50].any(axis=1).all(), "hatches"
    assert image.shape != plain.shape or (image[-40:] != plain[-40:]).any(), "the legend"
