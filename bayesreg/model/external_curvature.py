"""Curvature of terms from outside the package, which provide only their logarithm, by automatic differentiation."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from bayesreg.model.blocks import Values
from bayesreg.model.program import Problem
from bayesreg.model.state import State
from bayesreg.model.term import ExternalTerm
from bayesreg.types import AnyArray, Equilibrium

# Number of random displacements at which the dependence of a term from outside is tested, and the sd of their
# displacements, mm.
NEARBY, NEARBY_SD = 3, 0.1


def external_curvature(problem: Problem, values: Values, u: Float[AnyArray, "nodes 3"]) -> scipy.sparse.csr_matrix:
    """Sum the curvatures of all terms from outside the package, in all nodes."""
    lam, mu = problem.body.lame_by_cell(values)
    state = FixedState(problem, dict(values), lam, mu)
    empty = scipy.sparse.csr_matrix((3 * len(u), 3 * len(u)))
    terms = (term for term in problem.terms.values() if isinstance(term, ExternalTerm))
    return sum((_curvature_of_term(term, state, jnp.asarray(u)) for term in terms), empty)


class FixedState(NamedTuple):
    """The state, without its displacements, at which a term from outside is differentiated (a pytree)."""

    problem: Problem
    values: dict[str, AnyArray]
    lam: AnyArray
    mu: AnyArray


def _curvature_of_term(
    term: ExternalTerm, fixed_state: FixedState, u: Float[AnyArray, "nodes 3"]
) -> scipy.sparse.csr_matrix:
    """Compute the convex part of the Hessian of −log in all nodes, for a term that provides only its log."""
    touched = _find_touched(term, fixed_state, u)
    empty = scipy.sparse.csr_matrix((u.size, u.size))
    if not len(touched):
        return empty
    eigenvalues, vectors = np.linalg.eigh(_hessian(term, fixed_state, u, touched))
    convex = (vectors * np.maximum(eigenvalues, 0.0)) @ vectors.T
    rows, columns = np.repeat(touched, len(touched)), np.tile(touched, len(touched))
    return scipy.sparse.csr_matrix((convex.ravel(), (rows, columns)), shape=empty.shape)


def _find_touched(
    term: ExternalTerm, fixed_state: FixedState, u: Float[AnyArray, "nodes 3"]
) -> Int[np.ndarray, "touched"]:
    """Find the unknowns on which a term depends: its gradient is not zero there at some random displacement near u."""
    steps = NEARBY_SD * np.random.default_rng(0).normal(size=(NEARBY, *u.shape))
    slopes = [np.asarray(_slope(term, fixed_state, (u + step).ravel())) for step in steps]
    return np.flatnonzero((np.stack(slopes) != 0).any(axis=0))


def _hessian(
    term: ExternalTerm, fixed_state: FixedState, u: Float[AnyArray, "nodes 3"], touched: Int[np.ndarray, "touched"]
) -> Float[np.ndarray, "touched touched"]:
    """Compute the Hessian of −log in some unknowns by one Hessian-vector product for each of them."""
    hessian = np.asarray(_products(term, fixed_state, u.ravel(), jnp.asarray(touched)))[:, touched]
    return (hessian + hessian.T) / 2


@jax.jit
def _products(
    term: ExternalTerm, fixed_state: FixedState, flat: Float[AnyArray, "unknowns"], directions: Int[AnyArray, "k"]
) -> Float[AnyArray, "k unknowns"]:
    def row(unknown: AnyArray) -> AnyArray:
        direction = jnp.zeros_like(flat).at[unknown].set(1.0)
        return jax.jvp(partial(_slope, term, fixed_state), (flat,), (direction,))[1]

    return jax.lax.map(row, directions, batch_size=64)


@jax.jit
def _slope(
    term: ExternalTerm, fixed_state: FixedState, flat: Float[AnyArray, "unknowns"]
) -> Float[AnyArray, "unknowns"]:
    """Compute ∇(−log) in the displacements of all nodes."""
    body = fixed_state.problem.body

    def energy(flat: AnyArray) -> AnyArray:
        solved = Equilibrium(flat.reshape(-1, 3), jnp.zeros(()), jnp.zeros((), int), jnp.array(True))
        return -term.log(
            State(fixed_state.values, fixed_state.lam, fixed_state.mu, solved, body.system.elements, body.mesh.mesh)
        )

    return jax.grad(energy)(flat)
