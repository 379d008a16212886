"""How the interior solve tells its quality, and what it does with bad numbers."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np
import pytest

import bayesreg as br
from tests.oracles import paper
from tests.phantoms import LAM, MU, PAPER_LAM, PAPER_MU, ball_mesh


@pytest.fixture(scope="module")
def mesh():
    return ball_mesh(spacing=18.0)


@pytest.fixture(scope="module")
def u_boundary(mesh):
    return np.random.default_rng(0).normal(size=(len(mesh.boundary), 3))


def lu_solution(mesh, lam, mu, u_boundary):
    K = paper.stiffness(mesh.points, mesh.cells, lam[mesh.tissue], mu[mesh.tissue])
    return K, paper.solve_unknown(K, mesh.boundary, u_boundary)


@pytest.fixture(scope="module")
def traced(mesh):
    """The solve inside a compiled program, where the preconditioner cannot know the parameters."""
    return jax.jit(partial(br.solve_interior, mesh), static_argnames="tolerance")


def relative_residual(mesh, K, u, u_boundary):
    """As documented: in the norm of the inverse diagonal."""
    free = (3 * mesh.interior[:, None] + np.arange(3)).ravel()
    prescribed = np.zeros(mesh.points.shape)
    prescribed[mesh.boundary] = u_boundary
    residual, load = (
        np.sqrt(((K @ v.ravel())[free] ** 2 / K.diagonal()[free]).sum()) for v in (np.asarray(u), prescribed)
    )
    return residual / load


@pytest.mark.parametrize(
    ("lam", "mu"),
    [(LAM, MU), (PAPER_LAM, PAPER_MU), (PAPER_LAM[::-1].copy(), PAPER_MU[::-1].copy())],
    ids=["gentle", "soft inside", "soft white matter"],
)
@pytest.mark.parametrize("inside", ["eager", "compiled"])
def test_solution_residual_and_iterations(mesh, traced, u_boundary, lam, mu, inside):
    solution = (traced if inside == "compiled" else partial(br.solve_interior, mesh))(lam, mu, u_boundary)
    K, expected = lu_solution(mesh, lam, mu, u_boundary)
    np.testing.assert_allclose(solution.u, expected, atol=1e-7 * abs(expected).max())
    assert bool(solution.converged)
    assert 0 < float(solution.residual) <= 1e-8
    assert 1 <= int(solution.iterations) < 400
    assert relative_residual(mesh, K, solution.u, u_boundary) <= 1.5e-8


def test_a_tighter_tolerance_is_met(traced, u_boundary):
    rough = traced(PAPER_LAM, PAPER_MU, u_boundary, tolerance=1e-3)
    fine = traced(PAPER_LAM, PAPER_MU, u_boundary, tolerance=1e-12)
    assert 1e-9 < float(rough.residual) <= 1e-3
    assert 0 < float(fine.residual) <= 1e-12
    assert int(rough.iterations) < int(fine.iterations)


def test_too_few_iterations_are_confessed(mesh, u_boundary, monkeypatch):
    monkeypatch.setattr("bayesreg.fem.conjugate_gradients.MAX_ITERATIONS", 3)
    solution = jax.jit(partial(br.solve_interior, mesh))(PAPER_LAM, PAPER_MU, u_boundary)
    assert not bool(solution.converged)
    assert int(solution.iterations) == 3
    assert float(solution.residual) > 1e-8


@pytest.mark.parametrize("place", ["lam", "mu", "u_boundary"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_never_raise(mesh, u_boundary, place, value):
    arrays = {"lam": LAM.copy(), "mu": MU.copy(), "u_boundary": u_boundary.copy()}
    arrays[place].flat[1] = value
    assert not bool(br.solve_interior(mesh, **arrays).converged)


@pytest.mark.parametrize("scale", [1e308, 1e-310])
def test_extreme_parameters_never_raise(mesh, u_boundary, scale):
    """What overflows or underflows may solve or not, but what is called converged solves it."""
    solution = br.solve_interior(mesh, scale * np.ones(3), scale * np.ones(3), u_boundary)
    if bool(solution.converged):
        _, expected = lu_solution(mesh, np.ones(3), np.ones(3), u_boundary)
        np.testing.assert_allclose(solution.u, expected, atol=1e-5)


def test_negative_parameters_are_not_called_converged_wrongly(mesh, u_boundary):
    """An indefinite system may be solved or not, but what is called converged solves it."""
    lam, mu = np.array([2.0, -30.0, 8.0]), MU
    solution = br.solve_interior(mesh, lam, mu, u_boundary)
    if bool(solution.converged):
        _, expected = lu_solution(mesh, lam, mu, u_boundary)
        np.testing.assert_allclose(solution.u, expected, atol=1e-5 * abs(expected).max())


def test_nothing_moves_if_the_boundary_does_not(mesh):
    solution = br.solve_interior(mesh, LAM, MU, np.zeros((len(mesh.boundary), 3)))
    assert bool(solution.converged)
    np.testing.assert_array_equal(solution.u, 0)


def test_linear_in_the_boundary_and_scale_free_in_the_parameters(mesh, u_boundary):
    once = br.solve_interior(mesh, LAM, MU, u_boundary).u
    np.testing.assert_allclose(br.solve_interior(mesh, LAM, MU, -3 * u_boundary).u, -3 * once, atol=1e-6)
    np.testing.assert_allclose(br.solve_interior(mesh, 1e3 * LAM, 1e3 * MU, u_boundary).u, once, atol=1e-6)


def test_one_bad_chain_leaves_the_others_alone(mesh, u_boundary):
    batch = np.stack([u_boundary, np.full_like(u_boundary, np.nan), 2 * u_boundary])
    solution = jax.vmap(lambda u: br.solve_interior(mesh, LAM, MU, u))(batch)
    np.testing.assert_array_equal(solution.converged, [True, False, True])
    expected = br.solve_interior(mesh, LAM, MU, u_boundary).u
    np.testing.assert_allclose(solution.u[0], expected, atol=1e-7)
    np.testing.assert_allclose(solution.u[2], 2 * expected, atol=2e-7)


def test_gradient_through_the_solve(mesh, u_boundary):
    """∂/∂(λ, μ, u_B) of a linear functional of u, against central differences of the LU solution."""
    rng = np.random.default_rng(1)
    weight = rng.normal(size=mesh.points.shape)
    direction = {
        "lam": rng.normal(size=3) * PAPER_LAM,
        "mu": rng.normal(size=3) * PAPER_MU,
        "u": rng.normal(size=u_boundary.shape),
    }

    def functional(lam, mu, u):
        return (weight * br.solve_interior(mesh, lam, mu, u, tolerance=1e-12).u).sum()

    gradient = jax.grad(functional, argnums=(0, 1, 2))(PAPER_LAM, PAPER_MU, u_boundary)
    slopes = [float((g * d).sum()) for g, d in zip(gradient, direction.values(), strict=True)]
    for i, (name, d) in enumerate(direction.items()):
        values = []
        for sign in (-1, 1):
            state = [PAPER_LAM, PAPER_MU, u_boundary]
            state[i] = state[i] + sign * 1e-4 * d
            values.append((weight * lu_solution(mesh, *state)[1]).sum())
        assert slopes[i] == pytest.approx((values[1] - values[0]) / 2e-4, rel=1e-6), name
