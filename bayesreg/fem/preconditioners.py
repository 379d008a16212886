"""Preconditioners of the interior system, built once on the host.

A factor of K_II at *one* reference (λ, μ) serves all others: K is affine in the parameters, so the
preconditioned spectrum lies between the least and the greatest ratio of a parameter to its reference.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse
from jaxtyping import Float

from bayesreg.types import AnyArray

# Beyond this the dense inverse (8 bytes × square) no longer fits the caches nor, soon, the memory.
DENSE_LIMIT = 5000

Preconditioner = Float[AnyArray, "unknowns unknowns"] | None


def reference_inverse(matrix: scipy.sparse.csr_matrix) -> Preconditioner:
    """Dense inverse of the interior stiffness at the reference parameters.

    Parameters
    ----------
    matrix : (k, k) sparse matrix
        Symmetric positive definite.

    Returns
    -------
    (k, k) array or None
        None where k exceeds `DENSE_LIMIT`: the solve is then preconditioned by the diagonal alone.

    Raises
    ------
    ValueError
        If the matrix is not positive definite: the sampled nodes do not hold the mesh.
    """
    if matrix.shape[0] > DENSE_LIMIT:
        return None
    # Scaled to a unit diagonal first: the contrast between tissues spans many orders of magnitude.
    scale = 1 / np.sqrt(matrix.diagonal())
    scaled = matrix.toarray() * scale[:, None] * scale
    try:
        factor = scipy.linalg.cho_factor(scaled, lower=True)
    except scipy.linalg.LinAlgError as error:
        raise ValueError("the interior stiffness is singular: sample at least three non-collinear nodes") from error
    inverse = scipy.linalg.cho_solve(factor, np.eye(len(scaled)))
    return jnp.asarray((inverse + inverse.T) / 2 * scale[:, None] * scale)
