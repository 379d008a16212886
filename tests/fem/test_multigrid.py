"""The V-cycle is a preconditioner: linear, symmetric, positive definite, and as good on a finer mesh."""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse.linalg

import bayesreg as br
from bayesreg.fem import equilibrium, preconditioners
from bayesreg.fem.elasticity import rigid_modes, stiffness, unknowns_of
from bayesreg.fem.multigrid import Multigrid, build_multigrid
from bayesreg.inference.target import logdensity
from tests.options import posterior_of
from tests.phantoms import LAM, MU, PAPER_LAM, PAPER_MU, ball_mesh, smooth_image

RNG = np.random.default_rng(0)


@cache
def problem(spacing):
    mesh = ball_mesh(spacing=spacing)
    free = unknowns_of(mesh.interior)
    matrix = stiffness(mesh, LAM, MU)[free][:, free]
    return mesh, matrix, build_multigrid(matrix, rigid_modes(mesh.points[mesh.interior]))


def test_it_has_levels_and_ends_in_a_dense_inverse():
    _, matrix, cycle = problem(8.0)
    assert len(cycle.levels) >= 1
    assert cycle.coarsest.shape[0] < matrix.shape[0] / 4
    assert cycle.levels[0].matrix.matrix.entries.dtype == np.float32


def test_it_is_linear_symmetric_and_positive_definite():
    _, matrix, cycle = problem(8.0)
    a, b = (jnp.asarray(RNG.normal(size=(matrix.shape[0] // 3, 3, 1))) for _ in range(2))
    once, twice = cycle(a), cycle(b)
    np.testing.assert_allclose(cycle(2 * a - b), 2 * once - twice, atol=1e-5 * float(abs(once).max()))
    assert float((b * once).sum()) == pytest.approx(float((a * twice).sum()), abs=1e-5 * float((a * once).sum()))
    assert float((a * once).sum()) > 0


def test_chains_are_cycled_as_they_are_alone():
    _, matrix, cycle = problem(8.0)
    residuals = jnp.asarray(RNG.normal(size=(matrix.shape[0] // 3, 3, 5)))
    cycled = jax.jit(lambda cycle, r: cycle(r))(cycle, residuals)
    np.testing.assert_allclose(cycled[..., 3:4], cycle(residuals[..., 3:4]), atol=1e-6 * float(abs(cycled).max()))


def two_soft_nodes(mesh):
    """λ = 10, μ = 1, but a hundredth of it in all cells of two neighbours in the middle."""
    middle = mesh.interior[np.argsort(np.linalg.norm(mesh.points[mesh.interior] - mesh.points.mean(axis=0), axis=1))[0]]
    around = mesh.cells[(mesh.cells == middle).any(axis=1)]
    neighbour = next(node for node in np.unique(around) if node != middle and node in mesh.interior)
    soft = np.isin(mesh.cells, (middle, neighbour)).any(axis=1)
    factor = np.where(soft, 0.01, 1.0)
    return 10 * factor, factor


def by_cell(lam, mu):
    return lambda mesh: (lam[mesh.tissue], mu[mesh.tissue])


@pytest.mark.parametrize(
    ("reference", "factor", "most"),
    [
        (by_cell(LAM, MU), 1.0, 20),
        (by_cell(LAM, MU), 1.5, 25),
        (by_cell(PAPER_LAM, PAPER_MU), 1.0, 35),
        (by_cell(PAPER_LAM[::-1], PAPER_MU[::-1]), 1.0, 35),
        (two_soft_nodes, 1.0, 25),
    ],
    ids=["gentle", "away from the reference", "paper", "soft inside", "two soft nodes"],
)
@pytest.mark.parametrize("spacing", [10.0, 6.0])
def test_conjugate_gradients_need_few_iterations(spacing, reference, factor, most, monkeypatch):
    """And solve what SuperLU solves."""
    monkeypatch.setattr(preconditioners, "DENSE_LIMIT", 500)
    mesh, _, _ = problem(spacing)
    lam, mu = reference(mesh)
    system = equilibrium.elastic_system(mesh, mesh.boundary, lam, mu)
    assert isinstance(system.preconditioner, Multigrid)
    lam = lam * factor ** (mesh.tissue == 1)
    u_boundary = RNG.normal(size=(len(mesh.boundary), 3))
    solution = equilibrium.equilibrium(system, *map(jnp.asarray, (lam, mu, u_boundary)))
    assert bool(solution.converged)
    assert int(solution.iterations) <= most
    K = stiffness(mesh, lam, mu).tocsc()
    free, prescribed = unknowns_of(mesh.interior), unknowns_of(mesh.boundary)
    expected = scipy.sparse.linalg.spsolve(K[free][:, free], -K[free][:, prescribed] @ u_boundary.ravel())
    np.testing.assert_allclose(np.ravel(solution.u[mesh.interior]), expected, atol=1e-6 * abs(expected).max())


def test_the_same_matrix_has_the_same_hierarchy():
    """Bit by bit: else the same seed would not give the same draws, and nothing compiled would serve again."""
    mesh, matrix, cycle = problem(8.0)
    again = build_multigrid(matrix, rigid_modes(mesh.points[mesh.interior]))
    for array, expected in zip(jax.tree.leaves(again), jax.tree.leaves(cycle), strict=True):
        np.testing.assert_array_equal(array, expected)


@pytest.mark.parametrize("broken", ["nothing held", "empty", "nan"])
def test_what_has_no_solution_is_said(broken):
    mesh, _, _ = problem(10.0)
    nodes = np.arange(len(mesh.points)) if broken == "nothing held" else mesh.interior
    matrix = stiffness(mesh, LAM, MU)[unknowns_of(nodes)][:, unknowns_of(nodes)].tolil()
    if broken != "nothing held":
        matrix[4] = matrix[:, 4] = 0.0 if broken == "empty" else np.nan
    with pytest.raises(br.InputError, match="the interior stiffness is singular"):
        build_multigrid(matrix.tocsr(), rigid_modes(mesh.points[nodes]))


def test_slopes_of_a_large_mesh(monkeypatch):
    """∂/∂(λ, μ, u_B) of a functional of u, by the adjoint, against those with a dense inverse."""
    mesh, _, _ = problem(10.0)
    weight = jnp.asarray(RNG.normal(size=mesh.points.shape))
    state = jnp.asarray(LAM), jnp.asarray(MU), jnp.asarray(RNG.normal(size=(len(mesh.boundary), 3)))
    slopes = []
    for limit in (500, 6000):
        monkeypatch.setattr(preconditioners, "DENSE_LIMIT", limit)
        system = equilibrium.elastic_system(mesh, mesh.boundary, LAM, MU, 1e-12)

        def functional(lam, mu, u, system=system):
            return (weight * equilibrium.equilibrium(system, lam[mesh.tissue], mu[mesh.tissue], u).u).sum()

        slopes.append(jax.grad(functional, argnums=(0, 1, 2))(*state))
    for slope, expected in zip(*slopes, strict=True):
        np.testing.assert_allclose(slope, expected, rtol=1e-8, atol=1e-9)


def test_a_posterior_of_a_large_mesh_is_compiled_once(monkeypatch):
    """Chains keep the hierarchy, wherever they are, and with it every shape."""
    monkeypatch.setattr(preconditioners, "DENSE_LIMIT", 100)
    mesh = ball_mesh(spacing=13.0)
    images = (smooth_image(mesh.points, seed=seed) for seed in (1, 2))
    post = posterior_of(*images, mesh, interpolation="cubic")
    values = post.reference()
    reference_data = post.target.condition(post.estimands(values))
    changed_data = post.target.condition(post.estimands(values | {"mu": values["mu"] * np.array([0.5, 3.0, 1.0])}))
    density = jax.jit(partial(logdensity, post.target))
    first, second = (float(density(data, post.initial(jax.random.key(0)))) for data in (reference_data, changed_data))
    assert density._cache_size() == 1
    assert first == pytest.approx(second, rel=1e-5)
    slope = jax.grad(lambda x: logdensity(post.target, reference_data, x))(post.initial(jax.random.key(0)))
    exact = jax.grad(post.logdensity)(post.initial(jax.random.key(0)))
    for name, value in exact.items():
        np.testing.assert_allclose(slope[name], value, atol=0.01 * float(abs(value).max()))
