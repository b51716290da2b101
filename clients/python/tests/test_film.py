"""Films of recordings: their scenes, their pictures, and their messages about missing records."""

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
from emberwatch.client import recording, wire
from emberwatch.model import Model
from emberwatch.render.film import main
from emberwatch.render.page import Page
from emberwatch.render.scenes import Scene, scenes

MODEL = Model.wildfire()
HEIGHT, WIDTH, SCALE = 3, 5, 10
#: Left and upper edges of the four panels in pixels: their columns are 150 wide and 16 apart.
LEFTS, TOP = [14, 180, 346, 512], 76
INFO = document.examples()[1] | {"height": HEIGHT, "width": WIDTH, "n_moves": 2, "n_worlds": 2}
INFO |= {"n_robots": 1, "deadline_millis": 0, "recorded_world": None, "burn_in": 9}
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
        self.file, self._capsys = folder / "lab.recording", capsys
        self.gif, self.png = folder / "new/lab.gif", folder / "new/lab.png"

    def record(self, records: list[bytes]) -> None:
        self.file.write_bytes(FILE_HEADER + b"".join(records) + end(records))

    def film(self, *flags: object) -> str:
        """Makes a film. Returns the text on standard error."""
        out = self.png if "--step" in flags else self.gif
        main([str(it) for it in (self.file, "--out", out, "--scale", SCALE, *flags)])
        return self._capsys.readouterr().err

    def fails(self, *flags: object) -> str:
        with pytest.raises(SystemExit):
            self.film(*flags)
        return self._capsys.readouterr().err

    def still(self, records: list[bytes], *flags: object) -> NDArray[np.uint8]:
        self.record(records)
        self.film("--step", 1, *flags)
        return np.asarray(Image.open(self.png))

    def scenes(self, *records: bytes) -> list[Scene]:
        self.record([server(), *records])
        return list(scenes(recording.read(self.file, world=0), lambda _: believed()))


@pytest.fixture
def studio(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Studio:
    return Studio(tmp_path, capsys)


def cells(image: NDArray[np.uint8], panel: int) -> NDArray[np.uint8]:
    """Returns the colour in the upper left corner of each cell of a panel, `(H, W, 3)`."""
    rows = TOP + SCALE * np.arange(HEIGHT)
    cols = LEFTS[panel] + SCALE * np.arange(WIDTH)
    return image[np.ix_(rows, cols)]


def believed(*n_predictions: int) -> Belief:
    """Returns the belief after a frame, after some predictions, and after each another frame."""
    kept = known(MODEL, prior=uniform_prior(MODEL, height=HEIGHT, width=WIDTH))
    for number, n in enumerate(n_predictions):
        if number > 0:
            kept.correct(SEEN)
        for _ in range(n):
            kept.predict()
    if n_predictions:
        kept.correct(SEEN)
    return kept


def test_the_belief_predicts_through_missing_steps(studio: Studio) -> None:
    first, second, last = studio.scenes(*both(0, 1, 4))
    assert [it.n_lost for it in (first, second, last)] == [0, 0, 2]
    for scene, n_predictions in ((first, [0]), (second, [0, 1]), (last, [0, 1, 3])):
        assert (scene.belief == believed(*n_predictions).belief).all()
        assert (scene.truth == TRUTH).all() and (scene.frame.frame == SEEN).all()
    assert (first.mean_reward, last.mean_reward) == (0.0, 2.0)


def test_the_belief_begins_anew_with_an_episode(studio: Studio) -> None:
    first, _, again = studio.scenes(*both(0, 1), frame(0, episode=1))
    assert (first.belief == again.belief).all()
    assert again.truth is None, "no hidden states of that step"


def test_other_worlds_and_repeated_records_are_skipped(studio: Studio) -> None:
    repeated = frame(0), frame(1), frame(1), frame(1, world=1), frame(2)
    assert [it.frame.result.step for it in studio.scenes(*repeated)] == [0, 1, 2]
    with pytest.warns(UserWarning, match="worlds of another kind follow"):
        assert len(studio.scenes(frame(0), server(pid=7, model=None), frame(1))) == 1
    assert len(studio.scenes(frame(0), server(pid=9), frame(0))) == 2


def test_panels_show_truth_frame_belief_and_entropy(studio: Studio) -> None:
    _, scene = studio.scenes(*both(0, 1))
    info = next(recording.read(studio.file)).server
    page = Page(info, MODEL, world=0, scale=SCALE, has_truth=True)
    image = np.asarray(page.draw(scene))
    assert (cells(image, 0) == np.array(MODEL.state_colors, np.uint8)[TRUTH]).all()
    seen = np.array([*MODEL.observation_colors, UNSEEN], np.uint8)[np.minimum(SEEN, 3)]
    assert (cells(image, 1) == seen).all()
    kept = believed(0, 1)
    for panel, shares in ((2, kept.belief[2]), (3, kept.entropy() / np.log(3))):
        lightness = cells(image, panel).astype(int).sum(axis=2).ravel()
        assert (np.diff(lightness[np.argsort(shares.ravel())]) <= 0).all()
        assert len(set(np.rint(shares * 23).ravel())) == len(set(lightness)) > 1
    middle = TOP + SCALE + SCALE // 2, SCALE + SCALE // 2
    assert all((image[middle[0], left + middle[1]] == 0x14).all() for left in LEFTS), "the robot"


def test_a_film_shows_the_selected_steps(studio: Studio) -> None:
    studio.record([server(), *both(0, 1, 2, 3, 4)])
    for flags, millis in (
        (["--fps", 20], [50] * 4 + [1000]),
        (["--from", 1, "--to", 4, "--every", 2], [100, 1000]),
    ):
        assert studio.film(*flags) == ""
        with Image.open(studio.gif) as film:
            assert [it.info["duration"] for it in ImageSequence.Iterator(film)] == millis
            film.seek(0)
            first = np.asarray(film.convert("RGB"))
    studio.film("--step", 1)
    still = np.asarray(Image.open(studio.png))
    assert np.abs(still.astype(int) - first).max() <= 4, "a film has fewer colours"


def test_missing_parts_are_left_out(studio: Studio) -> None:
    widths: list[int] = []
    old = MODEL.toml.replace("[[kernel]]", '[[kernel]]\nown = "fire"')
    for records, words in (
        ([server(), *both(1)], ""),
        ([server(), frame(1)], ""),
        ([server(model=None), *both(1)], "the belief is left out, as the server hid its model"),
        ([server(model=old), frame(1)], "left out, as the model has a form of an earlier release"),
    ):
        studio.record(records)
        said = studio.film("--step", 1)
        assert words in said and bool(words) == bool(said)
        with Image.open(studio.png) as image:
            widths.append(image.width)
    assert widths == [676, 510, 400, 400]


def test_a_hidden_model_can_be_passed_by_flag(studio: Studio, tmp_path: Path) -> None:
    file = tmp_path / "model.toml"
    file.write_text(MODEL.toml)
    plain, hidden = ([server(**it), *both(1)] for it in ({}, {"model": None}))
    assert (studio.still(plain) == studio.still(hidden, "--model", file)).all()
    studio.record([server(model=None, n_observations=4), *both(1)])
    error = studio.fails("--model", file)
    assert "--model: expected one with 4 observations, as recorded, got 3" in error


def test_recorded_worlds_have_the_colours_of_their_description(studio: Studio) -> None:
    colors = np.array([[0, 0, 255], [0, 255, 0], [255, 0, 255]], np.uint8)
    lines = ['name = "lab"', 'step = "1 h"']
    for kind, more in (("states", "observed_as = [0.2, 0.3, 0.5]"), ("observations", "")):
        for number, color in enumerate(colors.tolist()):
            hexadecimal = "".join(f"{channel:02x}" for channel in color)
            lines += [f"[[{kind}]]", f'name = "{number}"', f'color = "#{hexadecimal}"', more]
    recorded = {"description": "\n".join(lines), "n_sequences": 1, "n_steps": 9}
    image = studio.still([server(model=None, recorded_world=recorded), *both(1)])
    assert (cells(image, 0) == colors[TRUTH]).all()
    seen = SEEN < 255
    assert (cells(image, 1)[seen] == colors[SEEN[seen]]).all()


def test_a_recording_of_release_0_2_is_drawn_with_its_belief(tmp_path: Path) -> None:
    film = tmp_path / "old.png"
    main([str(OLD), "--step", "8", "--scale", "10", "--out", str(film)])
    with Image.open(film) as image:
        assert image.width == 14 + 4 * (160 + 16) - 16 + 14, "four panels"


def test_a_cut_recording_is_shown_up_to_the_cut(studio: Studio) -> None:
    studio.record([server(), frame(0), frame(1), frame(2)])
    studio.file.write_bytes(studio.file.read_bytes()[:-150])
    words = studio.film()
    assert words.count("warning") == 1 and "cut short" in words


#: Wrong flags, each with words of its error.
WRONG: list[tuple[list[object], str]] = [
    (["--world", 7], "--world: expected one of the recorded worlds: 0, 1, got 7"),
    (["--step", 9], "expected some of the recorded steps, of which the last is 4, got 9 to 9"),
    (["--every", 0], "--every: expected 1 to inf, got 0"),
    (["--fps", "fast"], "--fps: expected 0.1 to 50, got fast"),
    (["--out", "lab.mp4"], "--out: expected a .gif, or with --step a .png, got lab.mp4"),
    (["--step", 1, "--out", "a.gif"], "--out: expected a .gif, or with --step a .png"),
    (["--out", "/dev/null/a.gif"], "/dev/null"),
]


def test_wrong_flags_are_named(studio: Studio) -> None:
    studio.record([server(), frame(0), frame(1), frame(1, world=1), frame(4)])
    for flags, words in WRONG:
        assert words in studio.fails(*flags)
    assert not studio.gif.exists() and not studio.png.exists()


def test_invalid_recordings_are_named(studio: Studio) -> None:
    studio.record([b"\0" * 40])
    assert "at byte 16" in studio.fails()
    toml = MODEL.toml.replace("[0.01, 0.01, 0.98]", "[0, 1, 0]")
    for before in ("[0.98, 0.01, 0.01]", "[0.80, 0.15, 0.05]"):
        toml = toml.replace(before, "[1, 0, 0]")
    studio.record([server(model=toml), frame(0)])
    assert "step 0: frame: cell (1, 1): expected" in studio.fails()


def test_a_missing_pillow_names_the_extra(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "emberwatch.render.page", raising=False)
    monkeypatch.setitem(sys.modules, "PIL", None)
    studio.record([server(), frame(0)])
    assert "pip install emberwatch[film]" in studio.fails()


def test_robots_that_did_not_fly_and_no_fly_cells_are_named(studio: Studio) -> None:
    team = server(n_robots=3, model=None)
    airspace = {"radius": 0, "no_fly": [[0, 0, 0, 0, 1]] * HEIGHT}
    images = [
        studio.still([team, frame(1, robots=3)]),
        studio.still([team, frame(1, robots=3, hovered=2)]),
        studio.still([team, frame(1, robots=3, hovered=2, late=4)]),
    ]
    inks = [(image[-20:] != 255).sum() for image in images]
    assert inks[0] == 0 < inks[1] < inks[2]
    legend = studio.still([server(n_robots=3, model=None, airspace=airspace), frame(1, robots=3)])
    assert (legend[TOP + 30 : -20] != 255).sum() > (images[0][TOP + 30 : -20] != 255).sum()
