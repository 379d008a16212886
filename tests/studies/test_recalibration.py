"""λ/μ allowing for an error that simulations know."""

import numpy as np
import pytest
from scipy import stats

from bayesreg.types import InputError
from studies.mesh_error.recalibration import RANGE, Response, least_bodies, recalibrate, response

MESH = Response(np.array([0.02, 0.05]), np.array([[0.7, 0.1], [0.0, 0.9]]), np.diag([0.2, 0.3]) ** 2, 100)


def bodies(count: int, seed: int, mesh: Response = MESH) -> tuple[np.ndarray, np.ndarray]:
    """True and found λ/μ of bodies that are drawn from the prior."""
    rng = np.random.default_rng(seed)
    true = np.exp(rng.uniform(*np.log(RANGE), (count, 2)))
    return true, np.exp(-mesh(1 / true) - rng.multivariate_normal(np.zeros(2), mesh.scatter, count))


def test_the_curve_that_made_the_bodies_is_found():
    curve = response(*bodies(2000, seed=1))
    np.testing.assert_allclose(curve.offset, MESH.offset, rtol=0.1)
    np.testing.assert_allclose(curve.slope, MESH.slope, rtol=0.1, atol=0.03)
    np.testing.assert_allclose(curve.scatter, MESH.scatter, rtol=0.1, atol=0.005)
    assert curve.degrees_of_freedom == 1997


def test_intervals_hold_the_truth_as_often_as_they_say():
    inside, count = np.zeros(2, int), 300
    for seed in range(count):
        true, estimated = bodies(25, seed=1000 + seed)
        curve = response(true[1:], estimated[1:])
        low, high = np.quantile(recalibrate(curve, estimated[:1], seed), (0.05, 0.95), axis=0)
        inside += (low <= true[0]) & (true[0] <= high)
    for covered in inside:
        assert stats.binomtest(int(covered), count, 0.9).pvalue > 0.01, inside


def test_a_better_mesh_gives_as_good_an_interval():
    """However narrow: the candidates follow."""
    sharp = MESH._replace(scatter=np.diag([0.02, 0.02]) ** 2, degrees_of_freedom=10_000)
    ends = [np.quantile(recalibrate(sharp, np.array([[8.0, 9.0]]), seed), (0.05, 0.95), axis=0) for seed in range(4)]
    np.testing.assert_allclose(ends, np.broadcast_to(np.mean(ends, axis=0), (4, 2, 2)), rtol=0.01)
    grid = np.exp(np.linspace(*np.log(RANGE), 2000))
    high = 1 / grid
    # Of WM alone, whose row of the slope knows nothing of GM.
    weight = stats.norm.pdf(np.log(0.05 + 0.9 * high) + np.log(9.0), scale=0.02)
    levels = np.interp((0.05, 0.95), np.cumsum(weight) / weight.sum(), grid)
    np.testing.assert_allclose(np.mean(ends, axis=0)[:, 1], levels, rtol=0.01)


def test_a_mesh_without_error_leaves_the_posterior_as_it_is():
    exact = Response(np.zeros(2), np.eye(2), 1e-4 * np.eye(2), 1000)
    draws = np.exp(np.log([10.0, 30.0]) + 0.2 * np.random.default_rng(5).normal(size=(2000, 2)))
    levels = (0.1, 0.5, 0.9)
    np.testing.assert_allclose(
        np.quantile(recalibrate(exact, draws), levels, axis=0), np.quantile(draws, levels, axis=0), rtol=0.05
    )


def test_what_a_mesh_hides_is_left_to_the_prior():
    stiff = MESH._replace(offset=np.array([0.02, 0.5]))
    recalibrated = recalibrate(stiff, np.tile([20.0, 2.0], (100, 1)))
    low, high = np.quantile(recalibrated[:, 1], (0.05, 0.95))
    assert low > RANGE[0]
    assert high > 0.4 * RANGE[1]


def test_the_same_seed_gives_the_same_draws():
    draws = np.full((10, 2), 12.0)
    assert np.array_equal(recalibrate(MESH, draws, seed=1), recalibrate(MESH, draws, seed=1))
    assert not np.array_equal(recalibrate(MESH, draws, seed=1), recalibrate(MESH, draws, seed=2))


def test_too_few_bodies_and_broken_ones_are_refused():
    true, estimated = bodies(24, seed=6)
    few = least_bodies(2) - 1
    with pytest.raises(InputError, match=f"12 simulated bodies or more, got {few}"):
        response(true[:few], estimated[:few])
    estimated[3, 1] = np.inf
    with pytest.raises(InputError, match="positive and finite"):
        response(true, estimated)
    with pytest.raises(InputError, match="no draw"):
        recalibrate(MESH, np.zeros((0, 2)))


def test_bodies_that_are_all_found_alike_tell_nothing():
    """The scatter that they lack is not taken for certainty of what is true."""
    true, _ = bodies(24, seed=7)
    recalibrated = recalibrate(response(true, np.full_like(true, 10.0)), np.full((5, 2), 10.0))
    low, high = np.quantile(recalibrated, (0.05, 0.95), axis=0)
    assert (low < 2).all()
    assert (high > 100).all()
