"""The agent's event files for TensorBoard, read by TensorBoard itself."""

import csv
import subprocess
from pathlib import Path
from typing import Any

import pytest
from processes import find
from tensorboard.backend.event_processing import event_accumulator

WORLDS = "--height 6 --width 9 --moves 5 --burn-in 60".split()
SETTINGS = """[learning]
window = 2
streams = 4
block_windows = 2
explore_steps = 40
updates_per_step = 1.0
"""


def agent(*words: object) -> None:
    program = [find("emberwatch-agent"), *map(str, words)]
    subprocess.run(program, check=True, timeout=60)


def train(folder: Path, *words: object) -> None:
    config = folder.parent / "agent.toml"
    config.write_text(SETTINGS)
    agent("train", "--config", config, "--out", folder, "--worlds", 2, *WORLDS, *words)


def read(folder: Path) -> Any:
    events = event_accumulator.EventAccumulator(
        str(folder), size_guidance={"scalars": 0, "images": 0}
    )
    return events.Reload()


def scalars(folder: Path, name: str) -> dict[int, float]:
    events = read(folder).Scalars(name)
    assert [event.step for event in events] == sorted({event.step for event in events})
    return {event.step: event.value for event in events}


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def averages(folder: Path, name: str) -> dict[int, float]:
    values: dict[int, list[float]] = {}
    for row in rows(folder):
        if row[name]:
            values.setdefault(int(row["world_steps"]), []).append(float(row[name]))
    return {step: sum(there) / len(there) for step, there in values.items()}


def test_training_logs_metrics_and_belief_images(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    train(folder, "--steps", 240)
    columns = ["loss", "held_out_log_likelihood", "mean_reward", "rate"]
    assert sorted(read(folder).Tags()["scalars"]) == sorted(["update", *columns])
    for name in columns:
        assert scalars(folder, name) == pytest.approx(averages(folder, name), rel=1e-5)
    assert list(scalars(folder, "update").values())[-1] == int(rows(folder)[-1]["update"])
    images = read(folder).Images("belief_of_first_world")
    # 120 steps of two worlds have images at steps 1 and 101.
    assert [image.step for image in images] == [2, 202]
    for image in images:
        assert (image.width, image.height) == (9 * 16, 6 * 16)
        assert image.encoded_image_string.startswith(b"\x89PNG\r\n\x1a\n")
