"""Factors of the interior stiffness on the host, and the dense preconditioner made of them.

A factor of K_II at *one* reference (λ, μ) serves all other parameters. K is affine in the parameters, so the
preconditioned spectrum lies between the least and the greatest ratio of a parameter to its reference.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float

from bayesreg.types import AnyArray, InputError

# With the dense inverse a solve is faster than with multigrid for up to about 10,000 unknowns, measured with 4 and 16
# chains. The limit is lower because the time to make the inverse, three times in a run, grows with the cube of the
# unknowns (docs/speed.md).
DENSE_LIMIT = 6000

SINGULAR = (
    "the interior stiffness is singular: sample or hold at least three non-collinear nodes, and keep λ and μ from "
    "extremes by narrower priors"
)


class ReferenceInverse(NamedTuple):
    """K_II⁻¹ at the reference parameters, scaled to a unit diagonal of K_II (a pytree).

    The scale contains the contrast between tissues, in double precision. The inverse is in single precision, which
    halves the memory traffic that limits the speed of a solve. This costs no accuracy: a preconditioner changes the
    number of iterations, not their limit.

    Attributes
    ----------
    scale : (3f,) array
        diag(K_II)^(−1/2).
    inverse : (3f, 3f) array, single precision
        The inverse of K_II, scaled from both sides.
    """

    scale: Float[AnyArray, "unknowns"]
    inverse: Float[AnyArray, "unknowns unknowns"]

    def __call__(self, residual: Float[AnyArray, "free 3 chains"]) -> Float[AnyArray, "free 3 chains"]:
        """Compute an approximation of K_II⁻¹ r, with the reference parameters."""
        scale = self.scale.reshape(-1, 3, 1)
        scaled = (scale * residual).astype(self.inverse.dtype).reshape(len(self.inverse), -1)
        return scale * (self.inverse @ scaled).reshape(residual.shape)


def reference_inverse(matrix: scipy.sparse.csr_matrix) -> ReferenceInverse:
    """Compute the dense inverse of the interior stiffness at the reference parameters.

    It is meant for at most `DENSE_LIMIT` unknowns.

    Parameters
    ----------
    matrix : (k, k) sparse matrix
        Symmetric positive definite.

    Returns
    -------
    ReferenceInverse

    Raises
    ------
    InputError
        If the matrix is not positive definite, because the prescribed nodes do not fix the mesh.
    """
    scaled_factor = _scaled_factor(matrix)
    if scaled_factor is None:
        raise InputError(SINGULAR)
    scale, factor = scaled_factor
    inverse = scipy.linalg.cho_solve(factor, np.eye(len(scale)))
    return ReferenceInverse(jnp.asarray(scale), jnp.asarray((inverse + inverse.T) / 2, jnp.float32))


def solve(
    matrix: scipy.sparse.csr_matrix, right: Float[np.ndarray, "unknowns columns"]
) -> Float[np.ndarray, "unknowns columns"]:
    """Multiply many columns by K_II⁻¹, to double precision.

    Up to `DENSE_LIMIT` unknowns the function uses a dense factor, whose solves are fast products of matrices. Beyond
    the limit, or if contrasts of stiffness leave no Cholesky factor, it uses a sparse factor.

    Raises
    ------
    InputError
        If the matrix is singular or not finite.
    """
    scaled_factor = _scaled_factor(matrix) if matrix.shape[0] <= DENSE_LIMIT else None
    if scaled_factor is not None:
        scale, factor = scaled_factor
        return scale[:, None] * scipy.linalg.cho_solve(factor, scale[:, None] * right)
    try:
        return scipy.sparse.linalg.splu(matrix.tocsc()).solve(right)
    except RuntimeError as error:
        raise InputError(SINGULAR) from error


def _scaled_factor(
    matrix: scipy.sparse.csr_matrix,
) -> tuple[Float[np.ndarray, "unknowns"], tuple[Float[np.ndarray, "unknowns unknowns"], bool]] | None:
    """Compute diag(K)^(−1/2), and the Cholesky factor of K scaled by it from both sides, for `scipy.linalg.cho_solve`.

    The result is None if K is not positive definite in double precision.
    """
    if not np.isfinite(matrix.data).all():
        raise InputError(SINGULAR)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / np.sqrt(matrix.diagonal())
        scaled = scipy.sparse.diags(scale) @ matrix @ scipy.sparse.diags(scale)
    try:
        return scale, scipy.linalg.cho_factor(scaled.toarray(), lower=True, overwrite_a=True, check_finite=False)
    except scipy.linalg.LinAlgError:
        return None
