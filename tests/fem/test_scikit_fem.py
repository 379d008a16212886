"""Stiffness, energy and interior solution against scikit-fem, an independent implementation."""

from __future__ import annotations

import numpy as np
import pytest
import skfem
from skfem.models.elasticity import linear_elasticity

import bayesreg as br
from bayesreg.fem.elasticity import stiffness
from tests.oracles import paper
from tests.phantoms import LAM, MU, PAPER_LAM, PAPER_MU, ball_mesh


@pytest.fixture(scope="module")
def mesh():
    return ball_mesh(spacing=15.0)


def skfem_stiffness(mesh, lam, mu):
    """Sum over cells groups of equal parameters; rows 3 · node + axis."""
    grid = skfem.MeshTet(mesh.points.T.copy(), mesh.cells.T.copy())
    element = skfem.ElementVector(skfem.ElementTetP1())
    matrices = [
        skfem.asm(
            linear_elasticity(lam[t], mu[t]), skfem.Basis(grid, element, elements=np.flatnonzero(mesh.tissue == t))
        )
        for t in range(len(lam))
    ]
    order = skfem.Basis(grid, element).nodal_dofs.T.ravel()
    return sum(matrices)[order][:, order]


@pytest.mark.parametrize(("lam", "mu"), [(LAM, MU), (PAPER_LAM, PAPER_MU)], ids=["gentle", "paper"])
class TestAgainstScikitFem:
    def test_stiffness(self, mesh, lam, mu):
        expected = skfem_stiffness(mesh, lam, mu)
        difference = abs(stiffness(mesh, lam, mu) - expected)
        assert difference.max() <= 1e-10 * abs(expected).max()
        # Row by row too, so that the soft tissue counts as much as the stiff one.
        scale = abs(expected).max(axis=1).toarray()
        assert (difference.max(axis=1).toarray() <= 1e-10 * scale).all()

    def test_energy(self, mesh, lam, mu):
        u = np.random.default_rng(0).normal(size=mesh.points.shape)
        expected = 0.5 * u.ravel() @ (skfem_stiffness(mesh, lam, mu) @ u.ravel())
        assert float(br.strain_energy(mesh, lam, mu, u)) == pytest.approx(expected, rel=1e-10)

    def test_interior_solution(self, mesh, lam, mu):
        u_boundary = np.random.default_rng(1).normal(size=(len(mesh.boundary), 3))
        K = skfem_stiffness(mesh, lam, mu)
        prescribed = np.zeros(K.shape[0])
        degrees = (3 * mesh.boundary[:, None] + np.arange(3)).ravel()
        prescribed[degrees] = u_boundary.ravel()
        expected = skfem.solve(*skfem.condense(K, x=prescribed, D=degrees)).reshape(-1, 3)
        solution = br.solve_interior(mesh, lam, mu, u_boundary)
        assert bool(solution.converged)
        np.testing.assert_allclose(solution.u, expected, atol=1e-7 * abs(expected).max())
        np.testing.assert_array_equal(solution.u[mesh.boundary], u_boundary)

    def test_oracle_too(self, mesh, lam, mu):
        expected = skfem_stiffness(mesh, lam, mu)
        K = paper.stiffness(mesh.points, mesh.cells, lam[mesh.tissue], mu[mesh.tissue])
        assert abs(K - expected).max() <= 1e-12 * abs(expected).max()


def test_by_cell_and_uniform_parameters_agree_with_the_paper(mesh):
    rng = np.random.default_rng(2)
    lam, mu = rng.uniform(0.1, 30, len(mesh.cells)), rng.uniform(0.1, 3, len(mesh.cells))
    u = rng.normal(size=mesh.points.shape)
    expected = paper.elastic_potential(mesh.points, mesh.cells, lam, mu, u)
    assert float(br.strain_energy(mesh, lam, mu, u)) == pytest.approx(expected, rel=1e-10)
    by_cell = stiffness(mesh, lam, mu)
    assert 0.5 * u.ravel() @ (by_cell @ u.ravel()) == pytest.approx(expected, rel=1e-10)
    ones = np.ones(len(mesh.cells))
    expected = paper.elastic_potential(mesh.points, mesh.cells, 7.0 * ones, 0.3 * ones, u)
    assert float(br.strain_energy(mesh, np.array([7.0]), np.array([0.3]), u)) == pytest.approx(expected, rel=1e-10)
