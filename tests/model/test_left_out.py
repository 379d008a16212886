"""Left-out landmarks: the regions of their predictions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesreg.model.observations.left_out import Predictions, leave_out
from bayesreg.model.observations.point_noise import NormalNoise, StudentTNoise


@pytest.mark.parametrize("noise", [NormalNoise(), StudentTNoise()])
def test_the_share_that_lies_nearer_is_uniform_where_the_prediction_is_right(noise):
    """Landmarks are drawn from a mixture of three predictions, whose means, covariances and errors differ."""
    rng, count = np.random.default_rng(1), 400
    means, sd = rng.normal(size=(3, 1, 3)), np.full((3, count, 3), [[[0.2]], [[1.0]], [[2.0]]])
    roots = rng.normal(size=(3, 1, 3, 3)) * np.ones((1, count, 1, 1))
    which, error = rng.integers(3, size=count), rng.normal(size=(count, 3))
    if noise == StudentTNoise():
        error /= np.sqrt(rng.gamma(noise.nu / 2, 2 / noise.nu, size=(count, 1)))
    of_each = which, np.arange(count)
    landmark = (
        means[which, 0] + np.einsum("kij,kj->ki", roots[of_each], rng.normal(size=(count, 3))) + sd[of_each] * error
    )
    left_out = leave_out(Predictions(landmark - means, roots @ roots.mT, sd, np.full((3, count), 1 / 3)), noise)
    assert stats.kstest(left_out.share, "uniform").pvalue > 1e-3
    mean_square = np.einsum(
        "ki,kij,kj->k", left_out.residual, np.linalg.inv(left_out.covariance), left_out.residual
    ).mean()
    assert mean_square == pytest.approx(3.0, rel=0.25)
