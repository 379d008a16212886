"""Smoothed aggregation (Vaněk, Mandel, Brezina 1996) as a preconditioner, for meshes beyond a dense inverse.

PyAMG makes the hierarchy once, on the host; a V-cycle runs on the device, with the chains as columns. The matrices are
those of *one* reference (λ, μ) and so the same for all chains.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax.experimental.sparse import BCSR
from jaxtyping import Float

from bayesreg.fem.operators import SparseOperator, product, sparse_operator
from bayesreg.fem.preconditioners import SINGULAR
from bayesreg.types import AnyArray, InputError, Scalar

# The coarsest matrix has a dense inverse.
COARSEST = 600
# Chebyshev's polynomials damp the eigenvalues above this share of the greatest.
LEAST_SHARE = 0.1
DEGREE = 2
# Below this a connection of two nodes does not bind them into one aggregate.
STRENGTH = 0.08
# The least eigenvalue of the coarsest matrix, of unit diagonal: rigid motions are in it to rounding.
SINGULAR_BELOW = 1e-10


class Level(NamedTuple):
    """One level of the hierarchy, its matrix scaled to a unit diagonal (a pytree).

    Attributes
    ----------
    matrix : BCSR
        (k, k), single precision.
    greatest : scalar
        A bound of its eigenvalues.
    prolongation : SparseOperator
        (k, next k).
    """

    matrix: BCSR
    greatest: Scalar
    prolongation: SparseOperator


class Multigrid(NamedTuple):
    """A V-cycle for K_II at the reference parameters (a pytree): symmetric, positive definite, single precision.

    Attributes
    ----------
    scale : (3f,) array
        diag(K_II)^(−1/2): the contrast between tissues, in double precision.
    levels : tuple of Level
        From fine to coarse.
    coarsest : (c, c) array
        Inverse of the last matrix.
    """

    scale: Float[AnyArray, "unknowns"]
    levels: tuple[Level, ...]
    coarsest: Float[AnyArray, "coarsest coarsest"]

    def __call__(self, residual: Float[AnyArray, "free 3 chains"]) -> Float[AnyArray, "free 3 chains"]:
        """K_II⁻¹ r, approximately."""
        scale = self.scale.reshape(-1, 3, 1)
        scaled = (scale * residual).astype(self.coarsest.dtype).reshape(len(self.scale), -1)
        return scale * _cycle(self.levels, self.coarsest, scaled).reshape(residual.shape)


def multigrid(matrix: scipy.sparse.csr_matrix, near_kernel: Float[np.ndarray, "unknowns modes"]) -> Multigrid:
    """The hierarchy of a symmetric positive definite matrix.

    Parameters
    ----------
    matrix : (3f, 3f) sparse matrix
        K_II at the reference parameters, axes fastest.
    near_kernel : (3f, 6) array
        The rigid motions of the free nodes.

    Raises
    ------
    InputError
        If the matrix is singular or not finite.
    """
    if not np.isfinite(matrix.data).all():
        raise InputError(SINGULAR)
    # A second to import, and of use to large meshes only.
    import pyamg

    scale = 1 / np.sqrt(matrix.diagonal())
    scaled = scipy.sparse.bsr_array(_scaled(matrix, scale, scale), blocksize=(3, 3))
    hierarchy = pyamg.smoothed_aggregation_solver(
        scaled,
        near_kernel / scale[:, None],
        strength=("symmetric", {"theta": STRENGTH}),
        improve_candidates=None,
        # Counted in blocks; on coarse levels one for each of the six motions of an aggregate.
        max_coarse=COARSEST // 6,
        max_levels=20,
    ).levels
    scales = [1 / np.sqrt(level.A.diagonal()) for level in hierarchy]
    matrices = [_scaled(level.A, own, own) for level, own in zip(hierarchy, scales, strict=True)]
    levels = [
        Level(
            sparse_operator(fine.astype(np.float32)).matrix,
            jnp.float32(_greatest_eigenvalue(fine)),
            sparse_operator(_scaled(level.P, 1 / own, coarse).astype(np.float32)),
        )
        for fine, level, own, coarse in zip(matrices[:-1], hierarchy[:-1], scales[:-1], scales[1:], strict=True)
    ]
    values, vectors = np.linalg.eigh(matrices[-1].toarray())
    if not values[0] > SINGULAR_BELOW:
        raise InputError(SINGULAR)
    return Multigrid(jnp.asarray(scale), tuple(levels), jnp.asarray((vectors / values) @ vectors.T, jnp.float32))


def _scaled(
    matrix: scipy.sparse.sparray | scipy.sparse.spmatrix,
    rows: Float[np.ndarray, "rows"],
    columns: Float[np.ndarray, "columns"],
) -> scipy.sparse.csr_array:
    found = scipy.sparse.csr_array(matrix)
    return scipy.sparse.csr_array(scipy.sparse.diags_array(rows) @ found @ scipy.sparse.diags_array(columns))


def _greatest_eigenvalue(matrix: scipy.sparse.csr_array) -> float:
    """A bound from above that is a tenth too great at most: of Lanczos' tenth estimate, which is near from below."""
    start = np.random.default_rng(0).normal(size=matrix.shape[0])
    return 1.1 * float(scipy.sparse.linalg.eigsh(matrix, 1, v0=start, tol=0.05, return_eigenvectors=False)[0])


def _cycle(
    levels: tuple[Level, ...],
    coarsest: Float[AnyArray, "coarsest coarsest"],
    load: Float[AnyArray, "unknowns chains"],
) -> Float[AnyArray, "unknowns chains"]:
    """One V-cycle from zero, smoothed before and after by the same polynomial, so that it is symmetric."""
    if not levels:
        return coarsest @ load
    level, *coarser = levels
    x = _smoothed(level, jnp.zeros_like(load), load)
    residual = product(level.prolongation.transposed, load - product(level.matrix, x))
    x += product(level.prolongation.matrix, _cycle(tuple(coarser), coarsest, residual))
    return _smoothed(level, x, load - product(level.matrix, x))


def _smoothed(
    level: Level, x: Float[AnyArray, "unknowns chains"], residual: Float[AnyArray, "unknowns chains"]
) -> Float[AnyArray, "unknowns chains"]:
    """x after `DEGREE` steps of Chebyshev's iteration (Saad 2003, algorithm 12.1), given its residual."""
    centre, half = (level.greatest * (1 + way * LEAST_SHARE) / 2 for way in (1, -1))
    ratio = half / centre
    step = residual / centre
    x = x + step
    for _ in range(DEGREE - 1):
        residual = residual - product(level.matrix, step)
        before, ratio = ratio, 1 / (2 * centre / half - ratio)
        step = ratio * before * step + 2 * ratio / half * residual
        x = x + step
    return x
