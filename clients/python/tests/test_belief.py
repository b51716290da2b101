"""Priors and entropies of beliefs."""

import numpy as np
import pytest
from numpy.typing import NDArray

from emberwatch.belief import entropy, known, uniform_prior
from emberwatch.model import Model

WILDFIRE = Model.wildfire()


def assert_near(got: NDArray, expected: NDArray, tolerance: float) -> None:
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance)


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
