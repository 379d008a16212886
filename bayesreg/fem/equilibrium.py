"""The elastic equilibrium of the free nodes: K_II u_I = −K_IB u_B by preconditioned conjugate gradients."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from bayesreg.columns import with_chains_as_columns
from bayesreg.fem import preconditioners
from bayesreg.fem.conjugate_gradients import ElasticSystem, SolverInfo, conjugate_gradients
from bayesreg.fem.elasticity import (
    force_between,
    lame_by_cell,
    rigid_modes,
    stiffness,
    strain_products,
    unknowns_of,
)
from bayesreg.fem.elements import derivative_matrix, displacement_gradient, elements_of
from bayesreg.fem.multigrid import Multigrid, build_multigrid
from bayesreg.fem.operators import SparseOperator, sparse_operator
from bayesreg.fem.preconditioners import ReferenceInverse
from bayesreg.mesh import TetMesh
from bayesreg.types import AnyArray, Equilibrium, InputError, Scalar

TOLERANCE = 1e-8


LinearMap = Callable[[AnyArray], AnyArray]


def elastic_system(
    mesh: TetMesh,
    prescribed: Int[AnyArray, "prescribed"],
    lam_reference: Float[AnyArray, "entries"],
    mu_reference: Float[AnyArray, "entries"],
    tolerance: float = TOLERANCE,
    adjoint_tolerance: float | None = None,
) -> ElasticSystem:
    """Prepare the solves on a mesh whose `prescribed` nodes have given displacements.

    The default of `adjoint_tolerance` is `tolerance`.

    Raises
    ------
    InputError
        If the prescribed nodes do not fix the mesh.
    """
    free = np.setdiff1d(np.arange(len(mesh.points)), np.asarray(prescribed))
    degrees = unknowns_of(free)
    reference = stiffness(mesh, lam_reference, mu_reference)[degrees][:, degrees]
    preconditioner = _preconditioner(reference, mesh.points[free]) if len(free) else None
    derivative = derivative_matrix(mesh)
    return ElasticSystem(
        elements=elements_of(mesh),
        prescribed=jnp.asarray(prescribed),
        free=jnp.asarray(free),
        order=jnp.asarray(np.argsort(np.concatenate([np.asarray(prescribed), free]))),
        free_derivative=sparse_operator(derivative[:, free]),
        prescribed_derivative=sparse_operator(derivative[:, np.asarray(prescribed)]),
        preconditioner=preconditioner,
        tolerance=jnp.asarray(tolerance),
        adjoint_tolerance=jnp.asarray(tolerance if adjoint_tolerance is None else adjoint_tolerance),
    )


def _preconditioner(
    matrix: scipy.sparse.csr_matrix, points: Float[np.ndarray, "free 3"]
) -> ReferenceInverse | Multigrid:
    if matrix.shape[0] <= preconditioners.DENSE_LIMIT:
        return preconditioners.reference_inverse(matrix)
    return build_multigrid(matrix, rigid_modes(points))


def equilibrium(
    system: ElasticSystem,
    lam: Float[AnyArray, "cells"],
    mu: Float[AnyArray, "cells"],
    u_prescribed: Float[AnyArray, "prescribed 3"],
    guess: Float[AnyArray, "nodes 3"] | None = None,
) -> Equilibrium:
    """Compute the displacement of every node for λ and μ by cell; implicitly differentiable in λ, μ and u.

    A `guess` (the equilibrium of a similar state, mm) saves iterations. The result then has no derivative, and
    reverse-mode differentiation raises an error.
    """
    if guess is None:
        return _differentiable(system, lam, mu, u_prescribed)
    return _solve(system, lam, mu, u_prescribed, guess)


def _solve(
    system: ElasticSystem, lam: AnyArray, mu: AnyArray, u_prescribed: AnyArray, guess: AnyArray | None = None
) -> Equilibrium:
    if len(system.free) == 0:
        fine = jnp.isfinite(u_prescribed).all()
        return Equilibrium(u_prescribed[system.order], jnp.zeros(()), jnp.zeros((), int), fine)
    load = -_force(system, system.free_derivative, system.prescribed_derivative, lam, mu, u_prescribed)
    u_free, info = _response(system, system.tolerance, lam, mu, load, guess)
    # This is a gather because XLA turns a scatter into a loop on the CPU.
    u = jnp.concatenate([u_prescribed, u_free])[system.order]
    # A node whose cells have no free node is not part of the solve, but must be finite, too.
    return Equilibrium(u, info.residual, info.iterations, info.converged & jnp.isfinite(u).all())


def _force(
    system: ElasticSystem, on: SparseOperator, of: SparseOperator, lam: AnyArray, mu: AnyArray, u: AnyArray
) -> AnyArray:
    return force_between(on, of, system.elements.volumes, lam, mu, u)


def _response(
    system: ElasticSystem,
    tolerance: Scalar,
    lam: AnyArray,
    mu: AnyArray,
    load: AnyArray,
    guess: AnyArray | None = None,
) -> tuple[AnyArray, SolverInfo]:
    """Multiply a load on the free nodes by K_II⁻¹; the result has a derivative only without a guess."""
    start = () if guess is None else (guess[system.free],)

    def solve(_: LinearMap, load: AnyArray) -> tuple[AnyArray, SolverInfo]:
        solution = conjugate_gradients((system, tolerance), *(x[..., None] for x in (lam, mu, load, *start)))
        return jax.tree.map(lambda x: x[..., 0], solution)

    apply = partial(_force, system, system.free_derivative, system.free_derivative, lam, mu)
    if start:
        return solve(apply, load)
    return jax.lax.custom_linear_solve(apply, load, solve, symmetric=True, has_aux=True)


@jax.custom_vjp
def _differentiable(system: ElasticSystem, lam: AnyArray, mu: AnyArray, u_prescribed: AnyArray) -> Equilibrium:
    return _solve(system, lam, mu, u_prescribed)


def _forward(
    system: ElasticSystem, lam: AnyArray, mu: AnyArray, u_prescribed: AnyArray
) -> tuple[Equilibrium, tuple[ElasticSystem, AnyArray, AnyArray, AnyArray]]:
    state = _solve(system, lam, mu, u_prescribed)
    return state, (system, lam, mu, state.u)


def _backward(
    saved: tuple[ElasticSystem, AnyArray, AnyArray, AnyArray], cotangent: Equilibrium
) -> tuple[None, AnyArray, AnyArray, AnyArray]:
    """Solve the adjoint K_II w = ū_I, w_B = 0; then ∂/∂u_B = ū_B − (K w)_B and ∂/∂θ = −wᵀ (∂K/∂θ) u.

    One solve serves all functions of u. The strain energy needs none: it is minimal in u_I, so that its ū_I is the
    residual.
    """
    system, lam, mu, u = saved
    bar = cotangent.u
    if len(system.free) == 0:
        return None, jnp.zeros_like(lam), jnp.zeros_like(mu), bar[system.prescribed]
    w, _ = _response(system, system.adjoint_tolerance, lam, mu, bar[system.free])
    reaction = _force(system, system.prescribed_derivative, system.free_derivative, lam, mu, w)
    by_lam, by_mu = (x[..., 0] for x in _sensitivity(system, u[..., None], w[..., None]))
    return None, by_lam, by_mu, bar[system.prescribed] - reaction


@with_chains_as_columns
def _sensitivity(
    system: ElasticSystem, u: Float[AnyArray, "nodes 3 chains"], w: Float[AnyArray, "free 3 chains"]
) -> tuple[Float[AnyArray, "cells chains"], Float[AnyArray, "cells chains"]]:
    """Compute −wᵀ (∂K/∂λ) u and −wᵀ (∂K/∂μ) u of every cell."""
    dilatation, distortion = strain_products(
        displacement_gradient(system.elements.derivative, u), displacement_gradient(system.free_derivative, w)
    )
    volumes = system.elements.volumes[:, None]
    return -volumes * dilatation, -volumes * distortion


_differentiable.defvjp(_forward, _backward)


def solve_interior(
    mesh: TetMesh,
    lam: Float[AnyArray, "entries"],
    mu: Float[AnyArray, "entries"],
    u_boundary: Float[AnyArray, "boundary 3"],
    tolerance: float = TOLERANCE,
) -> Equilibrium:
    """Compute the elastic equilibrium of the interior nodes for given boundary displacements (eq. 7).

    Parameters
    ----------
    mesh : TetMesh
    lam, mu : (T,), (m,) or (1,) array
        Lamé parameters by tissue, by cell or uniform; positive.
    u_boundary : (b, 3) array
        Displacements in the order of `mesh.boundary`, mm.
    tolerance : float
        The greatest relative residual.

    Returns
    -------
    Equilibrium
        The equilibrium. Invalid numbers raise no error: for NaN the result has ``converged=False``.

    Raises
    ------
    InputError
        If a shape does not fit the mesh.
    """
    if np.shape(u_boundary) != (len(mesh.boundary), 3):
        raise InputError(f"u_boundary must have shape ({len(mesh.boundary)}, 3), got {np.shape(u_boundary)}")
    system = elastic_system(mesh, mesh.boundary, *_reference(lam, mu), tolerance)
    return equilibrium(system, lame_by_cell(lam, mesh), lame_by_cell(mu, mesh), jnp.asarray(u_boundary))


def _reference(
    lam: Float[AnyArray, "entries"], mu: Float[AnyArray, "entries"]
) -> tuple[Float[np.ndarray, "entries"], Float[np.ndarray, "entries"]]:
    """Choose the reference parameters of the preconditioner.

    They are λ and μ themselves if these are known and K has a factor, else ones.
    """
    are_concrete = not any(isinstance(values, jax.core.Tracer) for values in (lam, mu))
    if are_concrete and all(np.all((np.asarray(v) > 1e-12) & (np.asarray(v) < 1e12)) for v in (lam, mu)):
        return np.asarray(lam, float), np.asarray(mu, float)
    return np.ones(np.shape(lam)), np.ones(np.shape(mu))
