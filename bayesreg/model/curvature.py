"""Curvature of the posterior in the displacements, Gauss–Newton and exact, assembled on the host."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float

from bayesreg.fem.elasticity import element_stiffness, stiffness, unknowns_of
from bayesreg.fem.preconditioners import solved
from bayesreg.mesh import TetMesh
from bayesreg.model.program import RegistrationData
from bayesreg.model.similarity import SIMILARITIES, Noise
from bayesreg.types import AnyArray


class Curvature(NamedTuple):
    """Of minus a log density.

    Attributes
    ----------
    gauss_newton : (r, r) array
        Positive semidefinite.
    remainder : (r, r) array
        What the exact one has besides: residuals times second derivatives. Small where the images agree.
    """

    gauss_newton: Float[np.ndarray, "rows rows"]
    remainder: Float[np.ndarray, "rows rows"]


def displacement_curvature(
    mesh: TetMesh,
    data: RegistrationData,
    similarity: str,
    lam: Float[AnyArray, "cells"],
    mu: Float[AnyArray, "cells"],
    u: Float[AnyArray, "nodes 3"],
    field_sd: float = 0.0,
) -> Curvature:
    """Curvature of E_s/T_s + E_r/T_r in the field's components z, if any, and the sampled displacements.

    With u_I = W u_B of eq. (7), W = −K_II⁻¹ K_IB, the elastic energy has the Hessian K_BB + K_BI W, and the sum of
    squared residuals r the Gauss–Newton approximation 2 Jᵀ J of its own, J = ∂r/∂u [1; W]; the remainder is that of
    [1; W]ᵀ ∇²E_s [1; W]. The field multiplies the stiffness of element e by exp(s_e), s = sd · basis · z, so that
    ∂u_I/∂s_e = −K_II⁻¹ (K_e u)_I; z has the prior N(0, I), and E_r, small beside E_s in z and not convex, is left out
    there, as are the second derivatives of u_I.

    Parameters
    ----------
    mesh, data
    similarity : str
        Name of the similarity.
    lam, mu : (m,) array
        With the field's factor.
    u : (n, 3) array
        The equilibrium, mm.
    field_sd : float
        Where there is a field.

    Returns
    -------
    Curvature
        First z, then row 3 · node + axis, 1/mm².
    """
    sampled = unknowns_of(np.asarray(data.system.prescribed)[np.asarray(data.slots)])
    free = unknowns_of(np.asarray(data.system.free))
    K = stiffness(mesh, lam, mu)
    coupling = K[free][:, sampled]
    load = np.zeros((len(free), 0))
    if data.field is not None:
        load = (_element_forces(data, lam, mu, u) @ (field_sd * np.asarray(data.field.basis)))[free]
    modes = load.shape[1]
    W = np.zeros((0, modes + len(sampled)))
    if len(free):
        W = -solved(K[free][:, free], np.hstack([load, coupling.toarray()]))
    schur = K[sampled][:, sampled] + coupling.T @ W[:, modes:]
    # ∂u/∂(z, u_B): what is sampled moves by itself, the rest by W.
    unit = np.hstack([np.zeros((len(sampled), modes)), np.eye(len(sampled))])

    def reduced(points: np.ndarray) -> np.ndarray:
        """The curvature in (z, u_B) of one in the places of the quadrature points."""
        nodal = _assembled(mesh, data, points)
        cross = unit.T @ (nodal[sampled][:, free] @ W)
        found = unit.T @ (nodal[sampled][:, sampled] @ unit) + cross + cross.T + W.T @ (nodal[free][:, free] @ W)
        return (found + found.T) / 2

    approximate, exact = (np.asarray(found) for found in _point_curvature(similarity, data, jnp.asarray(u)))
    gauss_newton, remainder = reduced(approximate), reduced(exact - approximate)
    schur = np.asarray(schur) / float(data.t_elastic)
    gauss_newton[modes:, modes:] += (schur + schur.T) / 2
    gauss_newton[:modes, :modes] += np.eye(modes)
    return Curvature(gauss_newton, remainder)


def _element_forces(data: RegistrationData, lam: AnyArray, mu: AnyArray, u: AnyArray) -> scipy.sparse.csr_matrix:
    """Column e: the nodal forces K_e u of element e alone."""
    elements = data.system.elements
    corners = jnp.moveaxis(jnp.asarray(u)[elements.cells], -1, 0)
    forces = jnp.einsum("aibjm,jbm->aim", element_stiffness(elements, jnp.asarray(lam), jnp.asarray(mu)), corners)
    rows = 3 * np.asarray(elements.cells)[:, None] + np.arange(3)[:, None]
    columns = np.broadcast_to(np.arange(rows.shape[-1]), rows.shape)
    shape = (3 * len(u), rows.shape[-1])
    return scipy.sparse.csr_matrix((np.asarray(forces).ravel(), (rows.ravel(), columns.ravel())), shape=shape)


def _assembled(
    mesh: TetMesh, data: RegistrationData, points: Float[np.ndarray, "points 3 3"]
) -> scipy.sparse.csr_matrix:
    """Σ_q C_q N_a N_b: a curvature in the places of the quadrature points as one in all nodes."""
    quadrature = data.quadrature
    count = len(points)
    weights = np.broadcast_to(np.asarray(quadrature.barycentric)[:, None], (count, 3, 4))
    columns = 3 * mesh.cells[np.asarray(quadrature.cells)][:, None] + np.arange(3)[:, None]
    shape, starts = (3 * count, 3 * len(mesh.points)), np.arange(0, 12 * count + 1, 4)
    P = scipy.sparse.csr_matrix((weights.ravel(), columns.ravel(), starts), shape=shape)
    C = scipy.sparse.bsr_matrix((points, np.arange(count), np.arange(count + 1)))
    return (P.T @ (C.tocsr() @ P)).tocsr()


@partial(jax.jit, static_argnums=0)
def _point_curvature(
    similarity: str, data: RegistrationData, u: Float[AnyArray, "nodes 3"]
) -> tuple[Float[AnyArray, "points 3 3"], Float[AnyArray, "points 3 3"]]:
    """Curvature of E_s/T_s in every place x_q + u(x_q), tempered, 1/mm²: 2 w ∇m ∇mᵀ/T_s, and the exact one.

    With e(m) the energy of a point, e″ ∇m ∇mᵀ + e′ ∇²m.
    """
    quadrature = data.quadrature
    moved = data.positions + quadrature.interpolation(u)

    def slope(x: AnyArray) -> AnyArray:
        return jax.grad(lambda x: data.moving(x).sum())(x)

    def energy_slope(values: AnyArray) -> AnyArray:
        noise = Noise(data.t_similarity, data.degrees_of_freedom)
        energy = SIMILARITIES[similarity].energy
        return jax.grad(lambda m: energy(data.fixed_values, m, quadrature.weights, noise))(values)

    gradient, values = slope(moved), data.moving(moved)
    columns = [jax.jvp(slope, (moved,), (jnp.broadcast_to(axis, moved.shape),))[1] for axis in jnp.eye(3)]
    first, second = jax.jvp(energy_slope, (values,), (jnp.ones_like(values),))
    outer, scale = gradient[:, :, None] * gradient[:, None], data.independent_share / data.t_similarity
    exact = second[:, None, None] * outer + first[:, None, None] * jnp.stack(columns, axis=-1)
    return scale * 2 * quadrature.weights[:, None, None] * outer, scale * exact
