"""The determinant of the elastic prior: log pdet S(λ, μ) of the boundary Schur complement, and its derivative.

With B the sampled nodes, I the free ones and S = K_BB − K_BI K_II⁻¹ K_IB, det K = det S · det K_II. What rigid
motions the held nodes leave span the null space N of S, whatever λ and μ are; without a set J of as many unknowns
that stops them, det S_{−J} = pdet S · det(N_J)² for an orthonormal N. Hence

    log pdet S = log det K_{−J} − log det K_II − 2 log |det N_J|.

Both determinants are those of sparse matrices. Their nodes, ordered by reverse Cuthill–McKee and cut into parts as
wide as the bandwidth, make them block tridiagonal, and a block Cholesky factorisation gives the determinant in
O(n w²) for n unknowns of bandwidth w. Its derivative, tr(K⁻¹ ∂K), needs the inverse inside the pattern of K alone.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Float, Int
from scipy.sparse.csgraph import reverse_cuthill_mckee

from bayesreg.fem.elasticity import element_stiffness, rigid_modes
from bayesreg.fem.elements import Elements, elements_of
from bayesreg.mesh import TetMesh
from bayesreg.types import AnyArray, InputError, Scalar

Blocks = Float[AnyArray, "blocks width width"]


class BlockLayout(NamedTuple):
    """Where the entries of K stand in a block tridiagonal order of some of its unknowns (a pytree).

    Attributes
    ----------
    places : (144, m) int array
        Flat index of every entry of every element's stiffness into an array (blocks, 2, width, width): first the
        diagonal block of a block row, then the one left of it. Entries that are not wanted lie past its end.
    padding : (blocks, width) array
        One where the last block row has no unknown, else zero.
    """

    places: Int[AnyArray, "entries cells"]
    padding: Float[AnyArray, "blocks width"]


class SchurDeterminant(NamedTuple):
    """What log pdet S needs besides λ and μ (a pytree).

    Attributes
    ----------
    supported : BlockLayout
        Of K_{−J}: all nodes that are not held, without the isostatic unknowns J.
    free : BlockLayout or None
        Of K_II; None where every node is sampled or held.
    log_null : scalar
        2 log |det N_J|.
    rank : scalar
        Of S: 3b less the rigid motions that the held nodes leave (six where none is held).
    """

    supported: BlockLayout
    free: BlockLayout | None
    log_null: Scalar
    rank: Scalar


def schur_determinant(
    mesh: TetMesh, sampled: Int[np.ndarray, "sampled"], held: Int[np.ndarray, "held"]
) -> SchurDeterminant:
    """Prepare log pdet S on a mesh whose nodes are sampled, held, or follow from these.

    Raises
    ------
    InputError
        If K has more null vectors than the rigid motions: parts of the mesh hang together by a node or an edge,
        or not at all.
    """
    null = rigid_freedom(mesh.points[sampled], mesh.points[held])
    isostatic = scipy.linalg.qr(null.T, pivoting=True, mode="r")[1][: null.shape[1]]
    prescribed = np.union1d(sampled, held)
    supported = _degrees(np.setdiff1d(np.arange(len(mesh.points)), held))
    supported = np.setdiff1d(supported, _degrees(sampled)[isostatic])
    free = _degrees(np.setdiff1d(np.arange(len(mesh.points)), prescribed))
    found = SchurDeterminant(
        supported=block_layout(mesh, supported),
        free=block_layout(mesh, free) if len(free) else None,
        log_null=jnp.asarray(2 * np.linalg.slogdet(null[isostatic])[1]),
        rank=jnp.asarray(float(3 * len(sampled) - null.shape[1])),
    )
    _require_definite(mesh, found)
    return found


def rigid_freedom(
    sampled: Float[np.ndarray, "sampled 3"], held: Float[np.ndarray, "held 3"]
) -> Float[np.ndarray, "rows freedom"]:
    """Orthonormal basis, on the sampled nodes, of the rigid motions that leave the held nodes where they are."""
    modes = rigid_modes(np.concatenate([sampled, held]))
    rows = 3 * len(sampled)
    resting = scipy.linalg.null_space(modes[rows:], rcond=1e-9) if len(held) else np.eye(6)
    return scipy.linalg.orth(modes[:rows] @ resting, rcond=1e-9)


def block_layout(mesh: TetMesh, unknowns: Int[np.ndarray, "unknowns"]) -> BlockLayout:
    """Order some unknowns (3 · node + axis) of K into blocks, each coupled to its neighbours alone."""
    rank = np.full(3 * len(mesh.points), -1)
    rank[_narrow_order(mesh, unknowns)] = np.arange(len(unknowns))
    degrees = rank[_degrees(mesh.cells).reshape(-1, 12)].T
    row, column = np.repeat(degrees, 12, axis=0), np.tile(degrees, (12, 1))
    kept = (row >= 0) & (column >= 0)
    width = max(int(np.abs(row - column)[kept].max()), 1)
    blocks = -(-len(unknowns) // width)
    block, left = row // width, row // width - column // width
    # The block right of the diagonal one is the transpose of the one left of the next: not kept.
    kept &= left >= 0
    places = ((2 * block + left) * width + row % width) * width + column % width
    padding = np.arange(blocks * width).reshape(blocks, width) >= len(unknowns)
    return BlockLayout(jnp.asarray(np.where(kept, places, 2 * blocks * width**2)), jnp.asarray(padding, float))


def _narrow_order(mesh: TetMesh, unknowns: Int[np.ndarray, "unknowns"]) -> Int[np.ndarray, "unknowns"]:
    """The unknowns node by node, the nodes by reverse Cuthill–McKee."""
    nodes, count = np.unique(unknowns // 3), len(mesh.points)
    pairs = np.repeat(mesh.cells, 4, axis=1).ravel(), np.tile(mesh.cells, (1, 4)).ravel()
    graph = scipy.sparse.csr_matrix((np.ones(len(pairs[0])), pairs), shape=(count, count))[nodes][:, nodes]
    ordered = _degrees(nodes[reverse_cuthill_mckee(graph, symmetric_mode=True)])
    return ordered[np.isin(ordered, unknowns)]


def _degrees(nodes: Int[np.ndarray, "*shape"]) -> Int[np.ndarray, "unknowns"]:
    return (3 * nodes[..., None] + np.arange(3)).ravel()


def _require_definite(mesh: TetMesh, determinant: SchurDeterminant) -> None:
    """A pivot that is nothing against the diagonal of K says that rigid motions are not all that costs nothing."""
    one = jnp.ones(len(mesh.cells))
    diagonal, lower = _assembled(elements_of(mesh), one, one, determinant.supported)
    factors, _ = _eliminated(diagonal, lower)
    pivots = jnp.diagonal(factors, axis1=1, axis2=2) ** 2 / jnp.diagonal(diagonal, axis1=1, axis2=2)
    if not (pivots > 1e-12).all():
        raise InputError(
            "the elastic prior has no normaliser on this mesh: parts of it hang together by a node or an edge, "
            "or not at all; mend the mesh, or use normalised: false"
        )


def log_pseudo_determinant(
    determinant: SchurDeterminant, elements: Elements, lam: Float[AnyArray, "cells"], mu: Float[AnyArray, "cells"]
) -> Scalar:
    """log pdet S, λ and μ given by cell; differentiable, NaN where K is not definite."""
    supported = log_determinant(determinant.supported, elements, lam, mu)
    free = 0.0 if determinant.free is None else log_determinant(determinant.free, elements, lam, mu)
    return supported - free - determinant.log_null


def log_determinant(
    layout: BlockLayout, elements: Elements, lam: Float[AnyArray, "cells"], mu: Float[AnyArray, "cells"]
) -> Scalar:
    """log det of the rows and columns of K(λ, μ) that are in a layout."""
    return block_tridiagonal_log_determinant(*_assembled(elements, lam, mu, layout))


def _assembled(elements: Elements, lam: AnyArray, mu: AnyArray, layout: BlockLayout) -> tuple[Blocks, Blocks]:
    """Diagonal blocks, and in each row the block left of it."""
    blocks, width = layout.padding.shape
    entries = element_stiffness(elements, lam, mu).reshape(layout.places.shape)
    matrix = jnp.zeros(2 * blocks * width**2).at[layout.places].add(entries, mode="drop")
    matrix = matrix.reshape(blocks, 2, width, width)
    return matrix[:, 0] + layout.padding[:, :, None] * jnp.eye(width), matrix[:, 1]


@jax.custom_jvp
def block_tridiagonal_log_determinant(diagonal: Blocks, lower: Blocks) -> Scalar:
    """log det of a symmetric positive definite block tridiagonal matrix.

    Parameters
    ----------
    diagonal : (blocks, width, width) array
        A_k, symmetric.
    lower : (blocks, width, width) array
        B_k in row k and column k − 1; the first is zero.
    """
    return _log_determinant_of(_eliminated(diagonal, lower)[0])


@block_tridiagonal_log_determinant.defjvp
def _derivative(primals: tuple[Blocks, Blocks], tangents: tuple[Blocks, Blocks]) -> tuple[Scalar, Scalar]:
    """∂ log det K = tr(K⁻¹ ∂K); the blocks outside the pattern of K meet zeros."""
    factors, eliminated = _eliminated(*primals)
    diagonal, lower = _selected_inverse(factors, eliminated)
    derivative = (diagonal * tangents[0]).sum() + 2 * (lower * tangents[1]).sum()
    return _log_determinant_of(factors), derivative


def _log_determinant_of(factors: Blocks) -> Scalar:
    return 2 * jnp.log(jnp.diagonal(factors, axis1=1, axis2=2)).sum()


def _eliminated(diagonal: Blocks, lower: Blocks) -> tuple[Blocks, Blocks]:
    """L_k L_kᵀ = D_k = A_k − B_k D_{k−1}⁻¹ B_kᵀ, and W_k = L_{k−1}⁻¹ B_kᵀ."""

    def eliminate(previous: AnyArray, row: tuple[AnyArray, AnyArray]) -> tuple[AnyArray, tuple[AnyArray, AnyArray]]:
        coupling = solve_triangular(previous, row[1].T, lower=True)
        factor = jax.lax.linalg.cholesky(row[0] - coupling.T @ coupling, symmetrize_input=False)
        return factor, (factor, coupling)

    return jax.lax.scan(eliminate, jnp.eye(diagonal.shape[1]), (diagonal, lower))[1]


def _selected_inverse(factors: Blocks, eliminated: Blocks) -> tuple[Blocks, Blocks]:
    """Blocks (k, k) and (k, k − 1) of K⁻¹, from the last row upwards.

    With G_k = D_k⁻¹ B_{k+1}ᵀ = L_k⁻ᵀ W_{k+1}: Σ_{k+1,k} = −Σ_{k+1,k+1} G_kᵀ and Σ_kk = D_k⁻¹ + G_k Σ_{k+1,k+1} G_kᵀ.
    """
    identity = jnp.eye(factors.shape[1])

    def ascend(below: AnyArray, row: tuple[AnyArray, AnyArray]) -> tuple[AnyArray, tuple[AnyArray, AnyArray]]:
        factor, coupling = row
        gain = solve_triangular(factor, coupling, lower=True, trans=1)
        left = -below @ gain.T
        here = cho_solve((factor, True), identity) - gain @ left
        return here, (here, left)

    following = jnp.roll(eliminated, -1, axis=0).at[-1].set(0.0)
    diagonal, lower = jax.lax.scan(ascend, jnp.zeros_like(identity), (factors, following), reverse=True)[1]
    return diagonal, jnp.roll(lower, 1, axis=0)
