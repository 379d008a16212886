"""log pdet S against dense linear algebra, and its derivative against differences and the trace formula."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse

from bayesreg.fem.determinant import (
    BLOCKS_BELOW,
    band_layout,
    band_log_determinant,
    bandwidth,
    log_determinant,
    order_by_neighbours,
    schur_determinant,
)
from bayesreg.fem.elasticity import lame_entries
from bayesreg.fem.elements import elements_of
from bayesreg.fem.host_band import HostBand
from bayesreg.mesh import TetMesh
from tests.oracles import paper
from tests.phantoms import LAM, MU, PAPER_LAM, PAPER_MU, ball_mesh

MESH = ball_mesh(spacing=24.0)
ELEMENTS = elements_of(MESH)
EVERY = np.arange(len(MESH.points))
NOTHING = np.array([], int)
# Sampled nodes, held nodes, and the rigid motions that these leave.
PARTITIONS = {
    "boundary": (MESH.boundary, NOTHING, 6),
    "all": (EVERY, NOTHING, 6),
    "all but two held": (EVERY[2:], EVERY[:2], 1),
    "one held": (MESH.boundary[1:], MESH.boundary[:1], 3),
    "two held, one of them inside": (MESH.boundary[1:], np.r_[MESH.boundary[0], MESH.interior[2]], 1),
    "three held": (MESH.boundary[3:], MESH.boundary[:3], 0),
    "few": (MESH.boundary[::9], NOTHING, 6),
}
SIZES = {"tissue": 3, "uniform": 1, "element": len(MESH.cells)}


def parameters(elasticity, seed=0):
    return 10 ** np.random.default_rng(seed).uniform(-1, 1.3, (2, SIZES[elasticity]))


def by_cell(values):
    return jnp.asarray(values)[lame_entries(MESH, values.shape)]


@jax.jit
def found(partition, lam, mu):
    return partition.log_pseudo_determinant(ELEMENTS, by_cell(lam), by_cell(mu))


def dense_schur(sampled, held, lam, mu):
    """S of the sampled nodes while the held ones rest, and all displacements as a function of the sampled ones."""
    K = paper.stiffness(MESH.points, MESH.cells, *(np.asarray(by_cell(values)) for values in (lam, mu)))
    extension = paper.extension(K, np.r_[sampled, held])[:, : 3 * len(sampled)]
    return extension.T @ (K @ extension), extension


@pytest.mark.parametrize(("sampled", "held", "motions"), PARTITIONS.values(), ids=PARTITIONS)
@pytest.mark.parametrize("elasticity", SIZES)
def test_value_is_that_of_dense_matrices(sampled, held, motions, elasticity):
    partition = schur_determinant(MESH, sampled, held)
    lam, mu = parameters(elasticity)
    eigenvalues = np.linalg.eigvalsh(dense_schur(sampled, held, lam, mu)[0])
    assert abs(eigenvalues[:motions]).max(initial=0) < 1e-9 * eigenvalues[motions]
    assert float(found(partition, lam, mu)) == pytest.approx(np.log(eigenvalues[motions:]).sum(), rel=1e-9)
    assert float(partition.rank) == len(eigenvalues) - motions


def test_determinant_of_the_interior_is_numpys():
    """The paper's contrast of 1e-6 to 30."""
    inner = (3 * MESH.interior[:, None] + np.arange(3)).ravel()
    K = paper.stiffness(MESH.points, MESH.cells, PAPER_LAM[MESH.tissue], PAPER_MU[MESH.tissue])[inner][:, inner]
    layout, expected = band_layout(MESH, inner), np.linalg.slogdet(K.toarray())[1]
    arguments = layout, ELEMENTS, by_cell(PAPER_LAM), by_cell(PAPER_MU)
    assert float(log_determinant(*arguments)) == pytest.approx(expected, rel=1e-9)
    on_device, _ = jax.value_and_grad(log_determinant, argnums=2)(*arguments)
    assert float(on_device) == pytest.approx(expected, rel=1e-9)
    assert np.isnan(log_determinant(*arguments[:2], -arguments[2], arguments[3]))


@pytest.mark.parametrize("elasticity", SIZES)
@pytest.mark.parametrize("name", ["boundary", "all", "two held, one of them inside"])
def test_gradient_is_that_of_differences(name, elasticity):
    partition = schur_determinant(MESH, *PARTITIONS[name][:2])
    theta = jnp.log(parameters(elasticity))

    def value(theta):
        return found(partition, *jnp.exp(theta))

    gradient = jax.jit(jax.grad(value))(theta)
    rng = np.random.default_rng(1)
    for direction in (*np.eye(2)[:, :, None] * rng.normal(size=theta.shape), rng.normal(size=theta.shape)):
        ahead, behind = (float(value(theta + h * direction)) for h in (1e-4, -1e-4))
        assert float((gradient * direction).sum()) == pytest.approx((ahead - behind) / 2e-4, rel=1e-6, abs=1e-7)


@pytest.mark.parametrize("elasticity", SIZES)
def test_gradient_is_the_trace(elasticity):
    """∂ log pdet S = tr(S⁺ Pᵀ ∂K P), P the elastic extension: a route without any factorisation of K."""
    sampled, held, _ = PARTITIONS["boundary"]
    lam, mu = parameters(elasticity)
    S, P = dense_schur(sampled, held, lam, mu)
    inverse = np.linalg.pinv(S, rcond=1e-10, hermitian=True)
    partition = schur_determinant(MESH, sampled, held)
    gradients = jax.grad(lambda lam, mu: found(partition, lam, mu), argnums=(0, 1))(jnp.asarray(lam), jnp.asarray(mu))
    for which in range(2):
        for entry in range(0, len(lam), max(len(lam) // 5, 1)):
            unit = np.zeros((2, len(lam)))
            unit[which, entry] = 1.0
            dK = paper.stiffness(MESH.points, MESH.cells, *(np.asarray(by_cell(values)) for values in unit))
            expected = np.trace(inverse @ P.T @ (dK @ P))
            assert float(gradients[which][entry]) == pytest.approx(expected, rel=1e-8)


def test_scaling_all_parameters_counts_the_rank():
    partition = schur_determinant(MESH, MESH.boundary, NOTHING)
    step = float(found(partition, 3 * LAM, 3 * MU) - found(partition, LAM, MU))
    assert step == pytest.approx((3 * len(MESH.boundary) - 6) * np.log(3), rel=1e-10)


def test_side_by_side_and_twice_differentiated():
    partition = schur_determinant(MESH, MESH.boundary, NOTHING)
    batch = np.stack([LAM, 2 * MU, PAPER_LAM])
    values = jax.vmap(lambda lam: found(partition, lam, jnp.asarray(MU)))(batch)
    np.testing.assert_allclose(values, [float(found(partition, lam, MU)) for lam in batch], rtol=1e-12)

    gradient = jax.jit(jax.grad(lambda lam: found(partition, lam, jnp.asarray(MU))))
    hessian = np.asarray(jax.jit(jax.jacfwd(gradient))(jnp.asarray(LAM)))
    differences = [(gradient(LAM + h) - gradient(LAM - h)) / 2e-4 for h in 1e-4 * np.eye(3)]
    np.testing.assert_allclose(hessian, np.stack(differences), rtol=1e-6, atol=1e-9)


def test_bands_on_the_host_are_equal_if_mesh_and_order_are():
    order = np.arange(3 * len(MESH.points))
    band = HostBand(MESH, order)
    assert band == HostBand(MESH, order)
    assert hash(band) == hash(HostBand(MESH, order))
    assert band != HostBand(MESH, order[::-1])
    assert band != HostBand(MESH.moved(0.1 * MESH.points), order)


def test_a_matrix_that_is_not_definite_is_not_a_number():
    band = jnp.zeros((2, 1 + BLOCKS_BELOW, 2, 2)).at[:, 0].set(jnp.stack([jnp.eye(2), -jnp.eye(2)]))
    assert np.isnan(band_log_determinant(band))
    assert band_log_determinant(abs(band)) == 0


def test_two_parts_that_share_one_edge_have_no_normaliser():
    """They may swing about it at no cost."""
    points = np.array([(0, 0, 0), (0, 0, 1), (1, 0, 0), (1, 1, 0), (-1, 0, 0), (-1, -1, 0)], float)
    cells = [(0, 2, 3, 1), (0, 4, 5, 1)]
    hinged = TetMesh.from_arrays(points, np.array(cells), np.zeros(2, int), ("gm",))
    with pytest.raises(ValueError, match="no normaliser on this mesh"):
        schur_determinant(hinged, np.arange(6), NOTHING)


def graph_of(*cells):
    """Nodes 0, 1, … as neighbours where they share a cell."""
    cells = np.array(cells)
    pairs = np.repeat(cells, cells.shape[1], axis=1).ravel(), np.tile(cells, cells.shape[1]).ravel()
    return scipy.sparse.csr_matrix((np.ones(len(pairs[0])), pairs))


def test_a_scrambled_chain_is_put_in_order():
    """Of a chain of tetrahedra, each of four nodes in a row, the narrowest band is three wide."""
    names = np.random.default_rng(0).permutation(40)
    graph = graph_of(*(names[i : i + 4] for i in range(37)))
    assert bandwidth(graph, order_by_neighbours(graph)) == 3


def test_two_parts_are_put_in_order_one_after_the_other():
    graph = graph_of((0, 2, 4, 6), (1, 3, 5, 7))
    order = order_by_neighbours(graph)
    assert sorted(order) == list(range(8))
    assert bandwidth(graph, order) == 3
