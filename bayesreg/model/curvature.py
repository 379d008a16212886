"""Gauss–Newton curvature of the posterior in the displacements, assembled on the host."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float

from bayesreg.fem.elasticity import stiffness
from bayesreg.mesh import TetMesh
from bayesreg.model.program import RegistrationData
from bayesreg.model.warp import displacement_at
from bayesreg.types import AnyArray


def displacement_precision(
    mesh: TetMesh,
    data: RegistrationData,
    lam: Float[AnyArray, "cells"],
    mu: Float[AnyArray, "cells"],
    u: Float[AnyArray, "nodes 3"],
) -> Float[np.ndarray, "rows rows"]:
    """Curvature of E_s/T_s + E_r/T_r in the displacements of the sampled nodes, at fixed λ, μ (by cell).

    With u_I = W u_B of eq. (7), W = −K_II⁻¹ K_IB, the elastic energy has the Hessian K_BB + K_BI W, and the sum of
    squared residuals r the Gauss–Newton approximation 2 Jᵀ J of its own, J = ∂r/∂u [1; W].

    Returns
    -------
    (3b, 3b) array
        1/mm², row 3 · node + axis; positive semidefinite.
    """
    sampled = _degrees(np.asarray(data.system.prescribed)[np.asarray(data.slots)])
    free = _degrees(np.asarray(data.system.free))
    K = stiffness(mesh, lam, mu)
    normal = _normal_matrix(mesh, data, u)
    coupling = K[free][:, sampled]
    if len(free) == 0:
        return (K[sampled][:, sampled] / float(data.t_elastic) + normal[sampled][:, sampled]).toarray()
    W = -scipy.sparse.linalg.splu(K[free][:, free].tocsc()).solve(coupling.toarray())
    schur = K[sampled][:, sampled] + coupling.T @ W
    cross = normal[sampled][:, free] @ W
    similarity = normal[sampled][:, sampled] + cross + cross.T + W.T @ (normal[free][:, free] @ W)
    precision = np.asarray(schur / float(data.t_elastic) + similarity)
    return (precision + precision.T) / 2


def _degrees(nodes: np.ndarray) -> np.ndarray:
    return (3 * nodes[:, None] + np.arange(3)).ravel()


def _normal_matrix(mesh: TetMesh, data: RegistrationData, u: Float[AnyArray, "nodes 3"]) -> scipy.sparse.csr_matrix:
    """2/T_s Σ_q w_q ∇m ∇mᵀ N_a N_b at x_q + u(x_q): the curvature of E_s/T_s in all nodes."""
    gradient = np.asarray(_image_gradient(data, jnp.asarray(u)))
    quadrature = data.quadrature
    count = len(gradient)
    weighted = np.sqrt(2 * np.asarray(quadrature.weights) / float(data.t_similarity))[:, None] * gradient
    entries = np.asarray(quadrature.barycentric)[:, :, None] * weighted[:, None]
    columns = _degrees(mesh.cells[np.asarray(quadrature.cells)].ravel()).reshape(count, 12)
    rows = np.repeat(np.arange(count), 12)
    J = scipy.sparse.csr_matrix((entries.ravel(), (rows, columns.ravel())), shape=(count, 3 * len(mesh.points)))
    return (J.T @ J).tocsr()


@jax.jit
def _image_gradient(data: RegistrationData, u: Float[AnyArray, "nodes 3"]) -> Float[AnyArray, "points 3"]:
    """∇m(x_q + u(x_q)), 1/mm."""
    moved = data.positions + displacement_at(data.system.elements, data.quadrature, u)
    return jax.grad(lambda x: data.moving(x).sum())(moved)
