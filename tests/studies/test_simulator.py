"""The simulator of the model against dense linear algebra, SciPy's interpolation and the terms of the density."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from bayesreg.fem.elasticity import rigid_modes, stiffness
from studies.calibration.chains import simulated
from studies.calibration.simulator import (
    DEGREES_OF_FREEDOM,
    IGNORED,
    MESH,
    PRIOR,
    RIGID_SD,
    T_ELASTIC,
    T_SIMILARITY,
    VARIANTS,
    WALL,
    WIDTH,
    Simulator,
)
from tests.oracles import paper

LAM, MU = np.array([0.5, 2.0, 1.0]), np.array([1.0, 0.4, 2.5])


@cache
def simulator(name="no skull"):
    return Simulator(VARIANTS[name])


def require_covariance(draws, expected):
    """Every entry of the covariance of Gaussian draws lies within its error of the expected one."""
    white = np.linalg.solve(np.linalg.cholesky(expected), draws.T)
    count, identity = len(draws), np.eye(len(white))
    z = (white @ white.T / count - identity) * np.sqrt(count) / np.sqrt(1 + identity)
    assert abs(z).max() < 4.9
    assert (z**2).mean() == pytest.approx(1, abs=0.1)


def test_displacements_have_the_pseudo_inverse_for_covariance():
    """T_r S⁺ by a dense pseudo-inverse of the software's own stiffness matrix, and the rigid motions."""
    K = stiffness(MESH, LAM, MU).toarray()
    boundary = (3 * MESH.boundary[:, None] + np.arange(3)).ravel()
    interior = np.setdiff1d(np.arange(len(K)), boundary)
    S = K[np.ix_(boundary, boundary)]
    S = S - K[np.ix_(boundary, interior)] @ np.linalg.inv(K[np.ix_(interior, interior)]) @ K[np.ix_(interior, boundary)]
    modes = rigid_modes(MESH.points[MESH.boundary])
    expected = T_ELASTIC * np.linalg.pinv(S, 1e-9, hermitian=True)
    expected += len(MESH.boundary) * RIGID_SD**2 * modes @ modes.T
    rng, count = np.random.default_rng(0), 2000
    draws = np.stack([simulator().draw_displacement(rng, {"lam": LAM, "mu": MU}).ravel() for _ in range(count)])
    require_covariance(draws, expected)


@pytest.mark.long
def test_displacements_by_random_loads_have_the_pseudo_inverse_for_covariance():
    """(K D⁻¹ K)⁺ of the software's own matrices, and the rigid motions."""
    posterior, values = simulator("loads").posterior, {"lam": LAM, "mu": MU, "body_load": 0.03, "surface_load": 0.02}
    variances = np.repeat(np.asarray(posterior.data.terms["elastic"].variances(values)), 3)
    K, modes = stiffness(MESH, LAM, MU).toarray(), rigid_modes(MESH.points)
    expected = np.linalg.pinv(K @ np.diag(1 / variances) @ K, 1e-9, hermitian=True)
    expected += len(MESH.points) * RIGID_SD**2 * modes @ modes.T
    rng, count = np.random.default_rng(0), 2000
    draws = np.stack([simulator("loads").draw_displacement(rng, values).ravel() for _ in range(count)])
    require_covariance(draws, expected)


def test_energies_of_draws_are_chi_squared():
    """2 E_r / T_r and twice the rigid term of the density under test, at draws of the simulator."""
    posterior = simulator().posterior
    draws = simulator().draw_prior(np.random.default_rng(1), 150)
    terms = [posterior.energies({name: value[i] for name, value in draws.items()}) for i in range(150)]
    elastic = 2 / T_ELASTIC * np.array([float(term["strain_energy"]) for term in terms])
    rigid = -2 * np.array([float(term["rigid"]) for term in terms])
    assert stats.kstest(elastic, stats.chi2(3 * len(MESH.boundary) - 6).cdf).pvalue > 1e-3
    assert stats.kstest(rigid, stats.chi2(6).cdf).pvalue > 1e-3


def test_parameters_are_drawn_from_their_priors():
    rng = np.random.default_rng(2)
    draws = [simulator("temperatures").draw_parameters(rng) for _ in range(1000)]
    beta = stats.beta(PRIOR["alpha"], PRIOR["beta"], scale=PRIOR["high"])
    for name, entry in (("lam", 0), ("lam", 2), ("mu", 0)):
        assert stats.kstest([draw[name][entry] for draw in draws], beta.cdf).pvalue > 1e-3
    assert {draw["mu"][1] for draw in draws} == {2.0}
    for name, median in (("t_similarity", T_SIMILARITY), ("t_elastic", T_ELASTIC)):
        assert stats.kstest([draw[name] for draw in draws], stats.lognorm(0.5, scale=median).cdf).pvalue > 1e-3


@pytest.mark.parametrize("name", ["no skull", "temperatures"])
def test_data_are_the_moving_image_at_displaced_points_and_noise(name):
    """Displaced points by the oracle's solve, m by SciPy's splines: what is left has variance T_s / 2w."""
    posterior = simulator(name).posterior
    draws = simulator(name).draw_prior(np.random.default_rng(3), 12)
    observed = np.asarray(simulated(posterior, posterior.data, draws, jax.random.key(0)))
    cells, barycentric, weights = paper.mesh_rule(MESH.points, MESH.cells, "gauss4")
    moving, residuals = posterior.observations["images"].moving, []
    for i, f in enumerate(observed):
        estimands = {key: value[i] for key, value in draws.items()}
        values = posterior.constrain(posterior.target.coordinates.unconstrain(posterior.data, estimands))
        lam, mu = (np.asarray(values[key])[MESH.tissue] for key in ("lam", "mu"))
        u = paper.solve_unknown(
            paper.stiffness(MESH.points, MESH.cells, lam, mu), MESH.boundary, draws["u_boundary"][i]
        )
        moved = np.einsum("qa,qai->qi", barycentric, (MESH.points + u)[MESH.cells[cells]])
        sd = np.sqrt(estimands.get("t_similarity", T_SIMILARITY) / (2 * weights))
        residuals.append((f - paper.interpolate(moving.voxels, moving.affine, moved, "cubic")) / sd)
    assert stats.kstest(np.ravel(residuals), "norm").pvalue > 1e-3


def test_the_skull_lets_as_many_pass_as_its_density_says():
    """The rule of the simulator, a plane, is the factor of the density, an interpolated distance."""
    walled = simulator("skull").posterior
    draws = simulator().draw_prior(np.random.default_rng(4), 600)
    depth = np.maximum(MESH.points[MESH.boundary, 0] + draws["u_boundary"][..., 0] - WALL, 0.0)
    expected = -0.5 * ((depth / WIDTH) ** 2).sum(axis=1)
    rows = jnp.asarray(draws["u_boundary"])
    log_factor = -0.5 * (jax.vmap(walled.data.terms["skull"].depth)(rows) ** 2).sum(axis=1) / WIDTH**2
    np.testing.assert_allclose(log_factor, expected, atol=1e-6)
    weights = np.exp(expected)
    accepted = simulator("skull").draw_prior(np.random.default_rng(5), 300)
    mean = (weights @ depth.max(axis=1)) / weights.sum()
    deepest = np.maximum(MESH.points[MESH.boundary, 0] + accepted["u_boundary"][..., 0] - WALL, 0.0).max(axis=1)
    assert 0.1 < weights.mean() < 0.8
    assert abs(deepest.mean() - mean) < 5 * deepest.std() / np.sqrt(len(deepest) / 2)


def test_shaded_data_are_any_intensity_where_the_moving_image_is_ignored():
    """By the oracle's splines and SciPy's t, with the box's corner of the mask and the shading written out."""
    shaded = simulator("loads, shading and mask")
    posterior, draws = shaded.posterior, shaded.draw_prior(np.random.default_rng(6), 24)
    observed = np.asarray(simulated(posterior, posterior.data, draws, jax.random.key(0)))
    cells, barycentric, weights = paper.mesh_rule(MESH.points, MESH.cells, "gauss4")
    moving, images, seen, hidden = posterior.observations["images"].moving, posterior.data.terms["images"], [], []
    original = posterior.observations["images"].fixed
    rest = paper.interpolate(original.voxels, original.affine, np.asarray(images.positions), "cubic")
    for i, f in enumerate(observed):
        moved = np.einsum("qa,qai->qi", barycentric, (MESH.points + draws["u_boundary"][i])[MESH.cells[cells]])
        sd = np.sqrt(draws["t_similarity"][i] / (2 * weights))
        m = paper.interpolate(moving.voxels, moving.affine, moved, "cubic")
        m = m - np.asarray(images.shading) @ draws["images_shading"][i]
        # One voxel beyond the ignored ones is ignored, too, and interpolation is half-way to the next.
        away = 2.5 * moving.voxel_sizes.max()
        far, near = moved[:, 0] > IGNORED + away, moved[:, 0] < IGNORED
        seen.append(((f - m) / sd)[far])
        hidden.append(((f - rest.mean()) / np.sqrt(sd**2 + rest.var()))[near])
    for values in (seen, hidden):
        assert len(np.concatenate(values)) > 200
        assert stats.kstest(np.concatenate(values), stats.t(DEGREES_OF_FREEDOM).cdf).pvalue > 1e-3
