"""Traces tr(C R(θ)) of a fixed covariance C and the curvature R of the terms that are quadratic in the displacements.

The evidence of hyperparameters θ needs their first and second derivatives. With K = Σ_s φ_s K_s, where φ holds λ and μ
and K_s are fixed matrices, the curvature of random loads is K D⁻¹ K, and

tr(C K D⁻¹ K) = Σ_i D_ii⁻¹ Σ_st φ_s φ_t k_siᵀ C k_ti,

with the rows k_si of K_s. These rows are sparse, so that the forms k_siᵀ C k_ti of all rows cost much less than one
product K D⁻¹ K. Each further θ then costs next to nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float

from bayesreg.model.term import PointCurvature


class StiffnessParts(NamedTuple):
    """Fixed matrices K_s with the same pattern; K = Σ_s φ_s K_s.

    Attributes
    ----------
    pattern : (3n, 3n) sparse matrix
        A matrix with this pattern. The three rows of a node have the same columns, in increasing order.
    entries : (entries, parts) array
        The entries of every K_s.
    """

    pattern: scipy.sparse.csr_matrix
    entries: Float[np.ndarray, "entries parts"]

    def linear_form(self, covariance: Float[np.ndarray, "unknowns unknowns"]) -> Float[np.ndarray, "parts"]:
        """Compute tr(C K_s)."""
        rows = np.repeat(np.arange(self.pattern.shape[0]), np.diff(self.pattern.indptr))
        return covariance[rows, self.pattern.indices] @ self.entries

    def quadratic_forms(
        self, covariance: Float[np.ndarray, "unknowns unknowns"]
    ) -> Float[np.ndarray, "nodes parts parts"]:
        """Compute Σ_i k_siᵀ C k_ti over the three rows i of each node."""
        starts, columns, parts = self.pattern.indptr, self.pattern.indices, self.entries.shape[1]
        forms = np.empty((self.pattern.shape[0] // 3, parts, parts))
        for node in range(len(forms)):
            first, after_row, end = starts[3 * node], starts[3 * node + 1], starts[3 * node + 3]
            near = columns[first:after_row]
            rows = self.entries[first:end].reshape(3, len(near), parts).swapaxes(0, 1).reshape(len(near), -1)
            products = covariance[np.ix_(near, near)] @ rows
            forms[node] = rows.reshape(-1, parts).T @ products.reshape(-1, parts)
        return forms


def covariance_at_points(
    points: PointCurvature, covariance: Float[np.ndarray, "unknowns unknowns"]
) -> Float[np.ndarray, "points 3 3"]:
    """Compute the covariance of the displacement of each point from the covariance of all nodes."""
    corners = 3 * np.asarray(points.nodes)[..., None] + np.arange(3)
    between_corners = covariance[corners[:, :, :, None, None], corners[:, None, None]]
    weights = np.asarray(points.weights)
    return np.einsum("qa,qaibj,qb->qij", weights, between_corners, weights, optimize=True)
