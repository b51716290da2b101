"""Model files: what the server accepts is read, what it refuses is told in its words."""

import copy
import pickle
import re
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import oracle
import pytest
from failures import refuses
from hypothesis import given
from hypothesis import strategies as st
from processes import find

from emberwatch._native import built_in
from emberwatch.envs.path_env import WildfireEnv
from emberwatch.errors import InvalidArgumentError
from emberwatch.model import Model

REPOSITORY = Path(__file__).parents[3]
CONFIG = REPOSITORY / "config/models"
WILDFIRE = (CONFIG / "wildfire.toml").read_text()
EDITS = ("", "nan", "-1", "1e999", "true", "[", "]", '"', "2020-01-01", "9" * 30, "x = 1\n", "\x00")


def read(folder: Path, text: str | bytes) -> Model:
    """The model of a file with this text, which the server checks."""
    path = folder / "model.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return Model.named(path)


def refused(folder: Path, text: str | bytes, expected: str) -> None:
    with refuses(r"model\.toml") as error:
        read(folder, text)
    assert expected in str(error.value)


def changed(old: str, new: str) -> str:
    assert old in WILDFIRE
    return WILDFIRE.replace(old, new, 1)


def test_names_are_those_of_the_programs() -> None:
    names = built_in("models")
    for name, text in names.items():
        assert text == (CONFIG / f"{name}.toml").read_text()
        assert Model.named(name).name == Model.named(Path(name)).name == name
    command = [find("emberwatch-agent"), "run", "--model=no/such"]
    words = subprocess.run(command, capture_output=True, text=True).stderr
    known = re.search(r"no/such: No such file: expected one, or (.*)", words)
    assert known is not None and set(known[1].split(", ")) == set(names)


def test_what_is_neither_a_name_nor_a_file_is_named(tmp_path: Path) -> None:
    for name, problem in (("ash", "No such file"), (tmp_path, "Is a directory")):
        with refuses(f"model file {name}: {problem}"):
            Model.named(name)
    with refuses("expected one, or .*wildfire, "):
        Model.named("ash")


def test_wildfire_has_the_published_parameters() -> None:
    # Paper section II and the authors' code: g = 0.1, a0 = 0.9999, a1 = 0.99992, a2 = 0.999.
    model = Model.wildfire()
    around = np.array([[0.1, 0.1, 0.1], [0.1, 1.0, 0.1], [0.1, 0.1, 0.1]])
    drift = np.array([[0.12, 0.12, 0.12], [0.1, 1.0, 0.1], [0.08, 0.08, 0.08]])
    kernel = np.zeros((3, 3, 3, 3))
    kernel[0, 0], kernel[0, 2] = 0.9999 * around, (1 - 0.9999) * around
    kernel[1, 1], kernel[1, 0] = 0.99992 * around, (1 - 0.99992) * around
    kernel[2, 2], kernel[2, 1] = 0.999 * drift, (1 - 0.999) * around
    np.testing.assert_allclose(model.kernel, kernel, atol=1e-12)
    assert model.bias.tolist() == [0, 0, 0]
    assert model.observation_matrix[1].tolist() == [0.80, 0.15, 0.05]
    assert model.initial.tolist() == [0.99, 0.01, 0]
    assert model.reward.tolist() == [0, 0, 1]
    assert model.target_state == 2
    assert model.state_names == model.observation_names == ("normal", "latent", "fire")
    assert model.state_colors[2] == model.observation_colors[2] == (0xC8, 0x37, 0x1B)


def test_the_edge_is_the_state_of_cells_outside_the_grid() -> None:
    model, closed = Model.wildfire(), Model.from_toml(f'edge = "fire"\n{WILDFIRE}')
    assert model.edge is None and closed.edge == 2
    assert model != closed


@pytest.mark.parametrize("file", sorted(CONFIG.iterdir()), ids=lambda file: file.stem)
def test_files_are_read_as_the_oracle_reads_them(file: Path) -> None:
    model, expected = Model.from_toml(file.read_text()), oracle.parameters(file.read_text())
    got = model.kernels, model.bias, model.observation_matrix, model.initial
    for one, other in zip(got, expected[:4], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-15)


def test_road_ice_keeps_names_and_shapes() -> None:
    model = Model.named(CONFIG / "road-ice.toml")
    assert model.name == "road-ice"
    assert model.kernel.shape == (4, 4, 5, 5)
    assert model.observation_matrix.shape == (4, 3)
    assert model.target_state == model.state_names.index("ice")
    # w[to, from, row, col]: wet cells above weigh .11, those below .09.
    assert model.kernel[1, 1, 1, 2] == pytest.approx(0.992 * 0.11)
    assert model.kernel[1, 1, 3, 2] == pytest.approx(0.992 * 0.09)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('name = "wildfire"', "", "missing field `name`"),
        ('name = "wildfire"', "name = 3", "at line 7, column 8"),
        ("kernel_size", "kernel_sise", "unknown field `kernel_sise`"),
        ("initial = 0.99", "initial = 0.5", "initial: expected a sum of 1, got 0.51"),
        ("initial = 0.99", "initial = nan", 'state "normal": initial: expected a finite number'),
        ("[0.80, 0.15, 0.05]", "[0.80, 0.20]", "expected 3 probabilities, one per observation"),
        ('"#3b6ea5"', '"red"', "color: expected #rrggbb, got red"),
        ("[3, 3]", "[5, 3]", "expected 5 rows of 3 weights, got rows of [3, 3, 3]"),
        ("scale = 0.9999", "scale = -1", "expected finite weights >= 0, got -0.1"),
        ("[[kernel]]", "[kernel]", "TOML parse error"),
    ],
)
def test_the_server_s_words_say_what_is_wrong(
    tmp_path: Path, old: str, new: str, expected: str
) -> None:
    refused(tmp_path, changed(old, new), expected)


def test_nesting_as_deep_as_a_file_can_be_is_refused(tmp_path: Path) -> None:
    for opening, closing in ("[]", ("{a = ", "}")):
        text = "name = " + opening * 100_000 + "1" + closing * 100_000
        refused(tmp_path, text, "model file")
        with refuses("emberwatch-server --check"):
            Model.from_toml(text)


@given(at=st.integers(0, len(WILDFIRE)), length=st.integers(0, 20), edit=st.sampled_from(EDITS))
def test_a_damaged_file_is_read_or_refused(at: int, length: int, edit: str) -> None:
    text = WILDFIRE[:at] + edit + WILDFIRE[at + length :]
    try:
        with tempfile.TemporaryDirectory() as folder:
            model = read(Path(folder), text)
    except InvalidArgumentError as error:
        # Weights that may vanish are named with the model and the grid, not with the file.
        assert "model.toml" in str(error) or "transition weights of cell" in str(error)
        return
    assert np.isfinite(model.kernel).all()
    assert np.allclose(model.observation_matrix.sum(axis=1), 1)


@pytest.mark.parametrize(
    "text", ["", "name = 3", 'states = "ash"\nobservations = []', changed('"#3b6ea5"', "7")]
)
def test_a_text_that_no_server_accepts_is_refused(text: str) -> None:
    with refuses("emberwatch-server --check"):
        Model.from_toml(text)


def test_files_are_refused_with_their_path(tmp_path: Path) -> None:
    refused(tmp_path, b'name = "\xff"', "UTF-8")
    with refuses("none.toml: No such file"):
        Model.named(tmp_path / "none.toml")


def test_an_endless_file_is_refused() -> None:
    with refuses("/dev/zero: .*16777216 bytes"):
        Model.named("/dev/zero")


def test_the_documented_example_is_a_model() -> None:
    page = (REPOSITORY / "docs/model-file.md").read_text()
    example = page.split("```toml\n")[1].split("```")[0]
    assert Model.from_toml(example).bias.tolist() == [0.01, 0.0]


def test_weights_that_can_vanish_are_refused_on_the_grid_where_they_can(tmp_path: Path) -> None:
    path = tmp_path / "model.toml"
    path.write_text(WILDFIRE.replace("1.0, 0.1]", "0.0, 0.1]"))
    small = {"n_moves": 4, "burn_in": 0, "model": path}
    WildfireEnv(height=5, width=9, **small)
    with refuses(r"1 x 1 grid: .*cell \(0, 0\)"):
        WildfireEnv(height=1, width=1, **small)


def test_models_that_say_the_same_are_equal() -> None:
    model = Model.wildfire()
    same = Model.from_toml("# another text\n" + WILDFIRE)
    assert model == same and hash(model) == hash(same)
    assert copy.deepcopy(model) == pickle.loads(pickle.dumps(model)) == model
    assert Model.from_toml(model.toml) == model
    assert Model.from_toml(changed("reward = 1.0", "reward = 2.0")) != model
    assert model != "wildfire"
