"""log det K(λ, μ) by LAPACK's Cholesky factorisation of a band, on the host.

XLA has no band factorisation. One that is built from its operations copies and transposes more than it computes: for
four chains of 866 nodes it takes three times as long as LAPACK. JAX does not keep programs with calls of the host in
its persistent cache.
"""

from __future__ import annotations

import hashlib

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy.linalg.lapack import dpbtrf

from bayesreg.fem.elasticity import element_stiffness, unknowns_of
from bayesreg.fem.elements import elements_of
from bayesreg.mesh import TetMesh
from bayesreg.types import AnyArray, Scalar


def band_entries(
    mesh: TetMesh, order: Int[np.ndarray, "unknowns"]
) -> tuple[Int[np.ndarray, "entries cells"], Int[np.ndarray, "entries cells"], Bool[np.ndarray, "entries cells"]]:
    """Find the row and the column of every entry of every element's stiffness, in an order of some unknowns.

    Returns
    -------
    rows, columns : (144, m) int arrays
        −1 for an unknown that is left out.
    are_stored : (144, m) bool array
        Whether both unknowns are in the order.
    """
    rank = np.full(3 * len(mesh.points), -1)
    rank[order] = np.arange(len(order))
    degrees = rank[unknowns_of(mesh.cells).reshape(-1, 12)].T
    rows, columns = np.repeat(degrees, 12, axis=0), np.tile(degrees, (12, 1))
    return rows, columns, (rows >= 0) & (columns >= 0)


@jax.tree_util.register_static
class HostBand:
    """The map from λ and μ to a band of K, in the order of some of its unknowns.

    Two are equal if they belong to the same mesh and order. They are constants of a compiled program, not arguments.

    Parameters
    ----------
    mesh : TetMesh
    order : (unknowns,) int array
        The unknowns (3 · node + axis) in the order of the rows of the band.
    """

    def __init__(self, mesh: TetMesh, order: Int[np.ndarray, "unknowns"]) -> None:
        self._digest = hashlib.sha256(mesh.digest.encode() + order.astype("<i8").tobytes()).hexdigest()
        rows, columns, are_stored = band_entries(mesh, order)
        are_stored &= rows >= columns
        self._shape = 1 + int((rows - columns)[are_stored].max()), len(order)
        # LAPACK stores column j of the lower triangle from its diagonal on; the columns follow each other.
        places, cells = (columns * self._shape[0] + rows - columns)[are_stored], np.nonzero(are_stored)[1]
        self._entries, index = np.unique(places, return_inverse=True)
        ones, elements = jnp.ones(len(mesh.cells)), elements_of(mesh)
        moduli = (ones, 0 * ones), (0 * ones, ones)
        stiffness = [np.asarray(element_stiffness(elements, *each)).reshape(are_stored.shape) for each in moduli]
        # The entries of the band are this matrix times λ and μ of all cells.
        self._stiffness = scipy.sparse.csr_array(
            (
                np.concatenate([each[are_stored] for each in stiffness]),
                (np.tile(index, 2), np.concatenate([cells, cells + len(mesh.cells)])),
            ),
            shape=(len(self._entries), 2 * len(mesh.cells)),
        )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, HostBand) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)

    def log_determinant(self, lam: Float[AnyArray, "cells"], mu: Float[AnyArray, "cells"]) -> Scalar:
        """Compute log det K as part of a JAX program, without a derivative; NaN if K is not positive definite."""
        result, moduli = jax.ShapeDtypeStruct((), float), jnp.concatenate([lam, mu])
        return jax.pure_callback(self._log_determinants, result, moduli, vmap_method="broadcast_all")

    def _log_determinants(self, moduli: AnyArray) -> Float[np.ndarray, "*chains"]:
        moduli = np.asarray(moduli)
        chains = moduli.reshape(-1, moduli.shape[-1])
        return np.array([self._log_determinant(chain) for chain in chains]).reshape(moduli.shape[:-1])

    def _log_determinant(self, moduli: Float[np.ndarray, "moduli"]) -> float:
        band = np.zeros(self._shape, order="F")
        band.ravel(order="K")[self._entries] = self._stiffness @ moduli
        factor, failure = dpbtrf(band, lower=1, overwrite_ab=1)
        return 2 * np.log(factor[0]).sum() if failure == 0 else np.nan
