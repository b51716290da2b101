"""What the agent writes for TensorBoard, read by TensorBoard itself."""

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
    """Means over the CSV's rows of a step."""
    values: dict[int, list[float]] = {}
    for row in rows(folder):
        if row[name]:
            values.setdefault(int(row["world_steps"]), []).append(float(row[name]))
    return {step: sum(there) / len(there) for step, there in values.items()}


def test_a_training_shows_its_metrics_and_beliefs(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    train(folder, "--steps", 240)
    columns = ["loss", "held_out_log_likelihood", "mean_reward", "rate"]
    assert sorted(read(folder).Tags()["scalars"]) == sorted(["update", *columns])
    for name in columns:
        assert scalars(folder, name) == pytest.approx(averages(folder, name), rel=1e-5)
    assert list(scalars(folder, "update").values())[-1] == int(rows(folder)[-1]["update"])
    images = read(folder).Images("belief_of_first_world")
    # 120 steps of two worlds: the first and the hundred-and-first.
    assert [image.step for image in images] == [2, 202]
    for image in images:
        assert (image.width, image.height) == (9 * 16, 6 * 16)
        assert image.encoded_image_string.startswith(b"\x89PNG\r\n\x1a\n")


def test_what_is_gone_back_on_goes_from_the_curves_too(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    train(folder, "--steps", 60)
    saved = (folder / "checkpoint.safetensors").read_bytes()
    train(folder, "--steps", 60, "--resume")
    # As if a kill had lost what came after the checkpoint.
    (folder / "checkpoint.safetensors").write_bytes(saved)
    train(folder, "--steps", 20, "--resume", "--agent-seed", 9)
    rewards = scalars(folder, "mean_reward")
    assert rewards == pytest.approx(averages(folder, "mean_reward"), rel=1e-6)
    assert max(rewards) == 80
    frozen = folder / "frozen"
    for _ in range(2):
        train(folder, "--steps", 10, "--resume", "--freeze")
        assert len(scalars(frozen, "mean_reward")) == 5
    assert scalars(folder, "mean_reward") == rewards


def test_a_comparison_is_a_run_of_each_policy(tmp_path: Path) -> None:
    folder = tmp_path / "runs"
    what = "--seeds 3..5 --steps 7 --policies random_walk,beam_exploit".split()
    agent("compare", "--tensorboard", folder, "--csv", tmp_path / "out.csv", *what, *WORLDS)
    with (tmp_path / "out.csv").open() as file:
        means = [(row["policy"], float(row["mean_reward"])) for row in csv.DictReader(file)]
    for policy in ["random_walk", "beam_exploit"]:
        rewards = scalars(folder / policy, "reward")
        assert list(rewards) == list(range(1, 8))
        of_worlds = [mean for name, mean in means if name == policy]
        assert sum(rewards.values()) / 7 == pytest.approx(sum(of_worlds) / 2, rel=1e-4)
        assert len(scalars(folder / policy, "reward_standard_error")) == 7
