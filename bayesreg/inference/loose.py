"""Moves of single nodes that little holds: what trajectories about a Gaussian reference mix worst.

A node that few elements of little contrast hold has a wide and bent density of its own, which no Gaussian follows; all
others of a mesh often converge many times sooner. How the density changes with one node is cheap to say approximately.
A move follows a trajectory of Hamiltonian Monte Carlo in the approximate density of that node alone, where it is
reversible, reflected at the skull as other trajectories are. Where the nodes end is tested, for all of them at once,
with the ratio of the true density to the approximate ones, which is exact (the surrogate transition method, Liu
2001; delayed acceptance, Christen and Fox 2005).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayesreg.inference.laplace import Reference, unravel
from bayesreg.inference.reflection import reflective_leapfrog, walls
from bayesreg.inference.target import SmoothTarget
from bayesreg.types import AnyArray

# Nodes that are moved alone. With each more the true density refuses more often what the approximate ones propose.
LOOSE = 2
# Of the trajectory of each: steps and their sizes, in standard deviations of the node where the others stay.
STEPS, SHORTEST, LONGEST = 20, 0.2, 0.7


class Loose(NamedTuple):
    """The nodes that are moved alone (a pytree).

    Attributes
    ----------
    nodes : (k,) int array
        Rows of "u_boundary".
    columns : (k, d, 3) array
        ∂ξ/∂u of each.
    spread : (k, 3, 3) array
        Lower triangular: of the covariance of each where all others stay.
    """

    nodes: Int[AnyArray, "k"]
    columns: Float[AnyArray, "k dimension 3"]
    spread: Float[AnyArray, "k 3 3"]


def slowest(path: Float[AnyArray, "draw chain node 3"], count: int) -> Int[np.ndarray, "k"]:
    """The nodes whose steps are the shortest beside how far they came: sum of squared steps over the variance."""
    steps = (np.diff(path, axis=0) ** 2).sum(axis=(0, 1, 3))
    variance = path.var(axis=(0, 1)).sum(axis=-1)
    mobility = np.divide(steps, variance, out=np.zeros_like(steps), where=variance > 0)
    return np.sort(np.argsort(mobility)[:count])


def loose(reference: Reference, sampled: int, nodes: Int[AnyArray, "k"]) -> Loose:
    """How the nodes stand in the whitened coordinates."""
    dimension = len(reference.centre)
    rows = dimension - 3 * sampled + 3 * jnp.asarray(nodes, int)[:, None] + jnp.arange(3)
    unit = jnp.zeros((dimension, rows.size)).at[rows.ravel(), jnp.arange(rows.size)].set(1.0)
    columns = jax.scipy.linalg.solve_triangular(reference.factor, unit, lower=False)
    columns = jnp.moveaxis(columns.reshape(dimension, len(nodes), 3), 1, 0)
    precision = jnp.einsum("kdi,kdj->kij", columns, columns)
    return Loose(jnp.asarray(nodes, int), columns, jnp.linalg.cholesky(jnp.linalg.inv(precision)))


def moved_alone(
    target: SmoothTarget,
    begin: Callable[[AnyArray], Any],
    data: Any,
    reference: Reference,
    nodes: Loose,
    key: AnyArray,
    state: Any,
) -> Any:
    """The state after a move of the nodes, each in its own density, accepted or refused together.

    Parameters
    ----------
    target : SmoothTarget
    begin : callable
        Whitened position → state, with fields `position` and `logdensity`.
    data : pytree
        Of the target, for moves of these nodes.
    reference : Reference
    nodes : Loose
    key : PRNG key
    state : state of the kernel
    """
    key_walk, key_test = jax.random.split(key)
    estimands = target.constrain_of(data, unravel(target)(reference.place(state.position)))

    def walk(key: AnyArray, which: AnyArray) -> tuple[AnyArray, AnyArray]:
        """The way of one node in its own density, and what it gained there."""
        row, spread = nodes.nodes[which], nodes.spread[which]
        here, log = estimands["u_boundary"][row], target.local_logdensity(data, estimands, which)
        wall = walls(here[None], spread[None], jnp.zeros(1, int))
        flight = reflective_leapfrog(wall, lambda u: target.clearance(data, u, row[None]))

        def density(y: AnyArray) -> AnyArray:
            return log(here + spread @ y)

        key_size, key_move = jax.random.split(key)
        size = jax.random.uniform(key_size, minval=SHORTEST, maxval=LONGEST)
        kernel, first = blackjax.mcmc.hmc.build_kernel(flight), blackjax.mcmc.hmc.init(jnp.zeros(3), density)
        last, _ = kernel(key_move, first, density, size, jnp.ones(3), STEPS)
        return spread @ last.position, last.logdensity - first.logdensity

    count = len(nodes.nodes)
    steps, gains = jax.vmap(walk)(jax.random.split(key_walk, count), jnp.arange(count))
    proposed = begin(state.position + jnp.einsum("kdi,ki->d", nodes.columns, steps))
    gain = proposed.logdensity - state.logdensity - gains.sum()
    probability = jnp.exp(jnp.minimum(jnp.nan_to_num(gain, nan=-jnp.inf), 0.0))
    accepted = jax.random.uniform(key_test) < probability
    return jax.tree.map(lambda new, old: jnp.where(accepted, new, old), proposed, state)
