"""Curvature of the posterior in the displacements, Gauss–Newton and exact, assembled on the host."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from bayesreg.fem.elasticity import element_stiffness, stiffness, unknowns_of
from bayesreg.fem.preconditioners import DENSE_LIMIT, solved
from bayesreg.mesh import TetMesh
from bayesreg.model.program import RegistrationData
from bayesreg.model.similarity import SIMILARITIES, Noise
from bayesreg.types import AnyArray


@dataclass(frozen=True, eq=False)
class Curvature:
    """Of minus a log density.

    Attributes
    ----------
    gauss_newton : (r, r) array
        Positive semidefinite.
    second_derivatives : callable
        () → `remainder`, which not everybody needs.
    """

    gauss_newton: Float[np.ndarray, "rows rows"]
    second_derivatives: Callable[[], Float[np.ndarray, "rows rows"]]

    @cached_property
    def remainder(self) -> Float[np.ndarray, "rows rows"]:
        """What the exact one has besides: residuals times second derivatives. Small where the images agree."""
        return self.second_derivatives()


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
    parts = sampled, free, np.asarray(lam), np.asarray(mu)
    if data.field is not None:
        load = _element_forces(data, lam, mu, u) @ (field_sd * np.asarray(data.field.basis))
        W, schur = _response(mesh, *parts, load[free])
    elif len(free) > DENSE_LIMIT:
        W, schur = _response(mesh, *parts, np.zeros((len(free), 0)))
    else:
        W, schur = _kept_response(mesh, *(tuple(part.tolist()) for part in parts))
    modes = W.shape[1] - len(sampled)

    def reduced(points: AnyArray) -> np.ndarray:
        """The curvature in (z, u_B) of one in the places of the quadrature points."""
        # What is sampled moves by itself, and the rest by W.
        nodal = _assembled(mesh, data, np.asarray(points))
        cross = nodal[sampled][:, free] @ W
        found = W.T @ (nodal[free][:, free] @ W)
        found[modes:] += cross
        found[:, modes:] += cross.T
        found[modes:, modes:] += nodal[sampled][:, sampled].toarray()
        return (found + found.T) / 2

    gauss_newton = reduced(_first_order(data, jnp.asarray(u)))
    gauss_newton[modes:, modes:] += schur / float(data.t_elastic)
    gauss_newton[:modes, :modes] += np.eye(modes)
    return Curvature(gauss_newton, lambda: reduced(_second_order(similarity, data, jnp.asarray(u))))


def _response(
    mesh: TetMesh,
    sampled: Int[np.ndarray, "sampled"],
    free: Int[np.ndarray, "free"],
    lam: Float[np.ndarray, "cells"],
    mu: Float[np.ndarray, "cells"],
    load: Float[np.ndarray, "free loads"],
) -> tuple[Float[np.ndarray, "free columns"], Float[np.ndarray, "sampled sampled"]]:
    """−K_II⁻¹ [load, K_IB], and the Schur complement K_BB + K_BI W."""
    K = stiffness(mesh, lam, mu)
    coupling = K[free][:, sampled]
    W = np.hstack([load, coupling.toarray()])
    if len(free):
        W = -solved(K[free][:, free], W)
    schur = np.asarray(K[sampled][:, sampled] + coupling.T @ W[:, load.shape[1] :])
    return W, (schur + schur.T) / 2


@lru_cache(maxsize=1)
def _kept_response(
    mesh: TetMesh, sampled: tuple[int, ...], free: tuple[int, ...], lam: tuple[float, ...], mu: tuple[float, ...]
) -> tuple[Float[np.ndarray, "free sampled"], Float[np.ndarray, "sampled sampled"]]:
    """The same without loads, which the stages of a search that leave λ and μ alone share."""
    rows, others = np.array(sampled, int), np.array(free, int)
    return _response(mesh, rows, others, np.array(lam), np.array(mu), np.zeros((len(others), 0)))


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


@jax.jit
def _first_order(data: RegistrationData, u: Float[AnyArray, "nodes 3"]) -> Float[AnyArray, "points 3 3"]:
    """Gauss–Newton's curvature of E_s/T_s in every place x_q + u(x_q), tempered: 2 w ∇m ∇mᵀ/T_s, 1/mm²."""
    gradient = _slope(data, _places(data, u))
    weights = data.independent_share / data.t_similarity * 2 * data.quadrature.weights
    return weights[:, None, None] * gradient[:, :, None] * gradient[:, None]


@partial(jax.jit, static_argnums=0)
def _second_order(
    similarity: str, data: RegistrationData, u: Float[AnyArray, "nodes 3"]
) -> Float[AnyArray, "points 3 3"]:
    """What the exact curvature has besides. With e(m) the energy of a point it is e″ ∇m ∇mᵀ + e′ ∇²m."""
    moved, weights = _places(data, u), data.quadrature.weights

    def energy_slope(values: AnyArray) -> AnyArray:
        noise = Noise(data.t_similarity, data.degrees_of_freedom)
        energy = SIMILARITIES[similarity].energy
        return jax.grad(lambda m: energy(data.fixed_values, m, weights, noise))(values)

    slope = partial(_slope, data)
    gradient, values = slope(moved), data.moving(moved)
    columns = [jax.jvp(slope, (moved,), (jnp.broadcast_to(axis, moved.shape),))[1] for axis in jnp.eye(3)]
    first, second = jax.jvp(energy_slope, (values,), (jnp.ones_like(values),))
    outer = gradient[:, :, None] * gradient[:, None]
    remainder = (second - 2 * weights)[:, None, None] * outer + first[:, None, None] * jnp.stack(columns, axis=-1)
    return data.independent_share / data.t_similarity * remainder


def _places(data: RegistrationData, u: AnyArray) -> AnyArray:
    return data.positions + data.quadrature.interpolation(u)


def _slope(data: RegistrationData, places: AnyArray) -> AnyArray:
    """∇m."""
    return jax.grad(lambda x: data.moving(x).sum())(places)
