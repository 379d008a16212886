"""The determinant of the elastic prior: log pdet S(λ, μ) of the boundary Schur complement, and its derivative.

With the sampled nodes B, the free nodes I and S = K_BB − K_BI K_II⁻¹ K_IB, det K = det S · det K_II. The rigid motions
that the held nodes allow span the null space N of S, whatever λ and μ are. Let J be a set of as many unknowns that
stops these motions when it is removed. Then det S_{−J} = pdet S · det(N_J)² for an orthonormal N, and

    log pdet S = log det K_{−J} − log det K_II − 2 log |det N_J|.

Both determinants are those of sparse matrices. With the nodes in the order of Cuthill and McKee, the matrices are
narrow bands. A Cholesky factorisation by blocks of columns gives the determinant in about n w² operations for n
unknowns of bandwidth w. On a CPU it is LAPACK's where no derivative is needed (`host_band`). The derivative,
tr(K⁻¹ ∂K), needs the inverse only inside the band: twice as many operations again.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Float, Int
from scipy.sparse.csgraph import breadth_first_order, reverse_cuthill_mckee

from bayesreg.fem.elasticity import element_stiffness, rigid_modes, unknowns_of
from bayesreg.fem.elements import Elements, elements_of
from bayesreg.fem.host_band import HostBand, band_entries
from bayesreg.mesh import TetMesh
from bayesreg.types import AnyArray, InputError, Scalar

Band = Float[AnyArray, "columns blocks width width"]

# The number of blocks below the diagonal block. With more blocks, a larger part of the work consists of products of
# matrices, but the matrices are smaller.
BLOCKS_BELOW = 6
# The number of nodes from which an order of the unknowns is tried.
STARTS = 200


class BandLayout(NamedTuple):
    """The layout of K as a narrow band, for some of its unknowns (a pytree).

    Attributes
    ----------
    on_host : HostBand
        The same band for LAPACK.
    places : (144, m) int array
        The flat index of every entry of every element's stiffness into an array (columns, 1 + below, width, width). A
        block column holds the diagonal block, then those below it. Unused entries have an index past the end.
    padding : (columns, width) array
        One for the columns past the last unknown, else zero.
    """

    on_host: HostBand
    places: Int[AnyArray, "entries cells"]
    padding: Float[AnyArray, "columns width"]


class SchurDeterminant(NamedTuple):
    """The arrays that log pdet S needs besides λ and μ (a pytree).

    Attributes
    ----------
    supported : BandLayout
        The pattern of K_{−J}: all nodes that are not held, without the isostatic unknowns J.
    free : BandLayout or None
        The pattern of K_II; None if every node is sampled or held.
    log_null : scalar
        2 log |det N_J|.
    rank : scalar
        The rank of S: 3b less the number of rigid motions that the held nodes allow (six if none is held).
    """

    supported: BandLayout
    free: BandLayout | None
    log_null: Scalar
    rank: Scalar

    def log_pseudo_determinant(
        self, elements: Elements, lam: Float[AnyArray, "cells"], mu: Float[AnyArray, "cells"]
    ) -> Scalar:
        """Compute log pdet S for λ and μ by cell; differentiable, and NaN if K is not positive definite."""
        supported = log_determinant(self.supported, elements, lam, mu)
        free = 0.0 if self.free is None else log_determinant(self.free, elements, lam, mu)
        return supported - free - self.log_null


def schur_determinant(
    mesh: TetMesh, sampled: Int[np.ndarray, "sampled"], held: Int[np.ndarray, "held"]
) -> SchurDeterminant:
    """Prepare log pdet S on a mesh whose nodes are sampled, held or free.

    Raises
    ------
    InputError
        If K has more null vectors than the rigid motions: parts of the mesh are connected only by a node or an edge,
        or not at all.
    """
    null = rigid_freedom(mesh.points[sampled], mesh.points[held])
    isostatic = scipy.linalg.qr(null.T, pivoting=True, mode="r")[1][: null.shape[1]]
    prescribed = np.union1d(sampled, held)
    supported = unknowns_of(np.setdiff1d(np.arange(len(mesh.points)), held))
    supported = np.setdiff1d(supported, unknowns_of(sampled)[isostatic])
    free = unknowns_of(np.setdiff1d(np.arange(len(mesh.points)), prescribed))
    determinant = SchurDeterminant(
        supported=band_layout(mesh, supported),
        free=band_layout(mesh, free) if len(free) else None,
        log_null=jnp.asarray(2 * np.linalg.slogdet(null[isostatic])[1]),
        rank=jnp.asarray(float(3 * len(sampled) - null.shape[1])),
    )
    _require_definite(mesh, determinant)
    return determinant


def rigid_freedom(
    sampled: Float[np.ndarray, "sampled 3"], held: Float[np.ndarray, "held 3"]
) -> Float[np.ndarray, "rows freedom"]:
    """Compute an orthonormal basis, on the sampled nodes, of the rigid motions that do not move the held nodes."""
    modes = rigid_modes(np.concatenate([sampled, held]))
    rows = 3 * len(sampled)
    resting = scipy.linalg.null_space(modes[rows:], rcond=1e-9) if len(held) else np.eye(6)
    return scipy.linalg.orth(modes[:rows] @ resting, rcond=1e-9)


def band_layout(mesh: TetMesh, unknowns: Int[np.ndarray, "unknowns"]) -> BandLayout:
    """Order some unknowns (3 · node + axis) of K into a narrow band, cut into block columns."""
    order = narrow_order(mesh, unknowns)
    row, column, is_stored = band_entries(mesh, order)
    width = -(-int(np.abs(row - column)[is_stored].max()) // BLOCKS_BELOW)
    columns, block, below = -(-len(unknowns) // width), column // width, row // width - column // width
    # Blocks above the diagonal are transposes of those below, so they are not stored.
    is_stored &= below >= 0
    places = ((block * (1 + BLOCKS_BELOW) + below) * width + row % width) * width + column % width
    padding = np.arange(columns * width).reshape(columns, width) >= len(unknowns)
    past_the_end = columns * (1 + BLOCKS_BELOW) * width**2
    places = jnp.asarray(np.where(is_stored, places, past_the_end))
    return BandLayout(HostBand(mesh, order), places, jnp.asarray(padding, float))


def narrow_order(mesh: TetMesh, unknowns: Int[np.ndarray, "unknowns"]) -> Int[np.ndarray, "unknowns"]:
    """Order the unknowns node by node, with the nodes in the order of Cuthill and McKee of the narrowest band."""
    nodes, count = np.unique(unknowns // 3), len(mesh.points)
    pairs = np.repeat(mesh.cells, 4, axis=1).ravel(), np.tile(mesh.cells, (1, 4)).ravel()
    graph = scipy.sparse.csr_matrix((np.ones(len(pairs[0])), pairs), shape=(count, count))[nodes][:, nodes]
    ordered = unknowns_of(nodes[order_by_neighbours(graph)])
    return ordered[np.isin(ordered, unknowns)]


def order_by_neighbours(graph: scipy.sparse.csr_matrix) -> Int[np.ndarray, "nodes"]:
    """Choose the order of the nodes with the least bandwidth among SciPy's and those that start at some nodes.

    SciPy's order also serves graphs of several parts. The order of Cuthill and McKee is a breadth-first search that
    visits the neighbours of a node by their number of neighbours, the fewest first.
    """
    count = graph.shape[0]
    by_degree = np.argsort(np.diff(graph.indptr), kind="stable")
    relabelled = graph[by_degree][:, by_degree].sorted_indices()
    starts = np.linspace(0, count - 1, min(count, STARTS)).round().astype(int)
    walks = (breadth_first_order(relabelled, start, return_predecessors=False) for start in starts)
    orders = [reverse_cuthill_mckee(graph, symmetric_mode=True)]
    orders += [by_degree[walk[::-1]] for walk in walks if len(walk) == count]
    return min(orders, key=lambda order: bandwidth(graph, order))


def bandwidth(graph: scipy.sparse.csr_matrix, order: Int[np.ndarray, "nodes"]) -> int:
    """Compute the greatest distance between two neighbours in an order of the nodes."""
    rank = np.argsort(order)
    row, column = graph.nonzero()
    return int(np.abs(rank[row] - rank[column]).max())


def _require_definite(mesh: TetMesh, determinant: SchurDeterminant) -> None:
    """Raise InputError if a pivot is zero compared with the diagonal of K: K then has other null vectors than N."""
    ones = jnp.ones(len(mesh.cells))
    band = _assemble(elements_of(mesh), ones, ones, determinant.supported)
    pivots = jnp.diagonal(_factorise(band)[0], axis1=1, axis2=2) ** 2 / jnp.diagonal(band[:, 0], axis1=1, axis2=2)
    if not (pivots > 1e-12).all():
        raise InputError(
            "the elastic prior has no normaliser on this mesh: parts of it hang together by a node or an edge, "
            "or not at all; mend the mesh, or use normalised: false"
        )


@jax.custom_jvp
def log_determinant(
    layout: BandLayout, elements: Elements, lam: Float[AnyArray, "cells"], mu: Float[AnyArray, "cells"]
) -> Scalar:
    """Compute log det of the rows and columns of K(λ, μ) that are in a layout; differentiable in λ and μ."""
    on_device = partial(_log_determinant_on_device, layout, elements)
    return jax.lax.platform_dependent(lam, mu, cpu=layout.on_host.log_determinant, default=on_device)


@log_determinant.defjvp
def _log_determinant_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Scalar, Scalar]:
    layout, elements, *moduli = primals
    return jax.jvp(partial(_log_determinant_on_device, layout, elements), moduli, list(tangents[2:]))


def _log_determinant_on_device(layout: BandLayout, elements: Elements, lam: AnyArray, mu: AnyArray) -> Scalar:
    return band_log_determinant(_assemble(elements, lam, mu, layout))


def _assemble(elements: Elements, lam: AnyArray, mu: AnyArray, layout: BandLayout) -> Band:
    columns, width = layout.padding.shape
    entries = element_stiffness(elements, lam, mu).reshape(layout.places.shape)
    band = jnp.zeros(columns * (1 + BLOCKS_BELOW) * width**2).at[layout.places].add(entries, mode="drop")
    band = band.reshape(columns, 1 + BLOCKS_BELOW, width, width)
    return band.at[:, 0].add(layout.padding[:, :, None] * jnp.eye(width))


@jax.custom_jvp
def band_log_determinant(band: Band) -> Scalar:
    """Compute log det of a symmetric positive definite band matrix.

    Parameters
    ----------
    band : (columns, 1 + below, width, width) array
        The block columns: the symmetric diagonal block, then those below it; zero past the last row.
    """
    return _log_determinant_of(_factorise(band)[0])


@band_log_determinant.defjvp
def _derivative(primals: tuple[Band], tangents: tuple[Band]) -> tuple[Scalar, Scalar]:
    """Compute ∂ log det K = tr(K⁻¹ ∂K): ∂K is zero outside the band, and the blocks below the diagonal count twice."""
    factors, panels = _factorise(primals[0])
    products = _inverse_in_band(factors, panels).reshape(tangents[0].shape) * tangents[0]
    return _log_determinant_of(factors), 2 * products.sum() - products[:, 0].sum()


def _log_determinant_of(factors: Float[AnyArray, "columns width width"]) -> Scalar:
    return 2 * jnp.log(jnp.diagonal(factors, axis1=1, axis2=2)).sum()


def _factorise(
    band: Band,
) -> tuple[Float[AnyArray, "columns width width"], Float[AnyArray, "columns height width"]]:
    """Compute the Cholesky factor: its diagonal blocks L_kk, and the panels P_k below them.

    Every block column is updated by the `BLOCKS_BELOW` columns before it; columns of zeros precede the first one.
    """
    columns, _, width, _ = band.shape

    def eliminate(k: AnyArray, factored: AnyArray) -> AnyArray:
        column = band[k]
        for offset in range(1, 1 + BLOCKS_BELOW):
            before = factored[k + BLOCKS_BELOW - offset, offset:]
            product = before.reshape(-1, width) @ before[0].T
            column = column.at[: 1 + BLOCKS_BELOW - offset].add(-product.reshape(before.shape))
        factor = jax.lax.linalg.cholesky(column[0], symmetrize_input=False)
        panel = solve_triangular(factor, column[1:].reshape(-1, width).T, lower=True).T
        return factored.at[k + BLOCKS_BELOW].set(jnp.concatenate([factor, panel]).reshape(column.shape))

    nothing = jnp.zeros((BLOCKS_BELOW + columns, *band.shape[1:]), band.dtype)
    cholesky_factor = jax.lax.fori_loop(0, columns, eliminate, nothing)[BLOCKS_BELOW:]
    return cholesky_factor[:, 0], cholesky_factor[:, 1:].reshape(columns, -1, width)


def _inverse_in_band(
    factors: Float[AnyArray, "columns width width"], panels: Float[AnyArray, "columns height width"]
) -> Float[AnyArray, "columns rows width"]:
    """Compute the entries of Σ = K⁻¹ inside the band of K, from the last block column to the first.

    This is Takahashi's recursion. With the rows J of the panel and Y = P_k L_kk⁻¹, Σ_Jk = −Σ_JJ Y and
    Σ_kk = L_kk⁻ᵀ L_kk⁻¹ − Yᵀ Σ_Jk. The variable `window` holds Σ_JJ.
    """
    height, width = panels.shape[1:]

    def ascend(window: AnyArray, column: tuple[AnyArray, AnyArray]) -> tuple[AnyArray, AnyArray]:
        factor, panel = column
        gain = solve_triangular(factor, panel.T, lower=True, trans=1)
        below = -window @ gain.T
        diagonal = cho_solve((factor, True), jnp.eye(width)) - gain @ below
        remaining = below[:-width]
        window = jnp.block([[diagonal, remaining.T], [remaining, window[:-width, :-width]]])
        return window, jnp.concatenate([diagonal, below])

    return jax.lax.scan(ascend, jnp.zeros((height, height)), (factors, panels), reverse=True)[1]
