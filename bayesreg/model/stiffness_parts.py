"""The stiffness as a sum of fixed matrices, K = Σ_s φ_s K_s, where φ holds λ and μ.

The evidence of hyperparameters θ needs derivatives of tr(C R(θ)) for a fixed covariance C and the curvature R of the
terms that are quadratic in the displacements. For random loads this is K D⁻¹ K, and

tr(C K D⁻¹ K) = Σ_i D_ii⁻¹ Σ_st φ_s φ_t k_siᵀ C k_ti,

with the rows k_si of K_s. These rows are sparse, so that the forms k_siᵀ C k_ti of all rows cost much less than one
product K D⁻¹ K. Each further θ then costs next to nothing.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float

from bayesreg.fem.elasticity import stiffness
from bayesreg.model.blocks import LAME, Values
from bayesreg.model.state import Body, StaticMesh

# With more entries of λ or μ (as with one for each element), K is not divided into parts, and λ and μ are no
# hyperparameters.
MOST_ENTRIES = 50


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
        """Compute the traces tr(C K_s) of all parts."""
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


def has_few_entries(body: Body) -> bool:
    """Check whether K has one part for each λ and each μ."""
    return int(np.asarray(body.cell_entry).max()) < MOST_ENTRIES


def coefficients(body: Body, values: Values) -> Float[np.ndarray, "parts"]:
    """Return the factors φ of the matrices K_s whose sum is K."""
    return np.concatenate([np.asarray(values[name]) for name in LAME]) if has_few_entries(body) else np.ones(1)


def stiffness_of(body: Body, values: Values) -> scipy.sparse.csr_matrix:
    """Return K, assembled from fixed matrices if λ and μ have few entries."""
    if body.field is not None or not has_few_entries(body):
        return stiffness(body.mesh.mesh, *(np.asarray(by_cell) for by_cell in body.lame_by_cell(values)))
    parts = stiffness_parts(body, values)
    K = parts.pattern.copy()
    K.data = parts.entries @ coefficients(body, values)
    return K


def stiffness_parts(body: Body, values: Values) -> StiffnessParts:
    """Return the fixed matrices whose sum is K: one for each λ and each μ, or K itself if these have many entries."""
    if not has_few_entries(body):
        K = stiffness_of(body, values)
        return StiffnessParts(K, K.data[:, None])
    factors = None if body.field is None else tuple(np.asarray(body.stiffness_factor(values)).tolist())
    return _kept_parts(body.mesh, tuple(np.asarray(body.cell_entry).tolist()), factors)


@lru_cache(maxsize=2)
def _kept_parts(mesh: StaticMesh, entries: tuple[int, ...], factors: tuple[float, ...] | None) -> StiffnessParts:
    """Compute the derivatives of K in each λ and each μ; `factors` multiply the λ and μ of each cell."""
    factor = np.ones(len(entries)) if factors is None else np.array(factors)
    owned = [np.equal(entries, entry) * factor for entry in range(max(entries) + 1)]
    nothing = np.zeros(len(entries))
    # Zeros are stored, so that all derivatives have the same pattern.
    derivatives = [stiffness(mesh.mesh, indicator, nothing) for indicator in owned] + [
        stiffness(mesh.mesh, nothing, indicator) for indicator in owned
    ]
    for derivative in derivatives:
        derivative.sort_indices()
    return StiffnessParts(derivatives[0], np.stack([derivative.data for derivative in derivatives], axis=1))
