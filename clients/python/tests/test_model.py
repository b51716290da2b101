"""Model files: read as the server reads them, or refused by name."""

import copy
import pickle
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import emberwatch
from emberwatch.errors import SettingError
from emberwatch.model import Model, ModelError
from emberwatch.programs import find

REPOSITORY = Path(__file__).parents[3]
CONFIG = REPOSITORY / "config/models"
WILDFIRE = (CONFIG / "wildfire.toml").read_text()
EDITS = ("", "nan", "-1", "1e999", "true", "[", "]", '"', "2020-01-01", "9" * 30, "x = 1\n", "\x00")


def refused(text: str, expected: str) -> None:
    with pytest.raises(ModelError) as error:
        Model.from_toml(text)
    assert expected in str(error.value)


def changed(old: str, new: str) -> str:
    assert old in WILDFIRE
    return WILDFIRE.replace(old, new, 1)


def test_names_are_those_of_the_programs() -> None:
    packaged = Path(emberwatch.__file__).parent / "models"
    names = {file.stem: file.read_bytes() for file in packaged.iterdir()}
    for name, file in names.items():
        assert file == (CONFIG / f"{name}.toml").read_bytes()
        assert Model.named(name).name == Model.named(Path(name)).name == name
    command = [find("emberwatch-agent"), "run", "--model=no/such"]
    words = subprocess.run(command, capture_output=True, text=True).stderr
    known = re.search(r"no/such: No such file: expected one, or (.*)", words)
    assert known is not None and set(known[1].split(", ")) == set(names)


def test_what_is_neither_a_name_nor_a_file_is_named(tmp_path: Path) -> None:
    words = "model: expected wildfire, .* or the path of a model file, got "
    for name, problem in (("ash", "No such file"), (tmp_path, "Is a directory")):
        with pytest.raises(SettingError, match=f"{words}'{name}': {problem}"):
            Model.named(name)
    assert Model.named(CONFIG / "road-ice.toml").name == "road-ice"


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


def test_road_ice_keeps_names_and_shapes() -> None:
    model = Model.read(CONFIG / "road-ice.toml")
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
        ('name = "wildfire"', "", "top level: expected the key 'name', got none"),
        ('name = "wildfire"', "name = 3", "name: expected a text, got int"),
        ("kernel_size", "kernel_sise", "expected the key 'kernel_size'"),
        ("kernel_size", 'author = "x"\nkernel_size', "only the keys name, kernel_size"),
        ("initial = 0.99\n", "", "states[0]: expected the key 'initial', got none"),
        ("initial = 0.99", "initial = 0.99\nodds = 1", "got 'odds'"),
        ("initial = 0.99", "initial = 0.5", "initial: expected a sum of 1, got 0.51"),
        ("initial = 0.99", "initial = nan", "'normal': initial: expected a finite number >= 0"),
        ("initial = 0.99", "initial = true", "initial: expected a number, got a boolean"),
        ("initial = 0.99", f"initial = {9**30}", "expected a number of 64 bits"),
        ("initial = 0.99", "initial = 0.99\nbias = -1.0", "'normal': bias: expected a finite"),
        ("initial = 0.99", "initial = 0.99\nbias = 1e101", "0, or a size of 1e-100 to 1e+100"),
        ("reward = 1.0", "reward = inf", "'fire': reward: expected a finite number, got inf"),
        ("reward = 1.0", "reward = -1e-320", "reward: expected 0, or a size of"),
        ("[0.80, 0.15, 0.05]", "[0.80, 0.15, 0.5]", "'latent': observed_as: expected a sum of 1"),
        ("[0.80, 0.15, 0.05]", "[0.80, 0.20]", "expected 3 probabilities, one per observation"),
        ("[0.80, 0.15, 0.05]", "[1.10, -0.15, 0.05]", "expected probabilities >= 0"),
        ("[0.80, 0.15, 0.05]", "0.8", "observed_as: expected a list of numbers, got float"),
        ('name = "latent"', 'name = "normal"', "state name: expected each name once"),
        ('name = "latent"', 'name = "explore"', "state name: expected letters, digits"),
        ('"#3b6ea5"', '"red"', "state 'normal': color: expected #rrggbb, got red"),
        ("[3, 3]", "[2, 3]", "kernel_size: expected two odd numbers up to 15, got [2, 3]"),
        ("[3, 3]", "[3, 17]", "expected two odd numbers up to 15"),
        ("[3, 3]", "[true, 3]", "expected two odd numbers up to 15"),
        ("[3, 3]", "[5, 3]", "expected 5 rows of 3 weights, got rows of [3, 3, 3]"),
        ('from = "normal"', 'from = "ash"', "states out of normal, latent, fire, got 'ash'"),
        ('to = "latent"', 'to = "normal"', "one entry for each pair of states, got two"),
        ("scale = 0.9999", "scale = -1", "from 'normal' to 'normal': expected finite weights >= 0"),
        ("[0.1, 1.0, 0.1]", "[0.1, nan, 0.1]", "expected finite weights >= 0, got nan"),
        ("scale = 0.9999", "scale = 1e-120", "expected 0, or a size of"),
        ("weights = [", "weights = 3 # [", "expected a list of rows, got int"),
        ("[[kernel]]", "[kernel]", "model file: expected TOML"),
    ],
)
def test_wrong_entries_are_refused_by_name(old: str, new: str, expected: str) -> None:
    refused(changed(old, new), expected)


def test_a_model_without_choice_is_refused() -> None:
    one = (
        'name = "one"\nkernel_size = [1, 1]\nkernel = []\n[[states]]\nname = "a"\ncolor = "#000000"'
    )
    entries = "initial = 1\nobserved_as = [1]\n[[observations]]\nname = 'y'\ncolor = '#000000'"
    refused(f"{one}\n{entries}", "states: expected 2 to 64, got 1")


def test_nesting_as_deep_as_a_file_can_be_is_refused() -> None:
    for opening, closing in ("[]", ("{a = ", "}")):
        refused("name = " + opening * 100_000 + "1" + closing * 100_000, "expected TOML")


@given(at=st.integers(0, len(WILDFIRE)), length=st.integers(0, 20), edit=st.sampled_from(EDITS))
def test_a_damaged_file_is_read_or_refused(at: int, length: int, edit: str) -> None:
    try:
        model = Model.from_toml(WILDFIRE[:at] + edit + WILDFIRE[at + length :])
    except ModelError:
        return
    assert np.isfinite(model.kernel).all()
    assert np.allclose(model.observation_matrix.sum(axis=1), 1)


def test_files_are_refused_with_their_path(tmp_path: Path) -> None:
    for content, expected in ((b"name = 3", "top level"), (b'name = "\xff"', "utf-8")):
        (tmp_path / "bad.toml").write_bytes(content)
        with pytest.raises(ModelError, match=rf"bad\.toml: .*{expected}"):
            Model.read(tmp_path / "bad.toml")
    with pytest.raises(FileNotFoundError):
        Model.read(tmp_path / "none.toml")


def test_an_endless_file_is_refused() -> None:
    with pytest.raises(ModelError, match="/dev/zero: expected at most 16777216 bytes"):
        Model.read("/dev/zero")


def test_the_documented_example_is_a_model() -> None:
    page = (REPOSITORY / "docs/model-file.md").read_text()
    example = page.split("```toml\n")[1].split("```")[0]
    assert Model.from_toml(example).bias.tolist() == [0.01, 0.0]


def test_weights_that_can_vanish_are_refused_on_the_grid_where_they_can() -> None:
    Model.wildfire().check_on(height=1, width=1)
    without_centre = Model.from_toml(WILDFIRE.replace("1.0, 0.1]", "0.0, 0.1]"))
    without_centre.check_on(height=5, width=9)
    with pytest.raises(ModelError, match=r"1 x 1 grid: .*cell \(0, 0\).* got 0;"):
        without_centre.check_on(height=1, width=1)
    faint = WILDFIRE.replace("scale = 0.99992", "scale = 1e-32").replace("= 0.001", "= 1e-33")
    with pytest.raises(ModelError, match="at least 1e-30 of the largest weight"):
        Model.from_toml(faint).check_on(height=4, width=4)
    biased = faint.replace("initial = 0.99", "initial = 0.99\nbias = 1e-6")
    Model.from_toml(biased).check_on(height=4096, width=4096)


def test_models_that_say_the_same_are_equal() -> None:
    model = Model.wildfire()
    same = Model.from_toml("# another text\n" + WILDFIRE)
    assert model == same and hash(model) == hash(same)
    assert copy.deepcopy(model) == pickle.loads(pickle.dumps(model)) == model
    assert Model.from_toml(model.toml) == model
    assert Model.from_toml(changed("reward = 1.0", "reward = 2.0")) != model
    assert model != "wildfire"
