"""Beliefs of every kind equal the Rust agent's, for one world or many; bad input is refused."""

import copy
import pickle
import re
import subprocess
import textwrap
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import golden_options
import numpy as np
import pytest
from failures import fails, refuses
from numpy.typing import NDArray
from processes import find

import emberwatch
from emberwatch import _native, belief
from emberwatch.belief import Belief, initial_prior
from emberwatch.belief.prior import simulated_prior
from emberwatch.model import Model
from emberwatch.model.airspace import Airspace

MODEL = Model.named("wildfire-small")
GRID = {"height": 16, "width": 16}
PRIOR = simulated_prior(MODEL, **GRID, burn_in=100)
N_WORLDS = 3
KNOWN = [name for name, kind in belief.kinds().items() if not kind.needs_checkpoint]
LEARNED = ["learned", "learned+spatial"]

#: Kinds of belief, with a checkpoint for the learned kinds.
CASES: list[tuple[str, str | None]] = [
    *((kind, None) for kind in KNOWN),
    *((kind, "learned_filter") for kind in LEARNED),
    ("neural", "neural_belief"),
]


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checkpoints")
    golden = np.load(golden_options.FILE)
    for name in ("learned_filter", "neural_belief"):
        (folder / name).write_bytes(golden[f"checkpoint {name}"].tobytes())
    return folder


@pytest.fixture(scope="module")
def flown() -> list[tuple[NDArray[np.void], NDArray[np.uint8], NDArray[np.uint8]]]:
    """Returns results, frames and hidden states of some worlds after a reset and each step."""
    rng, moves = np.random.default_rng(7), (N_WORLDS, 16)
    world = {**GRID, "model": "wildfire-small", "moves": 16, "burn_in": 100}
    with emberwatch.embed(worlds=N_WORLDS, publish_truth=True, **world) as client:
        lease = client.acquire(0, N_WORLDS)
        lease.reset([1000, 1001, 1002])
        answers = [lease.observe()]
        truths = [states(client)]
        for _ in range(12):
            answers.append(lease.step(rng.integers(0, 4, moves)))
            truths.append(states(client))
    return [
        (it.results.copy(), it.frames.copy(), truth)
        for it, truth in zip(answers, truths, strict=True)
    ]


def states(client: Any) -> NDArray[np.uint8]:
    truths = client.truths(range(N_WORLDS))
    return np.stack([truth.states for truth in truths])


def made(kind: str, checkpoint: Path | None, n_worlds: int | None = None) -> Belief:
    if checkpoint is None:
        return belief.known(MODEL, prior=PRIOR, kind=kind, n_worlds=n_worlds)
    return belief.load(checkpoint, **GRID, kind=kind, model=MODEL, n_worlds=n_worlds)


def of_agents(kind: str, checkpoint: Path | None, flown: Any) -> Iterator[NDArray[np.float32]]:
    """Yields the beliefs of agents with this estimator before each step, `(S, n, H, W)`."""
    spec: Any = types.SimpleNamespace(
        **GRID,
        n_moves=16,
        n_observations=MODEL.n_observations,
        burn_in=100,
        model=MODEL,
        description=None,
        airspace=Airspace(),
    )
    path = None if checkpoint is None else str(checkpoint)
    read = None if path is None else (path, _native.checkpoint_bytes(path))
    options = _native.Options(spec, N_WORLDS, kind, read, "simulated")
    worlds, all_of_them = range(N_WORLDS), np.ones(N_WORLDS, bool)
    options.start_episodes(all_of_them, flown[0][0].view(np.uint8).ravel())
    for results, frames, _ in flown:
        options.update(all_of_them, results.view(np.uint8).ravel(), frames)
        left = [options.left(world) for world in worlds]
        numbers = [np.frombuffer(data[: 4 * 3 * 256], np.float32) for _, data in left]
        yield np.stack([it.reshape(3, 16, 16) for it in numbers], axis=1)


@pytest.mark.parametrize(("kind", "checkpoint"), CASES)
def test_beliefs_equal_the_agents_bit_for_bit(
    kind: str, checkpoint: str | None, checkpoints: Path, flown: Any
) -> None:
    path = checkpoints / checkpoint if checkpoint else None
    many, alone = made(kind, path, N_WORLDS), [made(kind, path) for _ in range(N_WORLDS)]
    assert many.kind == kind and len(many.state_names) == 3 and many.target_state == 2
    for expected, (_, frames, _) in zip(of_agents(kind, path, flown), flown, strict=True):
        many.correct(frames)
        for world, single in enumerate(alone):
            single.correct(frames[world])
            assert (many.belief[:, world] == single.belief).all()
            single.predict()
            # Equal to the agent's belief in every bit, including signs of zeros.
            assert single.belief.tobytes() == expected[:, world].tobytes()
        many.predict()
        assert many.belief.tobytes() == expected.tobytes()
        for world, single in enumerate(alone):
            assert (many.entropy()[world] == single.entropy()).all()


@pytest.mark.parametrize("kind", KNOWN)
def test_worlds_can_move_and_reset_separately(kind: str, flown: Any) -> None:
    kept, fresh = made(kind, None, N_WORLDS), made(kind, None)
    first = kept.belief
    for _, frames, _ in flown[1:4]:
        kept.correct(frames, [0, 2])
        kept.predict(np.array([True, False, True]))
    assert (kept.belief[:, 1] == first[:, 1]).all()
    assert (kept.belief[:, 0] != first[:, 0]).any()
    kept.reset([2])
    assert (kept.belief[:, 2] == first[:, 2]).all() and (kept.belief[:, 0] != first[:, 0]).any()
    for _, frames, _ in flown[1:5]:  # nothing of the last episode remains
        kept.correct(frames, 2)
        fresh.correct(frames[2])
        assert (kept.belief[:, 2] == fresh.belief).all()
        kept.predict(slice(2, 3))
        fresh.predict()
    kept.reset()
    assert (kept.belief == first).all()


def test_scores_are_those_of_each_step(flown: Any) -> None:
    frames, truths = (np.stack(column) for column in list(zip(*flown, strict=True))[1:])
    kept, again = (made("known", None, N_WORLDS) for _ in range(2))
    scores = belief.score(kept, frames, truths)
    for k, (frame, truth) in enumerate(zip(frames, truths, strict=True)):
        sums, n_seen = again.score_frames(frame)
        again.correct(frame)
        figures = scores.log_loss[k], scores.brier[k], scores.accuracy[k]
        assert np.array_equal(figures, again.score_states(truth))
        again.predict()
        assert np.array_equal(n_seen, scores.n_seen[k])
        assert np.array_equal(n_seen, (frame != 255).sum(axis=(-2, -1)))
        if n_seen.all():
            np.testing.assert_allclose(scores.predicted_log_loss[k], -sums / n_seen)
    means, loss = scores.mean(), np.nan_to_num(scores.predicted_log_loss)
    assert np.array_equal(means["brier"], scores.brier.mean(axis=0))
    mean = (loss * scores.n_seen).sum(axis=0) / scores.n_seen.sum(axis=0)
    np.testing.assert_allclose(means["predicted_log_loss"], mean)
    repeated = belief.score(kept, frames, truths)
    assert (repeated.log_loss == scores.log_loss).all(), "it begins again"
    alone = belief.score(made("known", None), frames[:, 1], truths[:, 1])
    assert (alone.log_loss == scores.log_loss[:, 1]).all()


def test_wrong_certainty_has_infinite_loss() -> None:
    prior = np.zeros((3, 1, 2))
    prior[0] = 1
    kept = belief.known(MODEL, prior=prior)
    nothing = np.full((1, 1, 2), 255, np.uint8)
    scores = belief.score(kept, nothing, np.array([[[0, 2]]], np.uint8))
    assert scores.log_loss.tolist() == [np.inf] and scores.accuracy.tolist() == [0.5]
    assert scores.brier.tolist() == [0.5] and np.isnan(scores.predicted_log_loss).all()
    assert np.isnan(scores.mean()["predicted_log_loss"])
    seen, truth = np.array([[[1, 255]]], np.uint8), np.array([[[0, 2]]], np.uint8)
    scores = belief.score(kept, seen, truth, target=0)
    assert scores.brier[0] == 0.5 and scores.n_seen.tolist() == [1]
    loss = -np.log(MODEL.observation_matrix[0, 1])
    np.testing.assert_allclose(scores.predicted_log_loss, loss, rtol=1e-5)


#: Arguments of `known` with one wrong value, and the errors.
KNOWN_REFUSALS: list[tuple[dict[str, Any], str]] = [
    ({"model": 7}, "model: expected text or a path, got 7"),
    ({"kind": "learned"}, f"kind: expected one of {', '.join(KNOWN)}, got 'learned'"),
    ({"kind": "\ud800"}, "got '\\ud800'"),
    ({"prior": "uniform"}, "prior: expected numbers of shape (3, H, W), got <U7 of shape ()"),
    ({"prior": PRIOR[:2]}, "prior: expected numbers of shape (3, H, W), got float32 of shape (2,"),
    *(
        ({"prior": np.full((3, 1, 1), wrong)}, "prior: belief of cell (0, 0): expected probabi")
        for wrong in (np.nan, 1e99)
    ),
    ({"n_worlds": 0}, "n_worlds: expected an integer within 1 to 1048576, got 0"),
]


def test_known_refuses_wrong_arguments() -> None:
    right: dict[str, Any] = {"model": MODEL, "prior": PRIOR}
    for wrong, error in KNOWN_REFUSALS:
        with refuses(re.escape(error)):
            belief.known(**(right | wrong))


FRAME = np.full((16, 16), 255, np.uint8)
TRUTH = np.zeros((16, 16), np.uint8)
WORLDS = "worlds: expected a mask of 3 worlds, indices from 0 to 2, or a slice, got "


#: Wrong calls of a belief about one world or about three, and the errors.
REFUSALS: list[tuple[int | None, Callable[[Belief], Any], str]] = [
    (3, lambda it: it.correct(FRAME),
        "frame: expected shape (3, 16, 16) and type uint8, got (16, 16) and uint8"),
    (None, lambda it: it.correct(np.full((16, 16), 3, np.uint8)),
        "frame: cell 0: expected an observation below 3 or 255, got 3"),
    *((3, lambda it, worlds=worlds: it.predict(worlds), f"{WORLDS}{worlds!r}")
        for worlds in (3, [True, False], [0.5], "0", slice(None, None, 0))),
    (None, lambda it: it.reset(keep_correlations=1),  # pyright: ignore[reportArgumentType]
        "keep_correlations: expected True or False, got 1"),
    (None, lambda it: it.score_states(FRAME), "states: expected values below 3, got 255"),
    (None, lambda it: it.score_states(TRUTH, target=3),
        "target: expected an integer within 0 to 2, got 3"),
    (None, lambda it: belief.score(it, np.stack([FRAME, FRAME]), TRUTH[None]),
        "states: expected 2 steps, as in observations, at least 1, got 1"),
]  # fmt: skip


def test_a_refused_call_does_not_change_the_belief() -> None:
    for n_worlds, call, error in REFUSALS:
        kept = made("known", None, n_worlds)
        kept.correct(np.full(kept.shape, 2, np.uint8))
        before = kept.belief
        with refuses(re.escape(error)):
            call(kept)
        assert (kept.belief == before).all()


def test_checkpoints_that_do_not_fit_are_refused(checkpoints: Path, tmp_path: Path) -> None:
    with refuses("checkpoint: expected text or a path, got None"):
        belief.load(None, **GRID)  # pyright: ignore[reportArgumentType]
    with refuses("kind: expected one of learned, .*, got 'known'"):
        made("known", checkpoints / "learned_filter")
    (tmp_path / "text").write_text("no checkpoint")
    with refuses("checkpoint .*text: expected a complete safetensors file"):
        belief.load(tmp_path / "text", **GRID)
    with refuses("checkpoint.*of `train --learner neural`, got none|expected a learned neural"):
        belief.load(checkpoints / "learned_filter", **GRID, kind="neural")


def test_an_impossible_frame_names_its_world() -> None:
    prior = np.zeros((3, 1, 2))
    prior[0] = 1
    text = MODEL.toml.replace(str(MODEL.observation_matrix[0].tolist()), "[1.0, 0.0, 0.0]", 1)
    sharp = Model.from_toml(text)
    assert sharp.observation_matrix[0].tolist() == [1, 0, 0]
    many = belief.known(sharp, prior=prior, n_worlds=2)
    with fails("impossible_frame", match=r"world 1: frame: cell \(0, 1\): .* allows, got 2"):
        many.correct(np.array([[[0, 255]], [[255, 2]]], np.uint8))
    several = belief.known(sharp, prior=prior, n_worlds=200)
    frames = np.full((200, 1, 2), 255, np.uint8)
    frames[::2, 0, 1] = 2
    frames[1::2, 0, 1] = 0
    with fails("impossible_frame", match=r"worlds 0, 2, 4, .*, 196, 198: frame") as refused:
        several.correct(frames)
    assert refused.value.worlds == tuple(range(0, 200, 2))
    assert (several.belief == prior[:, None]).all()
    one = belief.known(sharp, prior=prior)
    with fails("impossible_frame", match=r"^frame: cell \(0, 1\)"):
        one.correct(np.array([[255, 2]], np.uint8))
    assert (one.belief == prior).all()


def test_an_autoencoder_works_only_on_its_grid(tmp_path: Path) -> None:
    settings = tmp_path / "agent.toml"
    settings.write_text("[autoencoder]\nwindow = 2\n")
    command = [find("emberwatch-agent"), "train", "--learner=autoencoder", "--height=8"]
    command += ["--width=8", "--steps=6", "--moves=4", f"--out={tmp_path / 'out'}"]
    command += [f"--config={settings}"]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    checkpoint = tmp_path / "out" / "checkpoint.safetensors"
    kept = belief.load(checkpoint, height=8, width=8)
    assert kept.kind == "autoencoder"
    assert kept.sample(np.random.default_rng(1)).shape == (8, 8)
    for way in (copy.copy, copy.deepcopy, pickle.dumps, lambda it: it.save(tmp_path / "noon")):
        with refuses("belief: expected a kind that can be copied and saved, got 'autoencoder'"):
            way(kept)
    for model in (None, MODEL):
        with refuses("checkpoint: expected .*16 x 16"):
            belief.load(checkpoint, **GRID, model=model)


def test_the_readme_example_runs(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    page = Path(__file__).parents[1].joinpath("README.md").read_text("utf-8")
    section = page.split("## Beliefs\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("    ") or not line]
    exec(compile(textwrap.dedent("\n".join(lines)), "README.md", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in printed] == ["known", belief.RECOMMENDED]


@pytest.mark.parametrize("name", ["wildfire-burnout", "road-ice", "wildfire-terrain"])
def test_every_kind_accepts_models_in_any_form(name: str) -> None:
    model = Model.named(name)
    height, width = (64, 64) if model.maps else (5, 4)
    prior = initial_prior(model, height=height, width=width)
    for kind in KNOWN:
        kept = belief.known(model, prior=prior, kind=kind)
        kept.correct(np.zeros((height, width), np.uint8))
        kept.predict()
        assert np.allclose(kept.belief.sum(axis=0), 1, atol=1e-4), kind
