"""Sensors that see beyond the path, no-fly cells and maps, checked by loops over all cells."""

import copy
import pickle
import warnings
from itertools import product
from pathlib import Path
from typing import Any

import land
import numpy as np
import pytest
from environments import (
    LIVELY,
    MOVES,
    RECORDED,
    WILDFIRE,
    actions,
    assert_same,
    make,
    rollout,
    serving,
)
from failures import refuses
from gymnasium.utils.env_checker import check_env

from emberwatch._native import Flights
from emberwatch.model import Description, Model
from emberwatch.model.airspace import Airspace

SHAPE = (7, 5)
ALL_MOVES = (
    *("frame", "robot", "age", "belief", "local", "recent", "visited", "move"),
    "action_mask",
)


@pytest.fixture
def seeing(tmp_path: Path) -> Any:
    """Writes a model file of `land.model`. Returns the keyword arguments of its worlds."""

    def written(**keys: Any) -> dict[str, Any]:
        path = tmp_path / "model.toml"
        path.write_text(land.model(**{"no_fly": land.NO_FLY, **keys}))
        return {"model": path, "start": "2,2", "n_moves": 6}

    return written


def test_moves_lead_where_the_server_reports(seeing: Any) -> None:
    keywords = seeing(radius=1)
    paths = make(**keywords, truth=True)
    late, early = (
        make(
            MOVES, **keywords, truth=True, reward=reward, observation=("frame", "robot", "visited")
        )
        for reward in ("share", "move")
    )
    expected = paths.reset(seed=6)
    begun = [env.reset(seed=6)[0] for env in (late, early)]
    assert_same(begun[0], begun[1])
    truth, cell = expected[1]["truth"], (2, 2)
    for path in actions(paths, 40):
        expected = paths.step(path)
        paid, cells = set[tuple[int, int]](), land.cells_of(cell, path, land.NO_FLY)
        total = 0.0
        for index, move in enumerate(path):
            got, other = late.step(move), early.step(move)
            assert_same(got[0], other[0])
            assert tuple(got[0]["robot"]) == cells[index + 1]
            total += other[1]
            if index < 5:
                visited = np.argwhere(got[0]["visited"][..., 0]).tolist()
                assert set(map(tuple, visited)) == set(cells[1 : index + 2])
                now = {cells[index + 1]} - paid
                assert other[1] == sum(truth[at] == 2 for at in now)
                paid |= now
        for part in ("frame", "robot"):
            assert_same(got[0][part], expected[0][part])
        assert got[1:4] == expected[1:4] and total == pytest.approx(expected[1])
        truth, cell = expected[4]["truth"], cells[-1]


def test_windows_show_what_can_still_be_found(seeing: Any) -> None:
    parts = {"observation": ("local", "recent", "belief", "robot"), "window": 5}
    env = make(MOVES, **seeing(radius=1), **parts)
    seen, _ = env.reset(seed=1)
    assert seen["recent"].shape == (5, 5, 3 + 3)
    for path in np.array(actions(env, 60)).reshape(10, 6):
        visited: list[tuple[int, int]] = []
        fire = seen["belief"][..., 2]
        for move in path[:-1]:
            seen = env.step(move)[0]
            row, col = seen["robot"].tolist()
            visited.append((row, col))
            for at in product(range(5), repeat=2):
                cell = row + at[0] - 2, col + at[1] - 2
                is_on_grid = 0 <= cell[0] < 7 and 0 <= cell[1] < 5
                for part in ("local", "recent"):
                    flown, off = seen[part][at][-3:-1]
                    assert flown == 255 * (cell in visited)
                    assert off == 255 * (not is_on_grid or land.NO_FLY[cell])
                if is_on_grid:
                    assert seen["local"][at][0] == (0 if cell in visited else fire[cell])
        seen = env.step(path[-1])[0]


@pytest.mark.parametrize("name", [WILDFIRE, MOVES])
def test_airspace_passes_the_checker_and_equals_a_servers(seeing: Any, name: str) -> None:
    keywords = seeing(radius=2)
    parts = ALL_MOVES if name == MOVES else ("frame", "image", "robot", "age", "belief")
    here = make(name, **keywords, observation=parts)
    check_env(make(name, **keywords).unwrapped, skip_render_check=True)
    flags = {"model": keywords["model"], "start": "2,2", "moves": 6}
    with serving(**flags) as instance:
        running = make(name, instance=instance, observation=parts)
        assert running.observation_space == here.observation_space
        assert running.unwrapped.world_spec == here.unwrapped.world_spec
        assert_same(rollout(running, 60, seed=5), rollout(here, 60, seed=5))
        for env in (running, here):
            info = env.unwrapped.lease.client.info
            assert info.airspace.no_fly.tolist() == land.NO_FLY.tolist() and hash(info)


def test_a_radius_can_be_combined_with_a_model() -> None:
    wide = make(sensor_radius=8)
    assert wide.unwrapped.model.airspace.radius == 8
    assert (rollout(wide, 1, seed=1)[1][0]["frame"] != 255).sum() > 30
    assert make(sensor_radius=-1).unwrapped.model == make().unwrapped.model
    with serving(sensor_radius=2) as instance:
        for radius in (None, 2):
            env = make(instance=instance, sensor_radius=radius)
            assert env.unwrapped.world_spec.airspace == Airspace(radius=2)
            assert env.unwrapped.model.airspace.radius == 2
        with refuses("sensor_radius: expected the server's 2, or None, got 1"):
            make(instance=instance, sensor_radius=1)
    with serving(sensor_radius=2, reveal_model=False) as instance:
        env = make(instance=instance, model=LIVELY)
        assert env.unwrapped.model.airspace.radius == 2


def test_recorded_worlds_support_sensor_radius(tmp_path: Path) -> None:
    path = tmp_path / "lab.npy"
    np.save(path, np.random.default_rng(1).integers(0, 3, (20, *SHAPE), np.uint8))
    text = f"sensor = {{ radius = 2 }}\nno_fly = {land.NO_FLY.astype(int).tolist()}\n"
    path.with_suffix(".toml").write_text(text + RECORDED.read_text())
    of_states = dict.fromkeys(("height", "width", "burn_in", "model"))
    keywords = {**of_states, "states": path, "start": "2,2", "observation": ("image", "recent")}
    for radius, expected in ((None, 2), (0, 0)):
        spec = make(MOVES, **keywords, sensor_radius=radius).unwrapped.world_spec
        assert spec.airspace.radius == spec.description.airspace.radius == expected


def test_a_model_has_the_contents_of_its_file(tmp_path: Path) -> None:
    whole = Model.from_toml(land.model(radius=3, no_fly=land.NO_FLY))
    assert whole.airspace.radius == 3
    assert whole.airspace.no_fly is not None and whole.airspace.no_fly.dtype == np.bool_
    assert np.array_equal(whole.airspace.no_fly, land.NO_FLY)
    assert whole.observation_names == ("normal", "latent", "fire")
    assert whole.observation_colors == whole.state_colors
    # A map in a file next to the model file equals a map in it.
    path = tmp_path / "model.toml"
    path.write_text(land.model(radius=3, no_fly="no_fly.npy"))
    np.save(tmp_path / "no_fly.npy", land.NO_FLY)
    beside = Model.named(path)
    assert beside == whole == Model.from_toml(beside.toml) == copy.deepcopy(whole)
    assert whole != Model.from_toml(land.model(radius=3))
    with refuses("emberwatch-server --check"):
        Model.from_toml(path.read_text())
    plain = Model.wildfire()
    assert (plain.airspace, plain.maps) == (Airspace(), {})
    assert plain.with_radius(0) is plain
    assert whole.with_radius(1).with_radius(3) == whole
    with refuses("radius: expected an integer within 0 to 8, got 9"):
        plain.with_radius(9)
    described = Description.from_toml(RECORDED.read_text())
    assert described.with_radius(4).airspace == Airspace(radius=4)


def test_a_model_carries_its_maps(tmp_path: Path) -> None:
    path = land.write_hazards(tmp_path, 1)
    model = Model.named(path)
    for name, expected in land.maps(1).items():
        assert np.array_equal(model.maps[name], expected)
    (tmp_path / "land.npz").unlink()
    copies = Model.from_toml(model.toml), copy.deepcopy(model), pickle.loads(pickle.dumps(model))
    for same in copies:
        assert same == model and np.array_equal(same.maps["wind"], model.maps["wind"])
    for given in (model, model.toml):
        assert make(model=given, height=7, width=5).unwrapped.model == model
    land.write_hazards(tmp_path, 2)
    assert Model.named(path) != model


def test_an_invalid_airspace_is_refused() -> None:
    for keywords, words in (
        ({"radius": 9}, "radius: expected an integer within 0 to 8, got 9"),
        ({"no_fly": np.zeros(3, bool)}, r"no_fly: expected .* \(H, W\) and type bool"),
        ({"no_fly": np.zeros((3, 3))}, r"no_fly: expected .* \(H, W\) and type bool"),
    ):
        with refuses(words):
            Airspace(**keywords)
    with refuses(r"no_fly: expected shape \(7, 5\), got \(5, 7\)"):
        Flights(1, 7, 5, 4, None, Airspace(no_fly=np.zeros((5, 7), bool)))


def test_an_enclosed_start_causes_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "pocket.toml"
    path.write_text(
        "no_fly = [[0, 0, 1, 0, 0, 0], [1, 1, 1, 0, 0, 0]]\n" + Model.named("wildfire-small").toml
    )
    pocket = {"model": path, "height": 2, "width": 6, "n_moves": 4, "burn_in": 0}
    words = r"start: no-fly cells enclose \(0, 0\): .* reach 2 of 8 free cells"
    with pytest.warns(UserWarning, match=words):
        env = make(**pocket, start="0,0")
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        env.reset(seed=1)
        make(**pocket, start="1,4").reset(seed=1)
    assert not [each for each in found if "start" in str(each.message)], "once, when it is made"
