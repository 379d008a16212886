"""Smoothed aggregation (Vaněk, Mandel, Brezina 1996) as a preconditioner, for meshes too large for a dense inverse.

It approximates K_II⁻¹, where K_II is the stiffness of the free nodes. PyAMG makes the hierarchy of matrices once, on
the host. A V-cycle runs on the device; its columns are the chains. The matrices are made for *one* reference (λ, μ), so
they are the same for all chains.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float

from bayesreg.fem.operators import SparseOperator, sparse_operator, symmetric_operator
from bayesreg.fem.preconditioners import SINGULAR
from bayesreg.types import AnyArray, InputError, Scalar

# Coarsening ends at about this number of unknowns; the coarsest matrix is inverted as a dense matrix.
COARSEST_UNKNOWNS = 600
# The smoother is Chebyshev's polynomial of this degree. It damps the eigenvalues above this share of the greatest
# eigenvalue.
LEAST_SHARE = 0.1
DEGREE = 2
# Two nodes are strongly connected if their block of the matrix has at least this norm, relative to the geometric mean
# of the norms of their diagonal blocks. Only strong connections put nodes into one aggregate.
STRENGTH = 0.08
# K_II counts as singular if the least eigenvalue of the coarsest matrix, scaled to a unit diagonal, is at most this.
# The coarsest level represents rigid motions exactly up to rounding, so it shows whether K_II resists them.
SINGULAR_BELOW = 1e-13


class Level(NamedTuple):
    """One level of the hierarchy, in single precision (a pytree).

    Attributes
    ----------
    matrix : SparseOperator
        The (k, k) matrix, scaled to a unit diagonal.
    greatest : scalar
        An upper bound of the eigenvalues of the matrix.
    prolongation : SparseOperator
        The (k, l) map from the l unknowns of the next coarser level to the k unknowns of this level.
    """

    matrix: SparseOperator
    greatest: Scalar
    prolongation: SparseOperator


class Multigrid(NamedTuple):
    """A V-cycle for K_II at the reference parameters (a pytree).

    It is a symmetric positive definite operator, up to rounding in single precision.

    Attributes
    ----------
    scale : (3f,) array
        diag(K_II)^(−1/2) for the f free nodes, in double precision. It contains the contrast between tissues.
    levels : tuple of Level
        The levels, from fine to coarse, without the coarsest one.
    coarsest : (c, c) array
        The inverse of the coarsest matrix. It is in double precision, because it is far from the identity if the
        stiffnesses of tissues differ greatly.
    """

    scale: Float[AnyArray, "unknowns"]
    levels: tuple[Level, ...]
    coarsest: Float[AnyArray, "coarsest coarsest"]

    def __call__(self, residual: Float[AnyArray, "free 3 chains"]) -> Float[AnyArray, "free 3 chains"]:
        """Compute an approximation of K_II⁻¹ r by one V-cycle, where r is the residual."""
        scale = self.scale.reshape(-1, 3, 1)
        scaled = (scale * residual).astype(jnp.float32).reshape(len(self.scale), -1)
        return scale * _cycle(self.levels, self.coarsest, scaled).reshape(residual.shape)


def build_multigrid(matrix: scipy.sparse.csr_matrix, near_kernel: Float[np.ndarray, "unknowns modes"]) -> Multigrid:
    """Make the hierarchy of a symmetric positive definite matrix; the same matrix always gives the same hierarchy.

    Parameters
    ----------
    matrix : (3f, 3f) sparse matrix
        K_II at the reference parameters; the three unknowns of a node are adjacent.
    near_kernel : (3f, 6) array
        The six rigid motions of the f free nodes, as columns.

    Raises
    ------
    InputError
        If the matrix is singular or not finite.
    """
    # The import takes a second, and only large meshes need it.
    import pyamg

    diagonal = matrix.diagonal()
    if not (np.isfinite(matrix.data).all() and (diagonal > 0).all()):
        raise InputError(SINGULAR)
    scale = 1 / np.sqrt(diagonal)
    hierarchy = pyamg.smoothed_aggregation_solver(
        scipy.sparse.bsr_array(_scale(matrix, scale, scale), blocksize=(3, 3)),
        near_kernel / scale[:, None],
        strength=("symmetric", {"theta": STRENGTH}),
        # PyAMG's other weightings estimate the greatest eigenvalue with random numbers; this one does not.
        smooth=("jacobi", {"omega": 4 / 3, "weighting": "local"}),
        improve_candidates=None,
        # This limit counts blocks of unknowns. On coarse levels a block has the six motions of an aggregate.
        max_coarse=COARSEST_UNKNOWNS // 6,
        max_levels=20,
    ).levels
    # An aggregate of one or two nodes has fewer than six independent motions. The rows and columns of its other motions
    # are zero, and are removed.
    nonzero_rows = [np.flatnonzero(level.A.diagonal() > 1e-12) for level in hierarchy]
    inner = [
        scipy.sparse.csr_array(level.A)[rows][:, rows] for level, rows in zip(hierarchy, nonzero_rows, strict=True)
    ]
    scales = [1 / np.sqrt(each.diagonal()) for each in inner]
    matrices = [_scale(each, level_scale, level_scale) for each, level_scale in zip(inner, scales, strict=True)]
    values, vectors = np.linalg.eigh(matrices[-1].toarray())
    if not (np.isfinite(values).all() and values[0] > SINGULAR_BELOW):
        raise InputError(SINGULAR)
    levels = []
    for depth, fine in enumerate(matrices[:-1]):
        prolongation = scipy.sparse.csr_array(hierarchy[depth].P)[nonzero_rows[depth]][:, nonzero_rows[depth + 1]]
        prolongation = _scale(prolongation, 1 / scales[depth], scales[depth + 1])
        greatest = jnp.float32(_above_the_eigenvalues(fine))
        levels.append(
            Level(
                symmetric_operator(fine.astype(np.float32)), greatest, sparse_operator(prolongation.astype(np.float32))
            )
        )
    return Multigrid(jnp.asarray(scale), tuple(levels), jnp.asarray((vectors / values) @ vectors.T))


def _scale(
    matrix: scipy.sparse.sparray | scipy.sparse.spmatrix,
    rows: Float[np.ndarray, "rows"],
    columns: Float[np.ndarray, "columns"],
) -> scipy.sparse.csr_array:
    sparse_matrix = scipy.sparse.csr_array(matrix)
    return scipy.sparse.csr_array(scipy.sparse.diags_array(rows) @ sparse_matrix @ scipy.sparse.diags_array(columns))


def _above_the_eigenvalues(matrix: scipy.sparse.csr_array) -> float:
    """Compute an upper bound of the eigenvalues: 1.1 times Lanczos' estimate of the greatest eigenvalue.

    The factor is sufficient because the estimate is at most a few percent too low.
    """
    start = np.random.default_rng(0).normal(size=matrix.shape[0])
    return 1.1 * float(scipy.sparse.linalg.eigsh(matrix, 1, v0=start, tol=0.05, return_eigenvectors=False)[0])


def _cycle(
    levels: tuple[Level, ...],
    coarsest: Float[AnyArray, "coarsest coarsest"],
    load: Float[AnyArray, "unknowns chains"],
) -> Float[AnyArray, "unknowns chains"]:
    """Run one V-cycle that starts from zero.

    The same polynomial smooths before and after the correction by the coarser levels, so that the cycle is symmetric.
    """
    if not levels:
        return (coarsest @ load.astype(coarsest.dtype)).astype(load.dtype)
    level, *coarser = levels
    x = _smooth(level, jnp.zeros_like(load), load)
    residual = level.prolongation.transpose(load - level.matrix(x))
    x += level.prolongation(_cycle(tuple(coarser), coarsest, residual))
    return _smooth(level, x, load - level.matrix(x))


def _smooth(
    level: Level, x: Float[AnyArray, "unknowns chains"], residual: Float[AnyArray, "unknowns chains"]
) -> Float[AnyArray, "unknowns chains"]:
    """Apply `DEGREE` steps of Chebyshev's iteration (Saad 2003, algorithm 12.1) to x, given the residual of x."""
    centre, half = (level.greatest * (1 + way * LEAST_SHARE) / 2 for way in (1, -1))
    ratio = half / centre
    step = residual / centre
    x = x + step
    for _ in range(DEGREE - 1):
        residual = residual - level.matrix(step)
        before, ratio = ratio, 1 / (2 * centre / half - ratio)
        step = ratio * before * step + 2 * ratio / half * residual
        x = x + step
    return x
