"""Preconditioned conjugate gradients for the free nodes of an elastic body, for many chains at once."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from bayesreg.columns import with_chains_as_columns
from bayesreg.fem.elasticity import forces, stiffness_diagonal
from bayesreg.fem.elements import Elements
from bayesreg.fem.multigrid import Multigrid
from bayesreg.fem.operators import SparseOperator
from bayesreg.fem.preconditioners import ReferenceInverse
from bayesreg.types import AnyArray, Scalar

MAX_ITERATIONS = 2000


class ElasticSystem(NamedTuple):
    """The arrays that the equilibrium of the free nodes needs (a pytree).

    Attributes
    ----------
    elements : Elements
    prescribed, free : (b,), (f,) int arrays
        A partition of the nodes.
    order : (n,) int array
        The index of each node in the concatenation of the prescribed and the free nodes.
    free_derivative, prescribed_derivative : SparseOperator
        The columns of `elements.derivative` that belong to the free and to the prescribed nodes.
    preconditioner : ReferenceInverse, Multigrid or None
        None if no node is free.
    tolerance, adjoint_tolerance : scalar
        The greatest relative residuals of the equilibrium and of the solve for its derivative. The norm is that of the
        inverse diagonal of K, so that they also hold for tissues a million times softer than their neighbours.
    """

    elements: Elements
    prescribed: Int[AnyArray, "prescribed"]
    free: Int[AnyArray, "free"]
    order: Int[AnyArray, "nodes"]
    free_derivative: SparseOperator
    prescribed_derivative: SparseOperator
    preconditioner: ReferenceInverse | Multigrid | None
    tolerance: Scalar
    adjoint_tolerance: Scalar


class SolverInfo(NamedTuple):
    """The relative residual of each chain, its iterations, and whether the residual is within the tolerance."""

    residual: Float[AnyArray, "chains"]
    iterations: Int[AnyArray, "chains"]
    converged: Bool[AnyArray, "chains"]


@with_chains_as_columns
def conjugate_gradients(
    shared: tuple[ElasticSystem, Scalar],
    lam: Float[AnyArray, "cells chains"],
    mu: Float[AnyArray, "cells chains"],
    load: Float[AnyArray, "free 3 chains"],
    *start: Float[AnyArray, "free 3 chains"],
) -> tuple[Float[AnyArray, "free 3 chains"], SolverInfo]:
    """Multiply a load by K_II⁻¹, with the K of each chain; the iteration begins at `start` or at zero.

    A chain does not change after it has converged or has become NaN, while the others continue. So the result of a
    chain does not depend on the other chains.
    """
    system, tolerance = shared
    precondition, volumes = system.preconditioner, system.elements.volumes
    assert precondition is not None
    apply = partial(forces, system.free_derivative, system.free_derivative, volumes, lam, mu)
    inverse_diagonal = 1 / stiffness_diagonal(system.free_derivative, volumes, lam, mu)

    def dot(a: AnyArray, b: AnyArray) -> AnyArray:
        return (a * b).sum(axis=(0, 1))

    def norm(r: AnyArray) -> AnyArray:
        return jnp.sqrt(dot(inverse_diagonal * r, r))

    target = tolerance * norm(load)

    def unfinished(residual: AnyArray, iterations: AnyArray) -> AnyArray:
        size = norm(residual)
        return (size > target) & jnp.isfinite(size) & (iterations < MAX_ITERATIONS)

    def iterate(state):  # type: ignore[no-untyped-def]
        x, residual, direction, rho, iterations, going = state
        image = apply(direction)
        step = rho / dot(direction, image)
        x = jnp.where(going, x + step * direction, x)
        residual = jnp.where(going, residual - step * image, residual)
        z = precondition(residual)
        rho, previous = dot(residual, z), rho
        direction = z + (rho / previous) * direction
        iterations = iterations + going
        return x, residual, direction, rho, iterations, going & unfinished(residual, iterations)

    x, residual = (start[0], load - apply(start[0])) if start else (jnp.zeros_like(load), load)
    z, none = precondition(residual), jnp.zeros(load.shape[-1:], int)
    begun = x, residual, z, dot(residual, z), none, unfinished(residual, none)
    x, residual, _, _, iterations, _ = jax.lax.while_loop(lambda state: state[-1].any(), iterate, begun)
    relative = jnp.where(target > 0, norm(residual) / norm(load), norm(residual))
    return x, SolverInfo(relative, iterations, relative <= tolerance)
