"""Gauss–Newton curvature of the posterior in the displacements, assembled on the host."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float

from bayesreg.fem.elasticity import element_stiffness, stiffness
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
    field_sd: float = 0.0,
) -> Float[np.ndarray, "rows rows"]:
    """Curvature of E_s/T_s + E_r/T_r in the field's components z, if any, and the sampled displacements.

    With u_I = W u_B of eq. (7), W = −K_II⁻¹ K_IB, the elastic energy has the Hessian K_BB + K_BI W, and the sum of
    squared residuals r the Gauss–Newton approximation 2 Jᵀ J of its own, J = ∂r/∂u [1; W]. The field multiplies the
    stiffness of element e by exp(s_e), s = sd · basis · z, so that ∂u_I/∂s_e = −K_II⁻¹ (K_e u)_I; z has the prior
    N(0, I), and E_r, small beside E_s in z and not convex, is left out there.

    Parameters
    ----------
    mesh, data
    lam, mu : (m,) array
        With the field's factor.
    u : (n, 3) array
        The equilibrium, mm.
    field_sd : float
        Where there is a field.

    Returns
    -------
    (k + 3b, k + 3b) array
        First z, then row 3 · node + axis, 1/mm²; positive semidefinite.
    """
    sampled = _degrees(np.asarray(data.system.prescribed)[np.asarray(data.slots)])
    free = _degrees(np.asarray(data.system.free))
    K = stiffness(mesh, lam, mu)
    normal = _normal_matrix(mesh, data, u)
    coupling = K[free][:, sampled]
    load = np.zeros((len(free), 0))
    if data.field is not None:
        load = (_element_forces(data, lam, mu, u) @ (field_sd * np.asarray(data.field.basis)))[free]
    modes = load.shape[1]
    W = np.zeros((0, modes + len(sampled)))
    if len(free):
        W = -scipy.sparse.linalg.splu(K[free][:, free].tocsc()).solve(np.hstack([load, coupling.toarray()]))
    schur = K[sampled][:, sampled] + coupling.T @ W[:, modes:]
    # ∂u/∂(z, u_B): what is sampled moves by itself, the rest by W.
    unit = np.hstack([np.zeros((len(sampled), modes)), np.eye(len(sampled))])
    cross = unit.T @ (normal[sampled][:, free] @ W)
    precision = unit.T @ (normal[sampled][:, sampled] @ unit) + cross + cross.T + W.T @ (normal[free][:, free] @ W)
    precision[modes:, modes:] += np.asarray(schur) / float(data.t_elastic)
    precision[:modes, :modes] += np.eye(modes)
    return (precision + precision.T) / 2


def _element_forces(data: RegistrationData, lam: AnyArray, mu: AnyArray, u: AnyArray) -> scipy.sparse.csr_matrix:
    """Column e: the nodal forces K_e u of element e alone."""
    elements = data.system.elements
    corners = jnp.moveaxis(jnp.asarray(u)[elements.cells], -1, 0)
    forces = jnp.einsum("aibjm,jbm->aim", element_stiffness(elements, jnp.asarray(lam), jnp.asarray(mu)), corners)
    rows = 3 * np.asarray(elements.cells)[:, None] + np.arange(3)[:, None]
    columns = np.broadcast_to(np.arange(rows.shape[-1]), rows.shape)
    shape = (3 * len(u), rows.shape[-1])
    return scipy.sparse.csr_matrix((np.asarray(forces).ravel(), (rows.ravel(), columns.ravel())), shape=shape)


def _degrees(nodes: np.ndarray) -> np.ndarray:
    return (3 * nodes[:, None] + np.arange(3)).ravel()


def _normal_matrix(mesh: TetMesh, data: RegistrationData, u: Float[AnyArray, "nodes 3"]) -> scipy.sparse.csr_matrix:
    """2/T_s Σ_q w_q ∇m ∇mᵀ N_a N_b at x_q + u(x_q), tempered: the curvature of the log likelihood in all nodes."""
    gradient = np.asarray(_image_gradient(data, jnp.asarray(u)))
    quadrature = data.quadrature
    count, share = len(gradient), float(data.independent_share)
    weighted = np.sqrt(2 * share * np.asarray(quadrature.weights) / float(data.t_similarity))[:, None] * gradient
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
