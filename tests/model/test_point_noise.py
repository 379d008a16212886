"""Errors of points: their density, curvature and weights, against SciPy, differentiation and brute force."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

import bayesreg as br
from bayesreg.fem.elements import elements_of
from bayesreg.model.observations.point_noise import WRONG, NormalNoise, StudentTNoise
from bayesreg.model.state import State
from bayesreg.types import Equilibrium
from tests.phantoms import box_mesh

MESH = box_mesh(2)
RNG = np.random.default_rng(3)
FIXED = RNG.uniform(2, 18, (12, 3))
MOVING = FIXED + RNG.normal(0.5, 1.0, FIXED.shape)
U = RNG.normal(0.0, 0.5, MESH.points.shape)
BY_AXIS = (br.ScalePrior(median=0.5), 0.7, br.ScalePrior(median=1.5))
NOISES = [NormalNoise(), StudentTNoise(nu=4.0)]
VALUES = {
    name: jnp.asarray(sd) for name, sd in (("landmarks_sd_x", 0.4), ("landmarks_sd_z", 1.1), ("landmarks_sd", 0.6))
}


def placed(sd, noise):
    return br.Landmarks(FIXED, MOVING, sd, noise=noise).on(MESH)


def state_of(u):
    nothing, solved = jnp.zeros(0), Equilibrium(jnp.asarray(u), jnp.zeros(()), jnp.zeros((), int), jnp.array(True))
    return State(VALUES, nothing, nothing, solved, elements_of(MESH), MESH)


@pytest.mark.parametrize("noise", NOISES, ids=["normal", "student_t"])
@pytest.mark.parametrize("sd", [0.5, br.ScalePrior(median=0.8), BY_AXIS], ids=["known", "inferred", "by axis"])
def test_the_density_is_that_of_scipy_up_to_the_known_normaliser(noise, sd):
    term = placed(sd, noise).term
    residual = np.asarray(term.shift - term.predicted(state_of(U)))
    own_sd, known_sd = np.asarray(term.sd(VALUES)), np.asarray(term.known_sd)

    def log_pdf(difference, scale):
        if isinstance(noise, NormalNoise):
            return stats.multivariate_normal.logpdf(difference, cov=np.diag(scale**2))
        return stats.multivariate_t.logpdf(difference, shape=np.diag(scale**2), df=noise.nu)

    whole = [log_pdf(r, s) for r, s in zip(residual, own_sd, strict=True)]
    known = [log_pdf(np.zeros(3), s) for s in known_sd]
    np.testing.assert_allclose(float(term.log(state_of(U))), sum(whole) - sum(known), rtol=1e-10)
    np.testing.assert_allclose(term.pointwise_log_likelihood(state_of(U)), whole, rtol=1e-10)


@pytest.mark.parametrize("nu", [2.5, 4.0, 30.0])
def test_an_error_of_student_t_is_a_mixture_of_normal_ones(nu):
    taus, log_probabilities = np.array(StudentTNoise(nu=nu).mixture).T
    residual = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, -1.0], [40.0, 0.0, 0.0], [0.0, 1000.0, 0.0]])
    log_normal = [stats.multivariate_normal.logpdf(residual, cov=np.eye(3) / tau) for tau in taus]
    log_density = logsumexp(np.transpose(log_normal) + log_probabilities, axis=1)
    np.testing.assert_allclose(log_density, stats.multivariate_t.logpdf(residual, shape=np.eye(3), df=nu), atol=1e-3)


def test_every_point_of_a_sample_has_an_error_and_a_weight_of_its_own():
    """Sizes of errors of two points, with the distribution that they should have, do not depend on one another."""
    noise, sd = StudentTNoise(nu=4.0), jnp.array([[0.5] * 3, [2.0] * 3])
    samples = np.asarray(noise.distribution(jnp.ones((2, 3)), sd).sample(jax.random.key(0), (4000,)))
    squares = (((samples - 1) / np.asarray(sd)) ** 2).sum(axis=-1)
    for point in squares.T:
        assert stats.kstest(point / 3, stats.f(3, noise.nu).cdf).pvalue > 1e-3
    assert stats.spearmanr(*squares.T).pvalue > 1e-3


@pytest.mark.parametrize("noise", NOISES, ids=["normal", "student_t"])
def test_the_two_parts_of_the_curvature_are_its_second_derivative(noise):
    term = placed(BY_AXIS, noise).term
    hessian = -jax.hessian(lambda u: term.log(state_of(u)))(jnp.asarray(U)).reshape(U.size, U.size)
    parts = term.gauss_newton(U, VALUES), term.remainder(U, VALUES)
    rows = np.zeros((len(FIXED), 3, U.size))
    for k, (nodes, weights) in enumerate(zip(np.asarray(term.nodes), np.asarray(term.weights), strict=True)):
        for node, weight in zip(nodes, weights, strict=True):
            rows[k, :, 3 * node : 3 * node + 3] += weight * np.eye(3)
    assembled = sum(np.einsum("kia,kij,kjb->ab", rows, np.asarray(part.matrices), rows) for part in parts)
    np.testing.assert_allclose(assembled, hessian, atol=1e-8 * np.abs(hessian).max())


def test_a_wrong_pair_is_one_whose_own_precision_is_small():
    """The mean and the tail of Gamma(ν/2, ν/2) given z², by quadrature."""
    noise, squares = StudentTNoise(nu=5.0), np.array([0.0, 3.0, 30.0, 300.0])
    tau = np.linspace(1e-6, 60, 2_000_001)
    for square, weight, probability in zip(
        squares, noise.weight(squares), noise.probability_of_wrong(squares), strict=True
    ):
        density = stats.gamma(noise.nu / 2, scale=2 / noise.nu).pdf(tau) * tau**1.5 * np.exp(-tau * square / 2)
        density /= density.sum()
        np.testing.assert_allclose(weight, density @ tau, rtol=1e-4)
        np.testing.assert_allclose(probability, density[tau < 1 / WRONG**2].sum(), rtol=1e-3, atol=1e-6)
    assert noise.probability_of_wrong(np.array([300.0]))[0] > 0.9
    assert NormalNoise().probability_of_wrong(squares) is None


def test_standardised_residuals_have_a_mean_square_of_one():
    noise = StudentTNoise(nu=4.0)
    draws = stats.multivariate_t(shape=np.diag([0.04, 0.25, 1.0]), df=4.0).rvs(200_000, random_state=0)
    squares = (draws**2 / [0.04, 0.25, 1.0]).sum(axis=1)
    np.testing.assert_allclose((noise.weight(squares) * squares).mean() / 3, 1.0, atol=0.01)
    np.testing.assert_allclose((draws**2).mean(axis=0) / [0.04, 0.25, 1.0], noise.variance, rtol=0.1)


def test_inferred_sds_have_names_by_axis():
    assert list(placed(BY_AXIS, NOISES[1]).blocks) == ["landmarks_sd_x", "landmarks_sd_z"]
    assert placed(BY_AXIS, NOISES[1]).term.hyperparameters == ("landmarks_sd_x", "landmarks_sd_z")
    assert list(placed(br.ScalePrior(median=1.0), NOISES[1]).blocks) == ["landmarks_sd"]
    np.testing.assert_allclose(placed(np.array([[1.0, 2.0, 3.0]]), NOISES[1]).term.sd({})[4], [1, 2, 3])


def test_a_point_near_the_mesh_takes_the_nearest_place_with_a_wider_sd():
    high = MESH.points[:, 2].max()
    outside = np.array([[9.0, 11.0, high + 2.0]])
    observation = br.Landmarks(np.vstack([FIXED, outside]), np.vstack([MOVING, outside]), 0.5, noise=NormalNoise())
    term = observation.on(MESH).term
    linear = MESH.points @ np.array([[0.1, 0.0, 0.02], [0.0, 0.05, 0.0], [0.03, 0.0, 0.2]])
    at_surface = np.array([9.0, 11.0, high]) @ np.array([[0.1, 0.0, 0.02], [0.0, 0.05, 0.0], [0.03, 0.0, 0.2]])
    np.testing.assert_allclose(np.asarray(term.predicted(state_of(linear)))[-1], at_surface, atol=1e-9)
    np.testing.assert_allclose(np.asarray(term.sd({}))[-1], np.hypot(0.5, 0.2 * 2.0))
    np.testing.assert_allclose(np.asarray(term.sd({}))[:-1], 0.5)


def test_points_far_outside_are_left_out_by_name(caplog):
    far = np.array([[9.0, 11.0, MESH.points[:, 2].max() + 3 * MESH.boundary_edge]])
    labels = [*(f"p{k}" for k in range(12)), "stray"]
    observation = br.Landmarks(np.vstack([FIXED, far]), np.vstack([MOVING, far]), 0.5, labels=labels)
    placed_observation = observation.on(MESH)
    assert placed_observation.observation.labels == tuple(labels[:-1])
    assert len(placed_observation.term.shift) == len(placed_observation.observation.fixed_points) == 12
    assert "stray" in caplog.text
    assert "1 of 13 points" in caplog.text


def test_a_run_is_refused_where_fewer_than_four_points_are_left():
    far = FIXED + np.array([0.0, 0.0, 500.0])
    few = np.vstack([FIXED[:3], far[3:]])
    with pytest.raises(br.InputError, match=r"9 of 12 points lie .* outside the mesh.*fewer than 4 points are left"):
        br.Landmarks(few, MOVING, 0.5).on(MESH)
