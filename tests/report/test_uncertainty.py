import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from bayesreg.report.uncertainty import region


def test_the_region_of_normal_draws_is_the_ellipsoid_of_the_chi_square():
    rotation = Rotation.from_euler("xyz", (20, 50, -30), degrees=True).as_matrix()
    sds = np.array([2.0, 0.7, 0.2])
    draws = np.array([5.0, -1.0, 2.0]) + (np.random.default_rng(0).normal(size=(40_000, 3)) * sds) @ rotation.T
    ellipsoid = region(draws)
    np.testing.assert_allclose(ellipsoid.mean, [5, -1, 2], atol=0.05)
    np.testing.assert_allclose(ellipsoid.semi_axes, sds * np.sqrt(stats.chi2.ppf(0.95, 3)), rtol=0.03)
    _, vectors = np.linalg.eigh(ellipsoid.shape)
    assert abs(vectors[:, -1] @ rotation[:, 0]) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("law", [stats.t(3), stats.uniform(), stats.expon()])
def test_the_region_holds_95_percent_of_any_draws(law):
    draws = law.rvs((500, 3), random_state=0)
    ellipsoid = region(draws)
    inside = [x @ np.linalg.solve(ellipsoid.shape, x) <= 1 + 1e-9 for x in draws - draws.mean(axis=0)]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.003)


def test_draws_in_a_plane_or_at_a_point_have_flat_regions():
    rng = np.random.default_rng(0)
    flat = region(rng.normal(size=(2000, 3)) * (1, 1, 0))
    np.testing.assert_allclose(flat.semi_axes, np.sqrt(stats.chi2.ppf(0.95, 2)) * np.array([1, 1, 0]), atol=0.15)
    np.testing.assert_array_equal(region(np.ones((5, 3))).semi_axes, 0)
