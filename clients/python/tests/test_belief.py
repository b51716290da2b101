"""Beliefs from Python, compared with the oracle for any model."""

import numpy as np
import oracle
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from emberwatch.belief import (
    UNOBSERVED,
    entropy,
    initial_prior,
    known,
    uniform_prior,
)
from emberwatch.model import Model

WILDFIRE = Model.wildfire()


def model_of(*, kernel: NDArray, bias: NDArray, matrix: NDArray) -> Model:
    """Makes a model of any shape."""
    n_states, n_observations = matrix.shape
    lines = ['name = "test"', f"kernel_size = {list(kernel.shape[-2:])}"]
    for s in range(n_states):
        lines += ["[[states]]", f'name = "s{s}"', 'color = "#000000"']
        lines += [f"initial = {1 / n_states!r}", f"bias = {float(bias[s])!r}"]
        lines += [f"observed_as = {matrix[s].tolist()}"]
    for o in range(n_observations):
        lines += ["[[observations]]", f'name = "o{o}"', 'color = "#000000"']
    for to, start in np.ndindex(kernel.shape[:2]):
        lines += ["[[kernel]]", f'from = "s{start}"', f'to = "s{to}"']
        lines += [f"weights = {kernel[to, start].tolist()}"]
    return Model.from_toml("\n".join(lines))


def assert_near(got: NDArray, expected: NDArray, tolerance: float) -> None:
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance)


@st.composite
def any_model(draw: st.DrawFn) -> Model:
    """Draws a model: any S, O, kernel size and biases; a third of the weights are zero."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    n_states, n_observations = draw(st.integers(2, 6)), draw(st.integers(1, 5))
    size = 2 * draw(st.integers(0, 3)) + 1, 2 * draw(st.integers(0, 3)) + 1
    kernel = rng.choice([0.0, 0.25, rng.random()], (n_states, n_states, *size))
    bias = rng.random(n_states) + 1e-3
    matrix = rng.dirichlet(np.ones(n_observations), n_states)
    return model_of(kernel=kernel, bias=bias, matrix=matrix)


@settings(deadline=None, max_examples=40)
@given(any_model(), st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**32))
def test_beliefs_equal_the_oracle_and_stay_on_the_simplex(
    model: Model, height: int, width: int, key: int
) -> None:
    rng = np.random.default_rng(key)
    prior = initial_prior(model, height=height, width=width)
    filter, parameters = known(model, prior=prior, kind="known"), oracle.parameters(model.toml)
    for _ in range(5):
        frame = rng.integers(0, model.n_observations, (height, width)).astype(np.uint8)
        frame[rng.random((height, width)) < 0.5] = UNOBSERVED
        before = filter.belief
        filter.correct(frame)
        after = filter.belief
        assert (after[:, frame == UNOBSERVED] == before[:, frame == UNOBSERVED]).all()
        assert_near(after, oracle.bayes(parameters, before, frame), 1e-6)
        filter.predict()
        assert_near(filter.belief, oracle.phi(parameters, after), 1e-6)
        for belief in (after, filter.belief):
            assert (belief >= 0).all()
            assert_near(belief.sum(axis=0), np.ones((height, width)), 1e-6)
        assert_near(filter.entropy(), entropy(filter.belief.astype(np.float64)), 1e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_filter_copies_its_prior_and_its_belief(dtype: type[np.floating]) -> None:
    prior = uniform_prior(WILDFIRE, height=2, width=2).astype(dtype)
    filter = known(WILDFIRE, prior=prior)
    prior[:] = 0
    filter.belief[:] = 0
    assert_near(filter.belief.sum(axis=0), np.ones((2, 2)), 1e-7)


def test_entropy_matches_known_distributions() -> None:
    uniform = uniform_prior(WILDFIRE, height=2, width=5)
    assert_near(entropy(uniform), np.full((2, 5), np.log(3)), 1e-12)
    certain = entropy(np.moveaxis(np.eye(3)[np.array([[0, 1, 2]])], -1, 0))
    assert (certain == 0).all() and not np.signbit(certain).any()
