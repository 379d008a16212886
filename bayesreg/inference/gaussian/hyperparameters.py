"""Moves of hyperparameters with the displacements fixed, besides the trajectories.

Data may say only that a hyperparameter, such as the scale of surface loads, is small. In its coordinate the posterior
then has a long flat tail, which a trajectory with the step of the other coordinates crosses as a random walk. With the
displacements fixed, the density of such a hyperparameter does not need the images, so that several wide proposals cost
less than one gradient. They are steps of Metropolis, and leave the posterior unchanged.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from bayesreg.inference.gaussian.whitened import Setup, surrogate_density
from bayesreg.inference.layout import marked
from bayesreg.inference.target import Target
from bayesreg.types import AnyArray

# The number of proposals after each step of the sampler. Their standard deviations, in logarithms and Normal scores,
# are spread evenly on a logarithmic axis: the posterior of a hyperparameter may be narrow or have a long tail.
PROPOSALS, NARROWEST, WIDEST = 32, 0.05, 5.0


def mark_separable(target: Target) -> Bool[np.ndarray, "dimension"]:
    """Mark the entries of a flat position that are moved with the displacements fixed."""
    return marked(target, *(() if target.mode_search is None else target.mode_search.separable))


def move_hyperparameters(target: Target, data: Any, setup: Setup, key: AnyArray, state: Any) -> Any:
    """Propose other hyperparameters with the displacements fixed.

    Parameters
    ----------
    target : Target
    data : pytree
        As in `surrogate_density`.
    setup : Setup
    key : PRNG key
    state : blackjax HMCState
        Its log density and gradient are updated without another evaluation of the whole density.
    """
    entries = np.flatnonzero(mark_separable(target))
    if not len(entries):
        return state
    assert target.mode_search is not None
    density = partial(surrogate_density, target, target.mode_search.quadratic_part(data), setup)
    flat = setup.gaussian.place(state.position)

    def propose(carry: tuple[AnyArray, AnyArray], key: AnyArray) -> tuple[tuple[AnyArray, AnyArray], None]:
        flat, height = carry
        key_entry, key_width, key_step, key_accept = jax.random.split(key, 4)
        width = NARROWEST * (WIDEST / NARROWEST) ** jax.random.uniform(key_width)
        entry = jax.random.choice(key_entry, jnp.asarray(entries))
        candidate = flat.at[entry].add(width * jax.random.normal(key_step))
        candidate_height = density(candidate)
        accepted = jnp.log(jax.random.uniform(key_accept)) < candidate_height - height
        return (jnp.where(accepted, candidate, flat), jnp.where(accepted, candidate_height, height)), None

    (moved, _), _ = jax.lax.scan(propose, (flat, density(flat)), jax.random.split(key, PROPOSALS))
    # A loop over both places compiles the gradient once.
    heights, gradients = jax.lax.map(jax.value_and_grad(density), jnp.stack([flat, moved]))
    position = state.position + setup.gaussian.whiten(moved) - setup.gaussian.whiten(flat)
    before, slope_before = jax.value_and_grad(setup.gaussian.log_jacobian)(state.position)
    after, slope_after = jax.value_and_grad(setup.gaussian.log_jacobian)(position)
    # The images' part of the slope in the flat position stays as it is.
    (slope,) = jax.vjp(setup.gaussian.whiten, flat)[1](state.logdensity_grad - slope_before)
    (slope,) = jax.vjp(setup.gaussian.place, position)[1](slope + gradients[1] - gradients[0])
    return state._replace(
        position=position,
        logdensity=state.logdensity + heights[1] - heights[0] + after - before,
        logdensity_grad=slope + slope_after,
    )
