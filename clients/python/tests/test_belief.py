"""The known-model filter: against the authors' numbers, and the oracle for any model."""

import json
import pickle
from pathlib import Path

import numpy as np
import oracle
import pytest
from failures import fails, refuses
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from emberwatch.belief import (
    UNOBSERVED,
    Filters,
    Transition,
    entropy,
    initial_prior,
    known,
    uniform_prior,
)
from emberwatch.model import Model

REPOSITORY = Path(__file__).parents[3]
WILDFIRE = Model.wildfire()


def golden(name: str) -> dict[str, NDArray[np.generic]]:
    """Numbers of the authors' unmodified PyTorch code, where the Rust tests keep them."""
    folders = *REPOSITORY.glob("protocol/*/tests/data"), *REPOSITORY.glob("agent/*/tests/data")
    (path,) = (folder / f"{name}.npz" for folder in folders if (folder / f"{name}.npz").exists())
    with np.load(path) as file:
        return dict(file)


def model_of(
    *, kernel: NDArray, bias: NDArray, matrix: NDArray, initial: NDArray | None = None
) -> Model:
    """A model of any shape, by way of a model file; a kernel of five axes is by own state."""
    n_states, n_observations = matrix.shape
    initial = np.full(n_states, 1 / n_states) if initial is None else initial
    lines = ['name = "test"', f"kernel_size = {list(kernel.shape[-2:])}"]
    for s in range(n_states):
        lines += ["[[states]]", f'name = "s{s}"', 'color = "#000000"']
        lines += [f"initial = {float(initial[s])!r}", f"bias = {float(bias[s])!r}"]
        lines += [f"observed_as = {matrix[s].tolist()}"]
    for o in range(n_observations):
        lines += ["[[observations]]", f'name = "o{o}"', 'color = "#000000"']
    for *own, to, start in np.ndindex(kernel.shape[:-2]):
        lines += ["[[kernel]]", f'from = "s{start}"', f'to = "s{to}"']
        lines += [f'own = "s{o}"' for o in own]
        lines += [f"weights = {kernel[*own, to, start].tolist()}"]
    return Model.from_toml("\n".join(lines))


def observed_through(matrix: NDArray) -> Model:
    """The wildfire with another observation matrix."""
    return model_of(kernel=WILDFIRE.kernel, bias=WILDFIRE.bias, matrix=matrix)


def one_hot(states: NDArray) -> NDArray[np.float64]:
    return np.moveaxis(np.eye(3)[states], -1, 0)


def phi(model: Model, belief: NDArray) -> NDArray[np.float64]:
    _, height, width = belief.shape
    return Transition(model, height=height, width=width).apply(belief.astype(np.float64))


def assert_near(got: NDArray, expected: NDArray, tolerance: float) -> None:
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("size", ["1x1", "2x2", "3x3", "5x5", "4x7", "1x6", "64x64"])
def test_phi_is_the_authors_on_states_and_beliefs(size: str) -> None:
    file = golden("a1_transition")
    states, belief = one_hot(file[f"{size}_state"]), file[f"{size}_prob"]
    assert_near(phi(WILDFIRE, states), file[f"{size}_phi_state"], 1e-6)
    assert_near(phi(WILDFIRE, belief), file[f"{size}_phi_prob"], 1e-6)
    if f"{size}_phi_prob_f64" not in file:
        return
    # Their double-precision runs convert the kernel from float32, so take theirs.
    theirs = file["kernel"].astype(np.float64)
    model = model_of(kernel=theirs, bias=WILDFIRE.bias, matrix=WILDFIRE.observation_matrix)
    assert_near(phi(model, states), file[f"{size}_phi_state_f64"], 1e-12)
    assert_near(phi(model, belief), file[f"{size}_phi_prob_f64"], 1e-12)


def test_the_observation_matrix_is_the_authors() -> None:
    text = (REPOSITORY / "protocol/model/tests/data/a2_observation.json").read_text()
    theirs = json.loads(text)["P_obs_given_state_rows_state"]
    assert_near(WILDFIRE.observation_matrix, theirs, 1e-7)


@pytest.mark.parametrize("size", ["2x2", "3x3", "7x4", "64x64"])
def test_posteriors_and_predictors_are_the_authors(size: str) -> None:
    file = golden("a3_bayes")
    frames, saved = file[f"{size}_obs"], file[f"{size}_saved_steps"].tolist()
    _, height, width = frames.shape
    filter = known(WILDFIRE, prior=uniform_prior(WILDFIRE, height=height, width=width))
    for step, frame in enumerate(frames):
        filter.correct(frame)
        posterior = np.moveaxis(filter.belief, 0, -1)
        filter.predict()
        if step in saved:
            at = saved.index(step)
            assert_near(posterior, file[f"{size}_posterior"][at], 1e-6)
            assert_near(np.moveaxis(filter.belief, 0, -1), file[f"{size}_estimate"][at], 1e-6)


def check_masked(
    *, weights: NDArray, prior: NDArray, frame: NDArray, mask: NDArray, posterior: NDArray
) -> None:
    """Their network's W is (O, S), and its softmax runs over observations."""
    exponentials = np.exp(weights.astype(np.float64))
    model = observed_through((exponentials / exponentials.sum(axis=0)).T)
    filter = known(model, prior=np.moveaxis(prior, -1, 0))
    filter.correct(np.where(mask > 0, frame, UNOBSERVED).astype(np.uint8))
    assert_near(np.moveaxis(filter.belief, 0, -1), posterior, 1e-6)


@pytest.mark.parametrize("case", ["3x3", "4x6"])
def test_masked_posteriors_are_the_authors(case: str) -> None:
    file = {key.removeprefix(f"{case}_"): value for key, value in golden("a4_masked_small").items()}
    check_masked(
        weights=file["W"],
        prior=file["u"],
        frame=file["obs"],
        mask=file["mask"],
        posterior=file["state_est"],
    )


def test_masked_posteriors_along_a_path_are_the_authors() -> None:
    file = golden("a4_masked_filter")
    posterior = file["u"].copy()
    posterior[file["mask"] > 0] = file["posterior_at_mask"]
    for step in range(2):
        check_masked(
            weights=file["W"],
            prior=file["u"][step],
            frame=file["obs"][step],
            mask=file["mask"][step],
            posterior=posterior[step],
        )


@st.composite
def any_model(draw: st.DrawFn) -> Model:
    """Random weights, a third of them zero, random biases, any S, O and kernel, or one by state."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    n_states, n_observations = draw(st.integers(2, 6)), draw(st.integers(1, 5))
    size = 2 * draw(st.integers(0, 3)) + 1, 2 * draw(st.integers(0, 3)) + 1
    own = (n_states,) if draw(st.booleans()) else ()
    kernel = rng.choice([0.0, 0.25, rng.random()], (*own, n_states, n_states, *size))
    bias = rng.random(n_states) + 1e-3
    matrix = rng.dirichlet(np.ones(n_observations), n_states)
    return model_of(kernel=kernel, bias=bias, matrix=matrix)


@settings(deadline=None)
@given(any_model(), st.integers(1, 6), st.integers(1, 9), st.integers(0, 2**32))
def test_phi_is_its_formula_for_any_model(model: Model, height: int, width: int, key: int) -> None:
    rng = np.random.default_rng(key)
    belief = np.moveaxis(rng.dirichlet(np.ones(model.n_states), (height, width)), -1, 0)
    transition = Transition(model, height=height, width=width)
    transition.apply(np.ones_like(belief))  # leaves nothing behind
    assert_near(transition.apply(belief), oracle.phi(oracle.parameters(model.toml), belief), 1e-12)


def test_phi_by_own_state_is_that_of_the_rust_filter() -> None:
    file = json.loads((REPOSITORY / "protocol/model/tests/data/own_state.json").read_text())
    got = phi(Model.checked("wildfire-burnout"), np.array(file["belief"]))
    assert_near(got, file["prediction"], 1e-12)


@settings(deadline=None)
@given(any_model(), st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**32))
def test_beliefs_stay_on_the_simplex(model: Model, height: int, width: int, key: int) -> None:
    rng = np.random.default_rng(key)
    prior = initial_prior(model, height=height, width=width)
    filter, filters = known(model, prior=prior), Filters(model, prior, 1)
    parameters = oracle.parameters(model.toml)
    filters.reset([0], np.full((1, height, width), UNOBSERVED, np.uint8))
    filter.predict()
    for _ in range(5):
        frame = rng.integers(0, model.n_observations, (height, width)).astype(np.uint8)
        frame[rng.random((height, width)) < 0.5] = UNOBSERVED
        before, exactly = filter.belief, filters.predictor[:, 0].copy()
        filter.correct(frame)
        filters.update(frame[np.newaxis], np.ones(1, np.bool_))
        after = filter.belief
        assert (after[:, frame == UNOBSERVED] == before[:, frame == UNOBSERVED]).all()
        assert_near(after, oracle.bayes(parameters, before, frame), 1e-6)
        assert_near(filters.posterior[:, 0], oracle.bayes(parameters, exactly, frame), 1e-14)
        filter.predict()
        assert_near(filter.belief, oracle.phi(parameters, after), 1e-6)
        expected = oracle.phi(parameters, filters.posterior[:, 0])
        assert_near(filters.predictor[:, 0], expected, 1e-12)
        for belief in (after, filter.belief):
            assert (belief >= 0).all()
            assert_near(belief.sum(axis=0), np.ones((height, width)), 1e-6)
        assert_near(filter.entropy(), entropy(filter.belief.astype(np.float64)), 1e-6)


def test_one_seen_cell_follows_bayes_rule() -> None:
    filter = known(WILDFIRE, prior=uniform_prior(WILDFIRE, height=1, width=3))
    filter.correct(np.array([[255, 2, 255]], np.uint8))
    # .98 / (.01 + .05 + .98), the column of O for an observed fire.
    assert_near(filter.belief[2], np.array([[1 / 3, 0.98 / 1.04, 1 / 3]]), 1e-7)


def test_an_impossible_frame_is_refused_whole() -> None:
    matrix = np.array([[1, 0, 0], [0.8, 0.15, 0.05], [0.01, 0.01, 0.98]])
    prior = one_hot(np.array([[2, 2], [0, 2]]))
    filter = known(observed_through(matrix), prior=prior)
    # Cell (0, 0) could be corrected; cell (1, 0) is normal, which never looks like fire.
    words = r"cell \(1, 0\): .* belief \[1\.0, 0\.0, 0\.0\] allows, got 2"
    with fails("impossible_frame", match=words) as caught:
        filter.correct(np.array([[1, 255], [2, 2]], np.uint8))
    assert (filter.belief == prior).all()
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (str(copy), copy.code) == (str(caught.value), "impossible_frame")


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        (np.zeros((3, 2), np.uint8), r"expected shape \(2, 3\) and type uint8"),
        (np.zeros((2, 3), np.int64), "got .* int64"),
        (np.array([[255, 0, 2], [1, 3, 0]], np.uint8), r"cell \(1, 1\): expected a value below 3"),
    ],
)
def test_wrong_frames_are_refused(frame: NDArray, expected: str) -> None:
    filter = known(WILDFIRE, prior=uniform_prior(WILDFIRE, height=2, width=3))
    with pytest.raises(ValueError, match=expected):
        filter.correct(frame)


@pytest.mark.parametrize("value", [0.5, -0.1, np.nan, np.inf])
def test_priors_off_the_simplex_are_refused_by_cell(value: float) -> None:
    prior = uniform_prior(WILDFIRE, height=2, width=2)
    prior[2, 1, 0] = value
    with pytest.raises(ValueError, match=r"prior: cell \(1, 0\)"):
        known(WILDFIRE, prior=prior)


def test_a_sum_of_one_is_not_enough_for_a_prior() -> None:
    with pytest.raises(ValueError, match=r"prior: cell \(0, 0\): expected probabilities >= 0"):
        known(WILDFIRE, prior=np.array([[[1.5]], [[-0.5]], [[0.0]]]))


def test_priors_of_another_shape_are_refused() -> None:
    for shape in ((2, 4, 4), (4, 4), (3, 0, 4)):
        with refuses(r"prior: expected numbers of shape \(3, H, W\)"):
            known(WILDFIRE, prior=np.full(shape, 0.5))
    with pytest.raises(ValueError, match=r"expected shape \(3, 2, 2\)"):
        Transition(WILDFIRE, height=2, width=2).apply(np.ones((3, 2, 3)))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_filter_keeps_its_own_belief(dtype: type[np.floating]) -> None:
    prior = uniform_prior(WILDFIRE, height=2, width=2).astype(dtype)
    filter = known(WILDFIRE, prior=prior)
    prior[:] = 0
    filter.belief[:] = 0
    assert_near(filter.belief.sum(axis=0), np.ones((2, 2)), 1e-7)


def test_entropy_of_known_distributions() -> None:
    uniform = uniform_prior(WILDFIRE, height=2, width=5)
    assert_near(entropy(uniform), np.full((2, 5), np.log(3)), 1e-12)
    certain = entropy(one_hot(np.array([[0, 1, 2]])))
    assert (certain == 0).all() and not np.signbit(certain).any()


def test_a_model_of_biases_only_forgets() -> None:
    kernel, bias = np.zeros((2, 2, 1, 1)), np.array([1.0, 3.0])
    model = model_of(kernel=kernel, bias=bias, matrix=np.ones((2, 1)))
    filter = known(model, prior=uniform_prior(model, height=2, width=3))
    filter.predict()
    assert_near(filter.belief[1], np.full((2, 3), 0.75), 1e-15)


def test_a_model_that_can_vanish_is_refused() -> None:
    model = model_of(kernel=np.zeros((2, 2, 1, 1)), bias=np.zeros(2), matrix=np.ones((2, 1)))
    with refuses(r"cell \(0, 0\): expected a positive sum"):
        known(model, prior=uniform_prior(model, height=2, width=2))
