"""The V-cycle is a preconditioner: linear, symmetric, positive definite, and as good on a finer mesh."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse.linalg

import bayesreg as br
from bayesreg.fem import equilibrium, preconditioners
from bayesreg.fem.elasticity import rigid_modes, stiffness, unknowns_of
from bayesreg.fem.multigrid import multigrid
from tests.phantoms import LAM, MU, PAPER_LAM, PAPER_MU, ball_mesh

RNG = np.random.default_rng(0)


@cache
def problem(spacing):
    mesh = ball_mesh(spacing=spacing)
    free = unknowns_of(mesh.interior)
    matrix = stiffness(mesh, LAM, MU)[free][:, free]
    return mesh, matrix, multigrid(matrix, rigid_modes(mesh.points[mesh.interior]))


def test_it_has_levels_and_ends_in_a_dense_inverse():
    _, matrix, cycle = problem(8.0)
    assert len(cycle.levels) >= 1
    assert cycle.coarsest.shape[0] < matrix.shape[0] / 4
    assert cycle.levels[0].matrix.dtype == np.float32


def test_it_is_linear_symmetric_and_positive_definite():
    _, matrix, cycle = problem(8.0)
    a, b = (jnp.asarray(RNG.normal(size=(matrix.shape[0] // 3, 3, 1))) for _ in range(2))
    once, twice = cycle(a), cycle(b)
    np.testing.assert_allclose(cycle(2 * a - b), 2 * once - twice, atol=1e-5 * float(abs(once).max()))
    assert float((b * once).sum()) == pytest.approx(float((a * twice).sum()), abs=1e-5 * float((a * once).sum()))
    assert float((a * once).sum()) > 0


def test_chains_are_cycled_as_they_are_alone():
    _, matrix, cycle = problem(8.0)
    many = jnp.asarray(RNG.normal(size=(matrix.shape[0] // 3, 3, 5)))
    found = jax.jit(lambda cycle, r: cycle(r))(cycle, many)
    np.testing.assert_allclose(found[..., 3:4], cycle(many[..., 3:4]), atol=1e-6 * float(abs(found).max()))


@pytest.mark.parametrize("spacing", [10.0, 6.0])
def test_conjugate_gradients_need_few_iterations(spacing, monkeypatch):
    """And solve what SuperLU solves, at λ and μ other than those of the reference."""
    monkeypatch.setattr(preconditioners, "DENSE_LIMIT", 500)
    mesh, _, _ = problem(spacing)
    system = equilibrium.elastic_system(mesh, mesh.boundary, LAM, MU)
    u_boundary = RNG.normal(size=(len(mesh.boundary), 3))
    for lam, mu, most in ((LAM, MU, 25), (1.5 * LAM, MU, 30), (PAPER_LAM[::-1], PAPER_MU, 2000)):
        cells = (jnp.asarray(values[mesh.tissue]) for values in (lam, mu))
        found = equilibrium.equilibrium(system, *cells, jnp.asarray(u_boundary))
        assert bool(found.converged)
        assert int(found.iterations) <= most
        K = stiffness(mesh, lam, mu).tocsc()
        free, given = unknowns_of(mesh.interior), unknowns_of(mesh.boundary)
        expected = scipy.sparse.linalg.spsolve(K[free][:, free], -K[free][:, given] @ u_boundary.ravel())
        np.testing.assert_allclose(np.ravel(found.u[mesh.interior]), expected, atol=1e-6 * abs(expected).max())


def test_large_meshes_are_solved_with_it(monkeypatch):
    monkeypatch.setattr(preconditioners, "DENSE_LIMIT", 500)
    mesh, _, _ = problem(10.0)
    found = br.solve_interior(mesh, LAM, MU, RNG.normal(size=(len(mesh.boundary), 3)))
    assert bool(found.converged)
    assert int(found.iterations) <= 25
