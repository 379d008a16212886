"""Curvature of the posterior in the displacements, Gauss–Newton and exact, assembled on the host."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from bayesreg.fem.elasticity import element_stiffness, stiffness, unknowns_of
from bayesreg.fem.preconditioners import DENSE_LIMIT, solve
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Values
from bayesreg.model.external_curvature import external_curvature
from bayesreg.model.program import Problem
from bayesreg.model.state import Body
from bayesreg.model.stiffness_parts import coefficients, stiffness_of, stiffness_parts
from bayesreg.model.term import ExternalTerm, HasCurvature, PointCurvature
from bayesreg.types import AnyArray, Matrix


@dataclass(frozen=True, eq=False)
class Curvature:
    """The curvature (Hessian) of minus a log density.

    Attributes
    ----------
    gauss_newton : (r, r) array
        Positive semidefinite.
    second_derivatives : callable
        () → `remainder`; it is computed only on demand.
    """

    gauss_newton: Float[np.ndarray, "rows rows"]
    second_derivatives: Callable[[], Float[np.ndarray, "rows rows"]]

    @cached_property
    def remainder(self) -> Float[np.ndarray, "rows rows"]:
        """The rest of the exact curvature: residuals times second derivatives. It is small if the images agree."""
        return self.second_derivatives()


def displacement_curvature(problem: Problem, values: Values, u: Float[AnyArray, "nodes 3"]) -> Curvature:
    """Compute the curvature of −log p in the field's components z, if any, and the sampled displacements.

    With u_I = W u_B of eq. (7), W = −K_II⁻¹ K_IB, the elastic energy has the Hessian K_BB + K_BI W. An observation with
    the curvature H in all nodes has the Hessian [1; W]ᵀ H [1; W]. H is the Gauss–Newton curvature, such as 2 Jᵀ J of a
    sum of squares; the remainder is the exact curvature minus it. The field multiplies the stiffness of element e by
    exp(s_e), s = sd · basis · z, so that ∂u_I/∂s_e = −K_II⁻¹ (K_e u)_I. The prior of z is N(0, I). Two parts are
    omitted in z: E_r, which is small compared with E_s and not convex, and the second derivatives of u_I.

    Parameters
    ----------
    problem : Problem
    values : mapping
        Values of all blocks.
    u : (n, 3) array
        The equilibrium, mm.

    Returns
    -------
    Curvature
        First z, then row 3 · node + axis, 1/mm².
    """
    response = _Response.at(problem, values, u)
    curved = [term for term in problem.terms.values() if isinstance(term, HasCurvature)]
    summed = partial(_sum, len(u))
    outside = external_curvature(problem, values, u)
    gauss_newton = _dense(response.reduce(outside + summed(term.gauss_newton(u, values) for term in curved)))
    gauss_newton += response.place(_prior_curvature(problem, response.schur, values))
    gauss_newton[: response.modes, : response.modes] += np.eye(response.modes)
    return Curvature(
        gauss_newton, lambda: _dense(response.reduce(summed(term.remainder(u, values) for term in curved)))
    )


def quadratic_curvature(problem: Problem, values: Values, near: Values, u: Float[AnyArray, "nodes 3"]) -> Matrix:
    """Compute the curvature of all terms that are quadratic, or nearly quadratic, in the displacements.

    These are all terms except images, barrier and skull. The equilibrium depends on the sampled nodes as at other
    values near by. Since the equilibrium minimises the energy, the first derivatives of the result in the values equal
    those of the exact curvature.

    The rows are in the order of `displacement_curvature`.

    Parameters
    ----------
    problem : Problem
    values, near : mapping
        Values of all blocks.
    u : (n, 3) array
        The equilibrium at `near`, mm.
    """
    response = _Response.at(problem, near, u)
    K = stiffness_of(problem.body, values)
    curved = (term for term in problem.terms.values() if isinstance(term, HasCurvature) and is_nearly_quadratic(term))
    observed = _sum(len(u), (term.gauss_newton(u, values) for term in curved))
    curvature = response.reduce(observed + external_curvature(problem, values, u))
    energy = response.reduce(K, with_field=False)
    prior = _prior_curvature(problem, energy, values)
    if not response.modes and not len(response.free):
        return scipy.sparse.csr_matrix(curvature + prior)
    total = _dense(curvature) + response.place(_dense(prior))
    total[: response.modes, : response.modes] += np.eye(response.modes)
    return total


def _covariance_at_points(
    points: PointCurvature, covariance: Float[np.ndarray, "unknowns unknowns"]
) -> Float[np.ndarray, "points 3 3"]:
    """Compute the covariance of the displacement of each point from the covariance of all nodes."""
    corners = 3 * np.asarray(points.nodes)[..., None] + np.arange(3)
    between_corners = covariance[corners[:, :, :, None, None], corners[:, None, None]]
    weights = np.asarray(points.weights)
    return np.einsum("qa,qaibj,qb->qij", weights, between_corners, weights, optimize=True)


def is_nearly_quadratic(term: object) -> bool:
    """Check whether the log of a term is nearly quadratic in the displacements: all but images, barrier and skull."""
    return getattr(term, "is_nearly_quadratic", True)


def quadratic_trace(
    problem: Problem,
    near: Values,
    u: Float[AnyArray, "nodes 3"],
    covariance: Float[np.ndarray, "rows rows"],
) -> Callable[[Values], float]:
    """Make the function that maps values of the hyperparameters to tr(C R), up to a constant.

    Parameters
    ----------
    problem : Problem
    near : mapping
        Values of all blocks; see `quadratic_curvature`, which computes R.
    u : (n, 3) array
        The equilibrium at `near`, mm.
    covariance : (r, r) array
        C, in the order of `displacement_curvature`.
    """
    response, parts = _Response.at(problem, near, u), stiffness_parts(problem.body, near)
    in_nodes = without_field = response.expand(covariance, 3 * len(u))
    if response.modes:
        # The priors have no curvature in the field.
        of_displacements = np.array(covariance)
        of_displacements[: response.modes] = of_displacements[:, : response.modes] = 0.0
        without_field = response.expand(of_displacements, 3 * len(u))
    elastic = problem.terms.get("elastic")
    elastic_trace = elastic and elastic.trace(parts, without_field)
    scaled = {
        name: _covariance_at_points(term.gauss_newton(u, near), in_nodes)
        for name, term in problem.terms.items()
        if isinstance(term, HasCurvature) and is_nearly_quadratic(term) and getattr(term, "hyperparameters", ()) != ()
    }
    has_external = any(isinstance(term, ExternalTerm) for term in problem.terms.values())

    def trace(values: Values) -> float:
        total = elastic_trace(coefficients(problem.body, values), values) if elastic_trace else 0.0
        for name, at_points in scaled.items():
            matrices = np.asarray(problem.terms[name].gauss_newton(u, values).matrices)
            total += float(np.vdot(matrices, at_points))
        if has_external:
            total += float(external_curvature(problem, values, u).multiply(in_nodes).sum())
        return total

    return trace


class _Response(NamedTuple):
    """The linear response u_I = W (z, u_B) of the nodes that are not sampled to the sampled nodes and the field.

    Attributes
    ----------
    sampled, free : int arrays
        Unknowns 3 · node + axis.
    W : (free, modes + sampled) array
    schur : (sampled, sampled) matrix
        The Schur complement of K in the sampled nodes; sparse if no node is free.
    """

    sampled: Int[np.ndarray, "sampled"]
    free: Int[np.ndarray, "free"]
    W: Float[np.ndarray, "free columns"]
    schur: Matrix

    @classmethod
    def at(cls, problem: Problem, values: Values, u: Float[AnyArray, "nodes 3"]) -> _Response:
        """Compute the response at some values and their equilibrium u, mm."""
        body, u = problem.body, jnp.asarray(u)
        mesh = body.mesh.mesh
        sampled = unknowns_of(np.asarray(body.system.prescribed)[np.asarray(body.sampled_index)])
        free = unknowns_of(np.asarray(body.system.free))
        lam, mu = (np.asarray(by_cell) for by_cell in body.lame_by_cell(values))
        arguments = sampled, free, lam, mu
        if body.field is not None:
            load = _element_forces(body, lam, mu, u) @ (float(values["field_sd"]) * np.asarray(body.field.basis))
            return cls(sampled, free, *_response(mesh, *arguments, load[free]))
        if len(free) > DENSE_LIMIT:
            return cls(sampled, free, *_response(mesh, *arguments, np.zeros((len(free), 0))))
        return cls(sampled, free, *_kept_response(mesh, *(tuple(argument.tolist()) for argument in arguments)))

    @property
    def modes(self) -> int:
        """The number of components of the field."""
        return self.W.shape[1] - len(self.sampled)

    def reduce(self, nodal: scipy.sparse.csr_matrix, with_field: bool = True) -> Matrix:
        """Reduce a curvature in all nodes to (z, u_B), or to u_B only; it is sparse if no node is free."""
        W = self.W if with_field else self.W[:, self.modes :]
        if not len(self.free):
            alone = nodal[self.sampled][:, self.sampled]
            return self.place(alone) if with_field and self.modes else alone
        modes = W.shape[1] - len(self.sampled)
        cross = nodal[self.sampled][:, self.free] @ W
        reduced = W.T @ (nodal[self.free][:, self.free] @ W)
        reduced[modes:] += cross
        reduced[:, modes:] += cross.T
        reduced[modes:, modes:] += nodal[self.sampled][:, self.sampled].toarray()
        return (reduced + reduced.T) / 2

    def expand(
        self, covariance: Float[np.ndarray, "columns columns"], unknowns: int
    ) -> Float[np.ndarray, "unknowns unknowns"]:
        """Expand a covariance of (z, u_B) to all unknowns; those of held nodes have none."""
        if np.array_equal(self.sampled, np.arange(unknowns)) and not self.modes:
            return covariance
        of_sampled = covariance[self.modes :, self.modes :]
        cross = self.W @ covariance
        rows, nodal = np.concatenate([self.sampled, self.free]), np.zeros((unknowns, unknowns))
        blocks = [[of_sampled, cross[:, self.modes :].T], [cross[:, self.modes :], cross @ self.W.T]]
        nodal[np.ix_(rows, rows)] = np.block(blocks) if len(self.free) else of_sampled
        return nodal

    def place(self, curvature: Matrix) -> Float[np.ndarray, "rows rows"]:
        """Expand a curvature in u_B to (z, u_B)."""
        return np.pad(_dense(curvature), (self.modes, 0))


def _prior_curvature(problem: Problem, energy: Matrix, values: Values) -> Matrix:
    """Compute the curvature of the elastic and rigid priors in u_B; `energy` is the Hessian of the elastic energy."""
    curvature = scipy.sparse.csr_matrix(energy.shape)
    if "elastic" in problem.terms:
        curvature = problem.terms["elastic"].curvature(energy, values)
    if "rigid" in problem.terms:
        curvature = _dense(curvature) + np.asarray(problem.terms["rigid"].precision())
    return curvature


def _dense(matrix: Matrix) -> Float[np.ndarray, "rows rows"]:
    return matrix.toarray() if scipy.sparse.issparse(matrix) else matrix


def _sum(nodes: int, point_curvatures: Iterable[PointCurvature]) -> scipy.sparse.csr_matrix:
    """Sum the curvatures in displacements of points into one in all nodes, with row 3 · node + axis."""
    empty = scipy.sparse.csr_matrix((3 * nodes, 3 * nodes))
    return sum((_assemble(nodes, point_curvature) for point_curvature in point_curvatures), empty)


def _response(
    mesh: TetMesh,
    sampled: Int[np.ndarray, "sampled"],
    free: Int[np.ndarray, "free"],
    lam: Float[np.ndarray, "cells"],
    mu: Float[np.ndarray, "cells"],
    load: Float[np.ndarray, "free loads"],
) -> tuple[Float[np.ndarray, "free columns"], Matrix]:
    """Compute −K_II⁻¹ [load, K_IB], and the Schur complement K_BB + K_BI W (sparse if no node is free)."""
    K = stiffness(mesh, lam, mu)
    coupling = K[free][:, sampled]
    W = np.hstack([load, coupling.toarray()])
    if not len(free):
        return W, K[sampled][:, sampled]
    W = -solve(K[free][:, free], W)
    schur = np.asarray(K[sampled][:, sampled] + coupling.T @ W[:, load.shape[1] :])
    return W, (schur + schur.T) / 2


@lru_cache(maxsize=1)
def _kept_response(
    mesh: TetMesh, sampled: tuple[int, ...], free: tuple[int, ...], lam: tuple[float, ...], mu: tuple[float, ...]
) -> tuple[Float[np.ndarray, "free sampled"], Matrix]:
    """Compute `_response` without loads, and cache it for the stages of a search, which share λ and μ."""
    rows, others = np.array(sampled, int), np.array(free, int)
    return _response(mesh, rows, others, np.array(lam), np.array(mu), np.zeros((len(others), 0)))


def _element_forces(body: Body, lam: AnyArray, mu: AnyArray, u: AnyArray) -> scipy.sparse.csr_matrix:
    """Compute the nodal forces K_e u of each element e; column e belongs to element e."""
    elements = body.system.elements
    corners = jnp.moveaxis(jnp.asarray(u)[elements.cells], -1, 0)
    forces = jnp.einsum("aibjm,jbm->aim", element_stiffness(elements, jnp.asarray(lam), jnp.asarray(mu)), corners)
    rows = 3 * np.asarray(elements.cells)[:, None] + np.arange(3)[:, None]
    columns = np.broadcast_to(np.arange(rows.shape[-1]), rows.shape)
    shape = (3 * len(u), rows.shape[-1])
    return scipy.sparse.csr_matrix((np.asarray(forces).ravel(), (rows.ravel(), columns.ravel())), shape=shape)


def _assemble(nodes: int, points: PointCurvature) -> scipy.sparse.csr_matrix:
    """Sum Σ_q C_q N_a N_b, and g gᵀ of groups: convert a curvature in displacements of points to one in all nodes."""
    curvature = np.asarray(points.matrices)
    count = len(curvature)
    if not count:
        return scipy.sparse.csr_matrix((3 * nodes, 3 * nodes))
    weights = np.broadcast_to(np.asarray(points.weights)[:, None], (count, 3, 4))
    columns = 3 * np.asarray(points.nodes)[:, None] + np.arange(3)[:, None]
    shape, starts = (3 * count, 3 * nodes), np.arange(0, 12 * count + 1, 4)
    P = scipy.sparse.csr_matrix((weights.ravel(), columns.ravel(), starts), shape=shape)
    C = scipy.sparse.bsr_matrix((curvature, np.arange(count), np.arange(count + 1)))
    nodal_curvature = P.T @ (C.tocsr() @ P)
    if points.shared is not None:
        groups, rows = np.repeat(np.asarray(points.shared.groups), 3), np.arange(3 * count)
        for vectors, sign in zip(np.asarray(points.shared.vectors), np.asarray(points.shared.signs), strict=True):
            forces = P.T @ scipy.sparse.csr_matrix((vectors.ravel(), (rows, groups)))
            nodal_curvature = nodal_curvature + sign * (forces @ forces.T)
    return nodal_curvature.tocsr()
