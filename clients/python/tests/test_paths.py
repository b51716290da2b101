"""Paths with characters that the locale, or UTF-8, cannot encode."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import LIVELY, RECORDED, WILDFIRE, make, serving
from failures import refuses
from rasters import geotiff

import emberwatch
from emberwatch.model import Model

#: A locale of ASCII only, and a locale of strict UTF-8 output.
PLAIN = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
STRICT = {"LC_ALL": "C.UTF-8", "PYTHONIOENCODING": "utf-8:strict"}
LATIN = os.fsdecode(b"fire \xe9")
EXPECTED = "expected UTF-8, and a locale that has its letters, such as LC_ALL=C.UTF-8, got "

TASK = """
name = "mine"
model = "m.toml"
height = 4
width = 4
moves = 2
max_steps = 9
test_seeds = { start = 0, end = 1 }
"""

USE = """
import sys, gymnasium, emberwatch
from emberwatch.model import Model
folder, instance = sys.argv[1:]
Model.named(f"{folder}/m.toml")
of_model = {"model": f"{folder}/m.toml", "height": 7}
for keywords in ({"states": f"{folder}/fire.npz"}, of_model, {"task": f"{folder}/t.toml"}):
    gymnasium.make("emberwatch/Wildfire-v0", **keywords).close()
with emberwatch.connect(instance) as client, client.acquire(takeover=True) as lease:
    client.snapshot(f"{folder}/a.snapshot")
    lease.restore(f"{folder}/a.snapshot")
try:
    gymnasium.make("emberwatch/Wildfire-v0", states=f"{folder}/none.npz")
except emberwatch.EmberwatchError as error:
    print(ascii(str(error)))
"""


def run(locale: dict[str, str], *arguments: object) -> tuple[int, str, str]:
    command = [sys.executable, *map(os.fsencode, map(str, arguments))]
    done = subprocess.run(command, env=os.environ | locale, capture_output=True)
    return done.returncode, os.fsdecode(done.stdout), os.fsdecode(done.stderr)


def filled(folder: Path) -> Path:
    folder.mkdir()
    np.savez(folder / "fire.npz", states=np.eye(4, dtype=np.uint8)[None].repeat(3, axis=0))
    shutil.copy(RECORDED, folder / "fire.toml")
    shutil.copy(LIVELY, folder / "m.toml")
    (folder / "t.toml").write_text(TASK)
    return folder


def test_worlds_load_from_any_folder_in_any_locale(tmp_path: Path) -> None:
    folder = filled(tmp_path / "fire \xe9")
    with serving() as instance:
        for locale in (PLAIN, STRICT):
            code, out, err = run(locale, "-c", USE, folder, instance)
            assert (code, err) == (0, "")
            assert "/fire \\xe9/none.npz: No such file" in out


@pytest.mark.parametrize("locale", [PLAIN, STRICT], ids=["plain", "strict"])
def test_rasters_load_from_any_folder_in_any_locale(locale: dict[str, str], tmp_path: Path) -> None:
    folder, latin = tmp_path / "fire \xe9", tmp_path / LATIN
    folder.mkdir(), latin.mkdir()
    shutil.copy(geotiff(folder / "a.tif"), latin / "a.tif")
    flags = "--kind=arrival", "--unit=min", "--step=10 min", "--burning=2", "--out"
    command = "-m", "emberwatch.landscape"
    out = folder / "fire \xe9.npz"
    code, said, err = run(locale, *command, folder / "a.tif", *flags, out)
    assert (code, err) == (0, "") and str(out) in said
    assert f'name = "{out.stem}"' in out.with_suffix(".toml").read_text("utf-8")
    for subject, file, out in (
        ("file", latin / "a.tif", latin / "b.npz"),
        ("--out", folder / "a.tif", latin / f"{LATIN}.npz"),
    ):
        code, _, err = run(locale, *command, file, *flags, out)
        (line,) = err.splitlines()
        assert (code, f": {subject}: {EXPECTED}" in line) == (2, True)


def test_a_folder_that_is_not_utf_8_has_usable_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / LATIN
    folder.mkdir()
    shutil.copy(LIVELY, folder / "mine.toml")
    monkeypatch.chdir(folder)
    env = make(model="mine.toml")
    env.reset(seed=1)
    assert env.spec.kwargs["model"] == "mine.toml"


def test_paths_that_are_not_utf_8_are_refused() -> None:
    with serving() as instance, emberwatch.connect(instance) as client, client.acquire() as lease:
        for name in (LATIN, "a\0b"):
            calls: list[tuple[str, Callable[[], Any]]] = [
                ("states", lambda: gymnasium.make(WILDFIRE, states=f"{name}.npz")),  # noqa: B023
                ("^model", lambda: Model.named(f"{name}.toml")),  # noqa: B023
                ("path", lambda: client.snapshot(name)),  # noqa: B023
                ("path", lambda: lease.restore(name)),  # noqa: B023
            ]
            for subject, call in calls:
                with refuses(f"{subject}: {EXPECTED}"):
                    call()
