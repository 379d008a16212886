"""The oracle against itself: its formulas must agree with one another before they judge anything."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from tests.oracles import paper
from tests.phantoms import LAM, MU, ball_mesh, box_mesh, linear_image, smooth_image


@pytest.fixture(scope="module")
def mesh():
    return ball_mesh(spacing=24.0)


@pytest.fixture(scope="module")
def oracle(mesh):
    fixed, moving = smooth_image(mesh.points, seed=1), smooth_image(mesh.points, seed=2)
    return paper.Paper(
        mesh.points,
        mesh.cells,
        mesh.tissue,
        (fixed.voxels, fixed.affine),
        (moving.voxels, moving.affine),
        mesh.boundary,
    )


def test_potential_of_eq_2_is_the_strain_energy_of_eq_3(mesh, oracle):
    u = np.random.default_rng(0).normal(size=mesh.points.shape)
    K = oracle.stiffness(LAM, MU)
    assert oracle.strain(u, LAM, MU) == pytest.approx(0.5 * u.ravel() @ (K @ u.ravel()), rel=1e-12)


def test_interior_solution_has_the_least_energy(mesh, oracle):
    rng = np.random.default_rng(1)
    u = oracle.displacement(rng.normal(size=(len(mesh.boundary), 3)), LAM, MU)
    least = oracle.strain(u, LAM, MU)
    for _ in range(5):
        perturbed = u.copy()
        perturbed[mesh.interior] += 1e-2 * rng.normal(size=(len(mesh.interior), 3))
        assert oracle.strain(perturbed, LAM, MU) > least


@pytest.mark.parametrize("rule", ["gauss4", "gauss32"])
def test_rules_integrate_quadratics_exactly(mesh, rule):
    owner, barycentric, weight = paper.mesh_rule(mesh.points, mesh.cells, rule)
    x = np.einsum("qa,qai->qi", barycentric, mesh.points[mesh.cells[owner]])
    # ∫ x_i x_j over a tetrahedron = V / 20 (Σ_a x_a x_aᵀ + 16 c cᵀ), c its centroid.
    exact = np.zeros((3, 3))
    for cell in mesh.cells:
        p = mesh.points[cell]
        exact += paper.volume(p) / 20 * (p.T @ p + 16 * np.outer(p.mean(axis=0), p.mean(axis=0)))
    np.testing.assert_allclose((x.T * weight) @ x, exact, rtol=1e-12)
    assert (barycentric > 0).all()


def test_children_fill_their_parent():
    for diagonal in range(3):
        children = paper.eight_children(diagonal)
        parent = np.random.default_rng(2).normal(size=(4, 3))
        volumes = [abs(paper.volume(child @ parent)) for child in children]
        np.testing.assert_allclose(volumes, abs(paper.volume(parent)) / 8, rtol=1e-12)


def test_voxel_rule_covers_the_mesh(mesh):
    image = smooth_image(mesh.points, shape=(28, 24, 30))
    owner, barycentric, weight = paper.voxel_rule(mesh.points, mesh.cells, image.shape, image.affine)
    assert weight.sum() == pytest.approx(mesh.volumes.sum(), rel=0.02)
    np.testing.assert_allclose(barycentric.sum(axis=1), 1, atol=1e-12)
    assert set(owner) == set(range(len(mesh.cells)))


def test_schur_complement_gives_the_energy_of_the_boundary(mesh, oracle):
    u_boundary = np.random.default_rng(3).normal(size=(len(mesh.boundary), 3))
    S = paper.schur_complement(oracle.stiffness(LAM, MU), mesh.boundary)
    energy = oracle.strain(oracle.displacement(u_boundary, LAM, MU), LAM, MU)
    assert 0.5 * u_boundary.ravel() @ S @ u_boundary.ravel() == pytest.approx(energy, rel=1e-10)
    eigenvalues = np.linalg.eigvalsh(S)
    assert (abs(eigenvalues[:6]) < 1e-12 * eigenvalues[-1]).all()
    assert eigenvalues[6] > 1e-3 * eigenvalues[-1]


def test_rigid_modes_are_orthonormal_and_cost_no_energy(mesh, oracle):
    modes = paper.rigid_modes(mesh.points)
    np.testing.assert_allclose(modes.T @ modes, np.eye(6), atol=1e-12)
    for mode in modes.T:
        assert oracle.strain(mode.reshape(-1, 3), LAM, MU) < 1e-12


def test_closed_form_is_the_density(mesh):
    """The Gaussian differs from log p by one constant on random states: the two share no integration code path."""
    gradient = np.array([0.03, -0.02, 0.04])
    moving = linear_image(mesh.points, gradient, offset=0.4)
    fixed = smooth_image(mesh.points, seed=4)
    oracle = paper.Paper(
        mesh.points,
        mesh.cells,
        mesh.tissue,
        (fixed.voxels, fixed.affine),
        (moving.voxels, moving.affine),
        mesh.boundary,
        t_similarity=3.0,
        t_elastic=200.0,
        rigid_sd=2.0,
    )
    exact = paper.gaussian_posterior(oracle, LAM, MU, 0.4, gradient)
    normal = stats.multivariate_normal(exact.mean, exact.covariance)
    states = np.random.default_rng(5).normal(size=(6, len(mesh.boundary), 3))
    difference = [oracle.logdensity(u, LAM, MU) - normal.logpdf(u.ravel()) for u in states]
    np.testing.assert_allclose(difference, difference[0], rtol=1e-9)
    assert np.ptp([normal.logpdf(u.ravel()) for u in states]) > 10


def test_draws_follow_the_gaussian():
    exact = paper.Gaussian(np.array([1.0, -2.0]), np.array([[2.0, 0.6], [0.6, 1.0]]))
    draws = exact.draw(np.random.default_rng(6), 200_000)
    np.testing.assert_allclose(draws.mean(axis=0), exact.mean, atol=0.015)
    np.testing.assert_allclose(np.cov(draws.T), exact.covariance, atol=0.02)


def test_box_phantom_is_the_whole_box():
    assert box_mesh(3, size=20.0).volumes.sum() == pytest.approx(8000, rel=1e-12)
