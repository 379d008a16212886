"""Sparse products on the device against SciPy's, for any number of columns, under vmap and differentiated."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse

from bayesreg.fem.elasticity import (
    force_between,
    internal_force,
    stiffness,
    stiffness_diagonal,
    strain_energy,
    unknowns_of,
)
from bayesreg.fem.elements import derivative_matrix, displacement_gradient, elements_of, gauss_quadrature
from bayesreg.fem.operators import sparse_operator
from tests.phantoms import LAM, MU, ball_mesh

MESH = ball_mesh(spacing=20.0)
RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def matrix():
    """An empty row, an empty column and entries given in two parts among the others."""
    dense = RNG.normal(size=(13, 9)) * (RNG.random((13, 9)) < 0.4)
    dense[4], dense[:, 2] = 0, 0
    entries = scipy.sparse.coo_array(dense)
    data, row, column = np.tile(entries.data / 2, 2), np.tile(entries.row, 2), np.tile(entries.col, 2)
    return scipy.sparse.coo_array((data, (row, column)), shape=dense.shape)


@pytest.mark.parametrize("columns", [1, 2, 3, 4, 5, 12])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_product_is_scipys(matrix, columns, dtype):
    operator, x = sparse_operator(matrix.astype(dtype)), RNG.normal(size=(9, columns)).astype(dtype)
    product = jax.jit(lambda operator, x: operator(x))(operator, x)
    assert product.dtype == dtype
    np.testing.assert_allclose(product, matrix @ x, atol=50 * np.finfo(dtype).eps)


def test_chains_and_candidates_join_the_columns(matrix):
    operator, x = sparse_operator(matrix), RNG.normal(size=(3, 2, 9, 5))
    products = jax.jit(jax.vmap(jax.vmap(operator)))(x)
    np.testing.assert_allclose(products, np.einsum("rs,abst->abrt", matrix.toarray(), x), atol=1e-13)
    other_axis = jax.vmap(operator, in_axes=2, out_axes=2)(x[0].swapaxes(0, 1).swapaxes(1, 2))
    np.testing.assert_allclose(other_axis, np.einsum("rs,ast->rta", matrix.toarray(), x[0]), atol=1e-13)


def test_the_derivative_is_the_transposed_product(matrix):
    operator, x, weight = sparse_operator(matrix), RNG.normal(size=(4, 9, 3)), RNG.normal(size=(13, 3))
    dense = matrix.toarray()
    slope = jax.jit(jax.vmap(jax.grad(lambda x: (weight * operator(x) ** 2).sum())))(x)
    expected = [dense.T @ (2 * weight * (dense @ chain)) for chain in x]
    np.testing.assert_allclose(slope, expected, atol=1e-12)


def test_derivatives_of_any_order_in_both_modes(matrix):
    operator, x, way = sparse_operator(matrix), jnp.asarray(RNG.normal(size=(9, 1))), RNG.normal(size=(9, 1))
    dense = matrix.toarray()

    def energy(x):
        return (operator(x) ** 4).sum() / 12

    exact = dense.T @ (np.asarray(dense @ x) ** 2 * dense)
    for hessian in (jax.hessian(energy), jax.jacrev(jax.grad(energy)), jax.jacfwd(jax.jacfwd(energy))):
        np.testing.assert_allclose(hessian(x)[:, 0, :, 0], exact, atol=1e-11)
    along = jax.jvp(jax.grad(energy), (x,), (jnp.asarray(way),))[1]
    np.testing.assert_allclose(along, exact @ way, atol=1e-11)


def test_the_hessian_of_the_strain_energy_is_the_stiffness():
    lam, mu, u = jnp.asarray(LAM), jnp.asarray(MU), jnp.asarray(RNG.normal(size=MESH.points.shape))
    exact = stiffness(MESH, LAM, MU).toarray()
    for hessian in (jax.hessian, lambda f: jax.jacrev(jax.grad(f))):
        second_derivative = hessian(lambda u: strain_energy(MESH, lam, mu, u))(u)
        np.testing.assert_allclose(second_derivative.reshape(exact.shape), exact, atol=1e-10)
    mixed = jax.jacfwd(jax.grad(lambda mu, u: strain_energy(MESH, lam, mu, u), argnums=1))(mu, u)
    for tissue, unit in enumerate(np.eye(3)):
        np.testing.assert_allclose(
            np.ravel(mixed[..., tissue]), stiffness(MESH, 0 * unit, unit) @ np.ravel(u), atol=1e-10
        )


def test_a_chain_that_is_not_a_number_leaves_the_others_alone(matrix):
    operator, x = sparse_operator(matrix), RNG.normal(size=(5, 9, 3))
    x[2] = np.nan
    products = np.asarray(jax.vmap(operator)(x))
    np.testing.assert_allclose(products[[0, 1, 3, 4]], [matrix @ x[i] for i in (0, 1, 3, 4)], atol=1e-13)


def test_the_matrix_cannot_differ_between_chains(matrix):
    operator = sparse_operator(matrix)
    entries = jnp.stack([operator.matrix.entries] * 2)
    with pytest.raises(NotImplementedError, match="matrix of a sparse product cannot differ"):
        jax.vmap(lambda e: operator._replace(matrix=operator.matrix._replace(entries=e))(jnp.ones((9, 1))))(entries)


def test_columns_that_are_not_aligned_are_the_same(matrix):
    """What is padded never shows: neither in the values nor in their number."""
    operator, x = sparse_operator(matrix), RNG.normal(size=(9, 7))
    np.testing.assert_array_equal(operator(jnp.asarray(x[:, :3])), operator(jnp.asarray(x))[:, :3])


def test_what_was_given_stays_as_it_was():
    """Rows are sorted for the device, which must not reach the arrays that they came from."""
    data, columns, starts = RNG.normal(size=6), np.array([4, 1, 0, 3, 2, 1]), np.array([0, 3, 6])
    originals = data.copy(), columns.copy()
    csr_matrix = scipy.sparse.csr_array((data, columns, starts), shape=(2, 5))
    operator = sparse_operator(csr_matrix)
    np.testing.assert_array_equal(data, originals[0])
    np.testing.assert_array_equal(columns, originals[1])
    np.testing.assert_allclose(operator(jnp.eye(5)), csr_matrix.toarray())


def test_displacements_and_gradients_of_a_linear_field():
    slope, shift = RNG.normal(size=(3, 3)), RNG.normal(size=3)
    u = MESH.points @ slope.T + shift
    gradient = displacement_gradient(elements_of(MESH).derivative, jnp.asarray(u))
    np.testing.assert_allclose(gradient, np.repeat(slope[:, :, None], len(MESH.cells), axis=2), atol=1e-12)
    quadrature = gauss_quadrature(MESH)
    places = quadrature.positions(MESH)
    np.testing.assert_allclose(quadrature.interpolation(jnp.asarray(u)), places @ slope.T + shift, atol=1e-12)


@pytest.mark.parametrize("batched", [(0, 0, 0), (None, None, 0), (0, None, None), (None, 0, 0)])
def test_forces_of_chains_are_those_of_the_assembled_matrix(batched):
    elements, chains = elements_of(MESH), 3
    full = [RNG.uniform(1, 2, (chains, len(MESH.cells))), RNG.uniform(1, 2, (chains, len(MESH.cells)))]
    full.append(RNG.normal(size=(chains, *MESH.points.shape)))
    arguments = [x if axis == 0 else x[0] for x, axis in zip(full, batched, strict=True)]
    forces = jax.vmap(lambda *x: internal_force(elements, *x), in_axes=batched)(*map(jnp.asarray, arguments))
    for chain in range(chains):
        lam, mu, u = (x[chain] if axis == 0 else x[0] for x, axis in zip(full, batched, strict=True))
        expected = stiffness(MESH, lam, mu) @ u.ravel()
        np.testing.assert_allclose(np.ravel(forces[chain]), expected, atol=1e-10)


def test_a_block_of_forces_and_its_derivative():
    """Those of the assembled matrix, linear in λ, μ and in u."""
    elements, moved, held = elements_of(MESH), MESH.boundary, MESH.interior
    on, of = (sparse_operator(derivative_matrix(MESH)[:, some]) for some in (held, moved))
    lam, mu = (jnp.asarray(values[MESH.tissue]) for values in (LAM, MU))
    u = jnp.asarray(RNG.normal(size=(len(moved), 3)))

    def force(lam, mu, u):
        return force_between(on, of, elements.volumes, lam, mu, u)

    block = stiffness(MESH, lam, mu)[unknowns_of(held)][:, unknowns_of(moved)]
    np.testing.assert_allclose(np.ravel(force(lam, mu, u)), block @ np.ravel(u), atol=1e-10)
    way = tuple(jnp.asarray(RNG.normal(size=x.shape)) for x in (lam, mu, u))
    _, slope = jax.jvp(force, (lam, mu, u), way)
    np.testing.assert_allclose(slope, force(lam, mu, way[2]) + force(way[0], way[1], u), atol=1e-10)


def test_the_diagonal_is_that_of_the_assembled_matrix():
    elements, some = elements_of(MESH), MESH.interior
    lam, mu = (RNG.uniform(1, 2, (len(MESH.cells), 3)) for _ in range(2))
    diagonal = stiffness_diagonal(sparse_operator(derivative_matrix(MESH)[:, some]), elements.volumes, lam, mu)
    for chain in range(3):
        expected = stiffness(MESH, lam[:, chain], mu[:, chain]).diagonal()[unknowns_of(some)]
        np.testing.assert_allclose(np.ravel(diagonal[..., chain]), expected, rtol=1e-12)
