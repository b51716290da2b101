"""Model files: Python reads what the server accepts, and refuses the rest with its errors."""

import copy
import pickle
import tomllib
from pathlib import Path

import numpy as np
import pytest
from failures import refuses

from emberwatch._native import built_in
from emberwatch.model import Model

REPOSITORY = Path(__file__).parents[3]
CONFIG = REPOSITORY / "config/models"
WILDFIRE = (CONFIG / "wildfire.toml").read_text()


def read(folder: Path, text: str | bytes) -> Model:
    path = folder / "model.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return Model.named(path)


def changed(old: str, new: str) -> str:
    assert old in WILDFIRE
    return WILDFIRE.replace(old, new, 1)


def test_built_in_models_have_the_names_of_their_files() -> None:
    assert built_in("models").keys() == {file.stem for file in CONFIG.glob("*.toml")}
    for name in built_in("models"):
        assert Model.named(name).name == Model.named(Path(name)).name == name


def test_the_edge_is_the_state_of_cells_outside_the_grid() -> None:
    model, closed = Model.wildfire(), Model.from_toml(f'edge = "fire"\n{WILDFIRE}')
    assert model.edge is None and closed.edge == 2
    assert model != closed


@pytest.mark.parametrize("name", ["wildfire", "wildfire-terrain"])
def test_fields_equal_the_file(name: str) -> None:
    model, file = Model.named(name), tomllib.loads((CONFIG / f"{name}.toml").read_text())
    matrix = np.array([state["observed_as"] for state in file["states"]])
    np.testing.assert_allclose(model.observation_matrix, matrix, rtol=1e-15)
    assert model.initial.tolist() == [state["initial"] for state in file["states"]]
    assert model.state_names == tuple(state["name"] for state in file["states"])
    if name == "wildfire":
        assert model.kernel is not None and model.kernel.shape == (3, 3, 3, 3)
        for entry in file["kernel"]:
            to, start = (model.state_names.index(entry[key]) for key in ("to", "from"))
            weights = entry.get("scale", 1.0) * np.array(entry["weights"])
            np.testing.assert_allclose(model.kernel[to, start], weights, rtol=1e-15)
        assert model.bias is not None
        assert model.bias.tolist() == [state.get("bias", 0.0) for state in file["states"]]
        assert (model.transitions, model.maps) == ((), {})
        return
    assert (model.kernel, model.bias) == (None, None)
    for got, entry in zip(model.transitions, file["transitions"], strict=True):
        assert (got.from_, got.to) == (entry["from"], entry["to"])
        assert (got.base, dict(got.near)) == (entry.get("base", 0.0), entry.get("near", {}))
        assert list(got.times) == entry.get("times", [])
    with np.load(CONFIG / file["maps"]) as maps:
        assert model.maps.keys() == set(maps.files)
        for each, factors in model.maps.items():
            assert np.array_equal(factors, maps[each]) and not factors.flags.writeable


def test_models_with_equal_contents_are_equal() -> None:
    model = Model.wildfire()
    same = Model.from_toml("# another text\n" + WILDFIRE)
    assert model == same and hash(model) == hash(same)
    assert copy.deepcopy(model) == pickle.loads(pickle.dumps(model)) == model
    assert Model.from_toml(model.toml) == model
    assert Model.from_toml(changed("reward = 1.0", "reward = 2.0")) != model
    assert model != "wildfire"


def test_files_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    model = read(tmp_path, WILDFIRE.replace("\n", "\r\n").encode("utf-8-sig"))
    assert model == Model.wildfire() and not model.toml.startswith("\ufeff")


def test_invalid_models_are_refused_with_the_servers_error(tmp_path: Path) -> None:
    path = tmp_path / "model.toml"
    path.write_text(changed("initial = 0.99", "initial = 0.5"))
    for name, words in (
        ("ash", "model file ash: No such file .*: expected a file, or one of .*wildfire, "),
        (path, r"model\.toml: .*initial: expected a sum of 1, got 0.51"),
        ("/dev/zero", "/dev/zero: .*16777216 bytes"),
    ):
        with refuses(words):
            Model.named(name)
    with refuses("emberwatch-server --check"):
        Model.from_toml("name = 3")
