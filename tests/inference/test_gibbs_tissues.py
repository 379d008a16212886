"""Displacements integrated out for several tissues and for surfaces, against dense matrices and closed forms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy import stats

import bayesreg as br
from bayesreg.fem.elasticity import rigid_modes, stiffness
from bayesreg.inference.samplers.registry import choose_sampler
from bayesreg.model.coordinates import complete
from bayesreg.model.curvature import displacement_curvature
from tests.phantoms import ball_mesh, box_mesh, of_one_tissue

BALL = ball_mesh(spacing=24.0)
LAYERS = br.TetMesh.from_arrays(
    BALL.points, BALL.cells, (BALL.points[BALL.cells].mean(axis=1)[:, 2] > 8).astype(int), ("low", "high")
)
RNG = np.random.default_rng(0)
FIXED = LAYERS.points[RNG.choice(len(LAYERS.points), 20, replace=False)] * 0.8 + np.array([1.0, -0.6, 1.6])
MOVING = FIXED + RNG.normal(0, 1.0, FIXED.shape)


# λ and μ of both tissues, and the sizes of the loads.
PLACES = [
    ((5.0, 2.0), (1.0, 3.0), (0.1, 0.2)),
    ((20.0, 0.5), (1.0, 0.4), (0.5, 0.05)),
    ((1.0, 9.0), (1.0, 8.0), (0.02, 0.6)),
]


def posterior_of(rigid_sd=2.0):
    model = br.ModelConfig(preset="registration", rigid_sd=rigid_sd)
    return br.build_posterior(LAYERS, [br.Landmarks(FIXED, MOVING, 0.7, noise=br.NormalNoise())], model)


def estimands_at(posterior, lam, mu, loads):
    values = {**posterior.reference(), "lam": jnp.asarray(lam), "mu": jnp.asarray(mu)}
    return posterior.estimands({**values, "body_load": jnp.asarray(loads[0]), "surface_load": jnp.asarray(loads[1])})


def test_the_marginal_density_of_two_tissues_is_laplace_s_integral():
    """The joint density at the conditional mean, less half the log determinant of its exact curvature."""
    posterior = posterior_of()
    marginal = posterior.target.prepare_marginal()
    differences = []
    for lam, mu, loads in PLACES:
        estimands = estimands_at(posterior, lam, mu, loads)
        values = complete(posterior.data.blocks, estimands)
        curvature = displacement_curvature(posterior.data, values, np.zeros(LAYERS.points.shape)).gauss_newton
        slope = jax.grad(lambda u, values=values: posterior.logdensity_constrained({**values, "u_boundary": u}))(
            jnp.zeros(LAYERS.points.shape)
        )
        mean = np.linalg.solve(curvature, np.asarray(slope).ravel()).reshape(-1, 3)
        joint = posterior.logdensity_constrained({**values, "u_boundary": mean})
        laplace = joint - np.linalg.slogdet(curvature)[1] / 2
        # The barrier has no part in the marginal density.
        laplace -= posterior.energies({**values, "u_boundary": mean})["barrier"]
        differences.append(float(marginal.log(estimands, jnp.ones(len(FIXED))) - laplace))
    np.testing.assert_allclose(differences, differences[0], rtol=0, atol=1e-5)


def test_displacements_of_two_tissues_are_drawn_from_their_conditional():
    posterior = posterior_of()
    marginal = posterior.target.prepare_marginal()
    estimands = estimands_at(posterior, (5.0, 2.0), (1.0, 3.0), (0.1, 0.2))
    keys = jax.random.split(jax.random.key(0), 4000)
    draws = jax.vmap(lambda key: marginal.draw_displacements(key, estimands, jnp.ones(len(FIXED))))(keys)
    values = complete(posterior.data.blocks, estimands)
    covariance = np.linalg.inv(
        displacement_curvature(posterior.data, values, np.zeros(LAYERS.points.shape)).gauss_newton
    )
    flat = np.asarray(draws).reshape(len(keys), -1)
    directions = scipy.linalg.eigh(covariance)[1][:, [-1, -2, -7, -40]]
    drawn = (flat @ directions).var(axis=0)
    expected = np.einsum("ia,ij,ja->a", directions, covariance, directions)
    assert stats.chi2(len(keys)).ppf(1e-4) / len(keys) < (drawn / expected).min()
    assert (drawn / expected).max() < stats.chi2(len(keys)).ppf(1 - 1e-4) / len(keys)


@pytest.mark.long
def test_a_surface_that_is_flat_has_the_gaussian_posterior_of_its_heights():
    """A half-space moved along its normal: the sampled top of a box against dense matrices."""
    mesh = of_one_tissue(box_mesh(3))
    top = mesh.points[:, 2].max()
    points = np.c_[RNG.uniform(4, 16, (60, 2)), np.full(60, top + 0.3) + RNG.normal(0, 0.3, 60)]
    model = br.ModelConfig(
        preset="registration", elasticity="uniform", fixed={"lam": 2.0, "mu": 1.0}, rigid_sd=0.2, least_volume=0.0,
        elastic_prior=br.RandomLoads(body=0.005, surface=0.01),
    )  # fmt: skip
    posterior = br.build_posterior(mesh, [br.Surface(points, sd=0.3, noise=br.NormalNoise())], model)
    posterior = posterior.with_independent_points({"surface": 60.0})
    assert choose_sampler("auto", posterior.target).name == "gibbs"
    result = br.sample(posterior, chains=4, draws=250, seed=0)
    assert result.idata.sample_stats.acceptance_rate.mean() > 0.9
    u = result.idata.posterior.u_boundary.values.reshape(1000, -1)
    # Heights are linear in the displacements, since the points stand over the flat top.
    term = posterior.data.terms["surface"]
    slope = np.asarray(jax.jacrev(lambda u: term.height(u))(jnp.zeros(mesh.points.shape))).reshape(60, -1)
    variances = np.repeat(
        0.005**2 * mesh.nodal_volumes + 0.01**2 * np.asarray(posterior.data.terms["elastic"].areas), 3
    )
    ones = np.ones(len(mesh.cells))
    K, R = stiffness(mesh, 2 * ones, ones).toarray(), rigid_modes(mesh.points)
    prior = K @ (K / variances[:, None]) + R @ R.T / (0.2**2 * len(mesh.points))
    precision = prior + slope.T @ slope / 0.3**2
    mean = np.linalg.solve(precision, -slope.T @ np.asarray(term.height(jnp.zeros(mesh.points.shape))) / 0.3**2)
    sd = np.sqrt(np.diag(np.linalg.inv(precision)))
    np.testing.assert_allclose(u.mean(axis=0), mean, atol=5 / np.sqrt(1000) * sd.max())
    np.testing.assert_allclose(u.std(axis=0), sd, rtol=0.12)
