"""Films of recordings: their scenes, their pictures, and their messages about missing records."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import document
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageSequence
from test_recording import OLD

from emberwatch.belief import Belief, known, uniform_prior
from emberwatch.client import recording
from emberwatch.client.observer import Frame, RobotFrame, Truth
from emberwatch.client.recording import Record
from emberwatch.client.replies import RecordedWorld, ServerInfo
from emberwatch.client.wire import RobotResult, WorldResult
from emberwatch.model import Model
from emberwatch.model.airspace import Airspace
from emberwatch.render.film import main
from emberwatch.render.page import Page
from emberwatch.render.scenes import Scene, scenes

MODEL = Model.wildfire()
HEIGHT, WIDTH, SCALE = 3, 5, 10
#: Left and upper edges of the four panels in pixels: their columns are 150 wide and 16 apart.
LEFTS, TOP = [14, 180, 346, 512], 76
INFO = document.examples()[1] | {"height": HEIGHT, "width": WIDTH, "n_moves": 2, "n_robots": 1}
INFO |= {"recorded_world": None, "burn_in": 9, "model": MODEL.toml}
INFO |= {"n_observations": 3, "observations": MODEL.observation_names, "airspace": Airspace()}
SERVER = ServerInfo(**{name: it for name, it in INFO.items() if name != "reply"})
SEEN = np.full((HEIGHT, WIDTH), 255, np.uint8)
SEEN[0, :2], SEEN[1, 1] = [0, 1], 2
TRUTH = np.arange(HEIGHT * WIDTH, dtype=np.uint8).reshape(HEIGHT, WIDTH) % 3
UNSEEN = (0xE2, 0xE2, 0xE2)


def frame(step: int, robots: int = 1, server: ServerInfo = SERVER, **told: Any) -> Record:
    """Makes a frame: robot r flies right and down from column r of row 0, and sees `SEEN`."""
    world = dict.fromkeys(WorldResult._fields, 0) | {"step": step, "seed": 7, "reward": 2.0} | told
    result, one = WorldResult(**world), dict.fromkeys(RobotResult._fields, 0)
    flown = [
        RobotFrame(
            result=RobotResult(**one | {"start_col": robot, "row": 1, "col": robot + 1}),
            frame=SEEN,
            path=np.array([3, 1] * (1 - (result.hovered >> robot & 1)), np.uint8),
        )
        for robot in range(robots)
    ]
    sample = Frame(world=0, result=result, robots=tuple(flown), n_lost=0)
    return Record(seconds=0.0, server=server, sample=sample)


def both(*steps: int, server: ServerInfo = SERVER) -> list[Record]:
    """Makes the hidden states and frames of some steps."""
    truths = [
        Truth(world=0, episode=0, step=step, seed=7, states=TRUTH, n_lost=0) for step in steps
    ]
    records = [Record(seconds=0.0, server=server, sample=truth) for truth in truths]
    return records + [frame(step, server=server) for step in steps]


def played(*records: Record) -> list[Scene]:
    return list(scenes(records, lambda _: believed()))


class Studio:
    """Runs the command on a recording of these records."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str], patch: Any) -> None:
        self._capsys, self._patch = capsys, patch
        self.gif, self.png = folder / "new/lab.gif", folder / "new/lab.png"

    def film(self, records: list[Record] | Path, *flags: object) -> str:
        """Makes a film. Returns the text on standard error."""
        if not isinstance(records, Path):
            self._patch.setattr(recording, "read", lambda *_, **__: iter(records))
        out = self.png if "--step" in flags else self.gif
        main([str(it) for it in (records, "--out", out, "--scale", SCALE, *flags)])
        return self._capsys.readouterr().err

    def fails(self, records: list[Record] | Path, *flags: object) -> str:
        with pytest.raises(SystemExit):
            self.film(records, *flags)
        return self._capsys.readouterr().err

    def still(self, records: list[Record], *flags: object) -> NDArray[np.uint8]:
        self.film(records, "--step", 1, *flags)
        with Image.open(self.png) as image:
            return np.asarray(image)


@pytest.fixture
def studio(tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> Studio:
    return Studio(tmp_path, capsys, monkeypatch)


def cells(image: NDArray[np.uint8], panel: int) -> NDArray[np.uint8]:
    """Returns the colour in the upper left corner of each cell of a panel, `(H, W, 3)`."""
    rows = TOP + SCALE * np.arange(HEIGHT)
    cols = LEFTS[panel] + SCALE * np.arange(WIDTH)
    return image[np.ix_(rows, cols)]


def believed(*n_predictions: int) -> Belief:
    """Returns a belief after frames, with this number of predictions before each of them."""
    kept = known(MODEL, prior=uniform_prior(MODEL, height=HEIGHT, width=WIDTH))
    for n in n_predictions:
        for _ in range(n):
            kept.predict()
        kept.correct(SEEN)
    return kept


def test_the_belief_predicts_through_missing_steps() -> None:
    first, second, last = played(*both(0, 1, 4))
    assert [it.n_lost for it in (first, second, last)] == [0, 0, 2]
    for scene, n_predictions in ((first, [0]), (second, [0, 1]), (last, [0, 1, 3])):
        assert (scene.belief == believed(*n_predictions).belief).all()
        assert scene.truth is TRUTH and (scene.frame.frame == SEEN).all()
    assert (first.mean_reward, last.mean_reward) == (0.0, 2.0)


def test_the_belief_begins_anew_with_an_episode() -> None:
    first, _, again = played(*both(0, 1), frame(0, episode=1))
    assert (first.belief == again.belief).all()
    assert again.truth is None, "no hidden states of that step"


def test_repeated_records_and_other_worlds_are_skipped() -> None:
    repeated = frame(0), frame(1), frame(1), frame(2)
    assert [it.frame.result.step for it in played(*repeated)] == [0, 1, 2]
    with pytest.warns(UserWarning, match="worlds of another kind follow"):
        assert len(played(frame(0), frame(1, server=replace(SERVER, pid=7, model=None)))) == 1
    assert len(played(frame(0), frame(0, server=replace(SERVER, pid=9)))) == 2


def test_panels_show_truth_frame_belief_and_entropy() -> None:
    _, scene = played(*both(0, 1))
    image = np.asarray(Page(SERVER, MODEL, world=0, scale=SCALE, has_truth=True).draw(scene))
    assert (cells(image, 0) == np.array(MODEL.state_colors, np.uint8)[TRUTH]).all()
    seen = np.array([*MODEL.observation_colors, UNSEEN], np.uint8)[np.minimum(SEEN, 3)]
    assert (cells(image, 1) == seen).all()
    kept = believed(0, 1)
    for panel, shares in ((2, kept.belief[2]), (3, kept.entropy() / np.log(3))):
        lightness = cells(image, panel).astype(int).sum(axis=2).ravel()
        assert (np.diff(lightness[np.argsort(shares.ravel())]) <= 0).all()
        assert len(set(np.rint(shares * 23).ravel())) == len(set(lightness)) > 1
    assert all((image[TOP + 15, left + 15] == 0x14).all() for left in LEFTS), "the robot"


def test_a_film_shows_the_selected_steps(studio: Studio) -> None:
    for flags, millis in (
        (["--fps", 20], [50] * 4 + [1000]),
        (["--from", 1, "--to", 4, "--every", 2], [100, 1000]),
    ):
        assert studio.film(both(0, 1, 2, 3, 4), *flags) == ""
        with Image.open(studio.gif) as film:
            assert [it.info["duration"] for it in ImageSequence.Iterator(film)] == millis
            film.seek(0)
            first = np.asarray(film.convert("RGB"))
    still = studio.still(both(0, 1, 2, 3, 4))
    assert (still == first).all()


def test_missing_parts_are_left_out(studio: Studio) -> None:
    old = MODEL.toml.replace("[[kernel]]", '[[kernel]]\nown = "fire"')
    for model, with_truth, width, words in (
        (MODEL.toml, True, 676, ""),
        (MODEL.toml, False, 510, ""),
        (None, True, 400, "no belief, as the recording has no model that fits; give --model"),
        (old, True, 400, "no belief, as the recording has no model that fits; give --model"),
    ):
        server = replace(SERVER, model=model)
        said = studio.film(both(1, server=server)[not with_truth :], "--step", 1)
        assert words in said and bool(words) == bool(said)
        with Image.open(studio.png) as image:
            assert image.width == width


def test_a_hidden_model_can_be_passed_by_flag(studio: Studio, tmp_path: Path) -> None:
    file = tmp_path / "model.toml"
    file.write_text(MODEL.toml)
    hidden = replace(SERVER, model=None)
    given = studio.still(both(1, server=hidden), "--model", file)
    assert (studio.still(both(1)) == given).all()
    assert "no-such.toml" in studio.fails(both(1, server=hidden), "--model", "no-such.toml")


def test_recorded_worlds_have_the_colours_of_their_description(studio: Studio) -> None:
    colors = np.array([[0, 0, 255], [0, 255, 0], [255, 0, 255]], np.uint8)
    lines = ['name = "lab"', 'step = "1 h"']
    for kind, more in (("states", "observed_as = [0.2, 0.3, 0.5]"), ("observations", "")):
        for number, color in enumerate(colors):
            lines += [f'[[{kind}]]\nname = "{number}"\ncolor = "#{bytes(color).hex()}"', more]
    world = RecordedWorld(description="\n".join(lines), n_sequences=1, n_steps=9)
    image = studio.still(both(1, server=replace(SERVER, model=None, recorded_world=world)))
    assert (cells(image, 0) == colors[TRUTH]).all()
    assert (cells(image, 1)[SEEN < 255] == colors[SEEN[SEEN < 255]]).all()


def test_robots_that_hover_and_no_fly_cells_are_named() -> None:
    no_fly = SEEN == 2
    closed = replace(SERVER, airspace=Airspace(no_fly=no_fly))
    inks = []
    for server, hovered in ((SERVER, 0), (SERVER, 2), (SERVER, 6), (closed, 0)):
        (scene,) = played(frame(0, robots=3, hovered=hovered))
        page = Page(server, None, world=0, scale=SCALE, has_truth=False)
        below = np.asarray(page.draw(scene))[TOP + 30 :]
        inks.append((below != 255).sum())
    assert inks[0] < inks[1] < inks[2] and inks[0] < inks[3]


def test_a_recording_of_release_0_2_is_drawn_with_its_belief(studio: Studio) -> None:
    assert studio.film(OLD, "--step", 8) == ""
    with Image.open(studio.png) as image:
        assert image.width == 14 + 4 * (160 + 16) - 16 + 14, "four panels"


def test_cut_and_damaged_recordings_are_named(studio: Studio, tmp_path: Path) -> None:
    file, content = tmp_path / "lab.recording", OLD.read_bytes()
    file.write_bytes(content[:-20])
    words = studio.film(file)
    assert words.count("warning") == 1 and "cut short" in words
    file.write_bytes(content[:16] + bytes(40))
    assert "at byte 16" in studio.fails(file)
    toml = MODEL.toml.replace("[0.01, 0.01, 0.98]", "[0, 1, 0]")
    for before in ("[0.98, 0.01, 0.01]", "[0.80, 0.15, 0.05]"):
        toml = toml.replace(before, "[1, 0, 0]")
    impossible = both(0, server=replace(SERVER, model=toml))
    assert "step 0: frame: cell (1, 1): expected" in studio.fails(impossible)


#: Wrong flags, each with words of its error.
WRONG: list[tuple[list[object], str]] = [
    (["--world", 7], "--world: expected one of the recorded worlds: 0, got 7"),
    (["--step", 9], "expected some of the recorded steps, of which the last is 8, got 9 to 9"),
    (["--every", 0], "--every: expected a whole number, 1 or more, got 0"),
    (["--out", "lab.mp4"], "--out: expected a .gif, or with --step a .png, got lab.mp4"),
    (["--out", "/dev/null/a.gif"], "/dev/null"),
]


def test_wrong_flags_are_named(studio: Studio) -> None:
    for flags, words in WRONG:
        assert words in studio.fails(OLD, *flags)
    assert not studio.gif.exists() and not studio.png.exists()


def test_a_missing_pillow_names_the_extra(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "emberwatch.render.page", raising=False)
    monkeypatch.setitem(sys.modules, "PIL", None)
    assert "pip install emberwatch[film]" in studio.fails(OLD)
