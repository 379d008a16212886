"""The formula that the cost of the paper's kernel is reckoned with."""

import numpy as np
import pytest

from tests.inference.random_walk import ess_per_step, gaussian_walk


@pytest.mark.long
def test_the_formula_is_that_of_a_long_walk():
    """Within a third, for it is a limit; in few dimensions, the entries correlated and of different widths."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(8, 8)) * np.linspace(4, 12, 8)[:, None]
    predicted, measured = gaussian_walk(
        root @ root.T, np.linspace(0.5, 1.5, 8), chains=32, steps=100_000, thin=100, entries=8
    )
    assert predicted.max() > 1.5 * predicted.min()
    np.testing.assert_allclose(measured, predicted, rtol=0.33)
    assert abs(np.log(measured / predicted).mean()) < 0.15


def test_the_noise_of_a_sampled_covariance_is_taken_off():
    rng = np.random.default_rng(1)
    size, draws = 60, 300
    variances = np.full(size, 0.1)
    exact = ess_per_step(np.eye(size), variances, 0.2)
    sampled = np.array(
        [ess_per_step(np.cov(rng.normal(size=(draws, size)).T), variances, 0.2, draws) for _ in range(30)]
    )
    np.testing.assert_allclose(sampled.mean(), exact.mean(), rtol=0.03)
    raw = ess_per_step(np.cov(rng.normal(size=(draws, size)).T), variances, 0.2)
    assert raw.mean() < 0.9 * exact.mean()


def test_entries_whose_spread_is_lost_in_that_noise_have_an_ess_all_the_same():
    rng = np.random.default_rng(2)
    size, draws = 60, 80
    widths = np.geomspace(1, 1e-3, size)
    covariance = np.cov((widths * rng.normal(size=(draws, size))).T)
    ess = ess_per_step(covariance, np.full(size, 0.1), 0.2, draws / 2)
    assert (ess > 0).all()
    assert ess.argmin() < 3
