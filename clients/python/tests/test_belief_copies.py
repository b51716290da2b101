"""Copies of beliefs are independent and equal to the bit; samples follow the belief."""

import copy
import multiprocessing
import pickle
import signal
import time
from pathlib import Path
from typing import Any

import golden_options
import numpy as np
import pytest
from failures import fails, refuses
from numpy.typing import NDArray

from emberwatch import belief
from emberwatch.belief import Belief, initial_prior
from emberwatch.model import Model

SHAPE: dict[str, Any] = {"height": 12, "width": 10}
MODEL = Model.named("wildfire-burnout")
GOLDEN = np.load(golden_options.FILE)
PRIOR = initial_prior(MODEL, **SHAPE)
#: Each kind, with its checkpoint.
KINDS = {
    **{name: None for name, kind in belief.kinds().items() if not kind.needs_checkpoint},
    "learned": "learned_filter",
    "learned+spatial": "learned_filter",
    "neural": "neural_belief",
}


def made(kind: str, folder: Path, n_worlds: int | None = 3) -> Belief:
    checkpoint = KINDS[kind]
    if checkpoint is None:
        return belief.known(MODEL, prior=PRIOR, kind=kind, n_worlds=n_worlds)
    (file := folder / checkpoint).write_bytes(GOLDEN[f"checkpoint {checkpoint}"].tobytes())
    return belief.load(file, **SHAPE, kind=kind, model="wildfire-small", n_worlds=n_worlds)


def fed(it: Belief, seed: int, n_steps: int = 4) -> bytes:
    """Feeds random frames, and returns everything that shows the belief."""
    rng, shown = np.random.default_rng(seed), list[NDArray[Any]]()
    for _ in range(n_steps):
        it.predict()
        frames = rng.choice([0, 1, 2, 255], it.shape, p=[0.1, 0.06, 0.04, 0.8]).astype(np.uint8)
        it.predict([0] if len(it.shape) == 3 else None)
        shown += [it.belief, *it.score_frames(frames)]
        it.correct(frames)
        shown += [it.belief, it.entropy()]
    return b"".join(array.tobytes() for array in shown)


@pytest.mark.parametrize("n_worlds", [None, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_copies_are_independent_and_continue_to_the_bit(
    kind: str, n_worlds: int | None, tmp_path: Path
) -> None:
    it, twin = made(kind, tmp_path, n_worlds), made(kind, tmp_path, n_worlds)
    assert fed(it, 1) == fed(twin, 1)
    for is_predicted in (False, True):
        for one in (it, twin) if is_predicted else ():
            one.predict()
        now = pickle.dumps(it)
        copies = [it.copy(), copy.copy(it), copy.deepcopy(it), pickle.loads(now)]
        it.save(tmp_path / "noon")
        copies.append(belief.load(tmp_path / "noon"))
        for one in copies:
            assert repr(one) == repr(it) and one.belief.tobytes() == it.belief.tobytes()
        fed(copies[0], 2)
        copies[1].reset()
        assert pickle.dumps(it) == now, "copies do not change the belief"
        expected = fed(twin, 3)
        assert fed(it, 3) == expected and fed(copies[1], 3) != expected
        assert all(fed(one, 3) == expected for one in copies[2:])
        copies[4].reset()
        assert (copies[4].belief == made(kind, tmp_path, n_worlds).belief).all()


def test_spawned_processes_continue_copies(tmp_path: Path) -> None:
    beliefs = [made(kind, tmp_path) for kind in KINDS]
    assert all(fed(it, 1) for it in beliefs)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        there = pool.starmap(fed, [(it.copy(), seed) for it in beliefs for seed in (5, 6)])
    for k, it in enumerate(beliefs):
        assert there[2 * k : 2 * k + 2] == [fed(it.copy(), 5), fed(it, 6)]


def test_the_text_shows_kind_shape_worlds_and_step() -> None:
    (one := belief.known(MODEL, prior=PRIOR)).predict()
    assert repr(one) == f"Belief('{belief.RECOMMENDED}', shape=(12, 10), worlds=1, step=1)"
    (many := belief.known(MODEL, prior=PRIOR, kind="known", n_worlds=3)).predict([1])
    assert repr(many) == "Belief('known', shape=(3, 12, 10), worlds=3, step=0 to 1)"


def test_samples_have_the_frequencies_of_each_cell() -> None:
    n, prior = 4000, np.random.default_rng(3).dirichlet([0.5] * 3, (6, 5)).transpose(2, 0, 1)
    prior[:, 0, 0], prior[:, 5, 4] = [0, 1, 0], [0.5, 0, 0.5]
    many = belief.known(MODEL, prior=prior, kind="known", n_worlds=n)
    drawn, p = many.sample(np.random.default_rng(1)), many.belief[:, 0].astype(float)
    assert drawn.shape == (n, 6, 5) and drawn.dtype == np.uint8
    counts = np.stack([(drawn == state).sum(axis=0) for state in range(3)])
    assert (counts[p == 0] == 0).all() and (drawn[:, 0, 0] == 1).all()
    z = (counts - n * p)[p > 0] / np.sqrt(n * (p * (1 - p))[p > 0] + 1)
    # 88 values of unit variance: the largest exceeds 4.5 with probability 0.0006.
    assert np.abs(z).max() < 4.5 and 0.8 < z.std() < 1.2
    # Cells are independent: correlations of at most 435 pairs, each of deviation 1 / sqrt(n).
    fires = (drawn == 2)[:, (p[2] > 0.05) & (p[2] < 0.95)]
    assert np.abs(np.corrcoef(fires.T) - np.eye(fires.shape[1])).max() < 4.8 / np.sqrt(n)
    one = belief.known(MODEL, prior=prior).sample(np.random.default_rng(1))
    assert one.shape == (6, 5) and (one == drawn[0]).all()


def test_what_cannot_be_done_is_refused_in_a_line(tmp_path: Path) -> None:
    neural = made("neural", tmp_path)
    with refuses("^sample: expected a belief about states, got 'neural', which predicts obs.*$"):
        neural.sample(np.random.default_rng(1))
    with refuses("^rng: expected a numpy.random.Generator, got 1$"):
        neural.sample(1)  # pyright: ignore[reportArgumentType]
    neural.save(file := tmp_path / "noon.belief")
    with refuses("^belief .*noon.belief: expected no other arguments, as a saved belief has its"):
        belief.load(file, **SHAPE)
    with refuses("^height and width: expected the sides of the grid, as the file is a checkpoint"):
        belief.load(tmp_path / "neural_belief")
    with refuses("^belief: write .*none/noon: No such file"):
        neural.save(tmp_path / "none" / "noon")
    data = file.read_bytes()
    for damaged in (data[:-1], data + b"0", data[:60] + b"?" + data[61:], data[:25], data[:20]):
        file.write_bytes(damaged)
        with refuses("^belief: expected bytes of a saved belief, got damaged ones$"):
            belief.load(file)


def test_a_signal_ends_calls_about_many_worlds(request: pytest.FixtureRequest) -> None:
    it = belief.known(MODEL, prior=initial_prior(MODEL, height=64, width=64), n_worlds=1500)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGALRM, before))
    began = time.monotonic()
    signal.setitimer(signal.ITIMER_REAL, 0.1)
    with pytest.raises(KeyboardInterrupt):
        for _ in range(50):
            it.predict()
    assert time.monotonic() - began < 1 and "step=unfinished" in repr(it)  # all take a minute
    for call in (it.predict, it.copy, it.entropy, lambda: it.belief):
        with fails("interrupted", match="^belief: an interrupted call left it unfinished: "):
            call()
    it.reset()
    assert (it.belief[:, 7, 3, 3] == PRIOR[:, 3, 3].astype(np.float32)).all()
