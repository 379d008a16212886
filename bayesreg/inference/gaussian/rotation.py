"""Hamiltonian dynamics about a Gaussian, for BlackJAX.

In coordinates ξ in which the Gaussian is N(0, I), the Hamiltonian has two parts. The part of the Gaussian is
½|ξ|² + ½|p|², and its flow is a rotation of (ξ, p). The remainder is −log π(ξ) − ½|ξ|², and its flow changes only p, a
kick. The Strang composition of the two flows is exact for a Gaussian posterior, in any dimension (Beskos et al. 2011),
and so allows long steps for a posterior that is nearly Gaussian.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from blackjax.mcmc.integrators import IntegratorState

from bayesreg.types import AnyArray


def rotation(precision: AnyArray | float = 1.0) -> Callable:
    """Make an integrator for BlackJAX: half a kick, a rotation about the Gaussian N(0, I / precision), half a kick.

    The mass is the precision; BlackJAX takes the inverse of the mass.
    """

    def integrator(logdensity_fn: Callable, kinetic_energy_fn: Any) -> Callable:
        density = jax.value_and_grad(logdensity_fn)

        def one_step(state: IntegratorState, step_size: AnyArray | float) -> IntegratorState:
            velocity = (state.momentum + step_size / 2 * _excess(state.logdensity_grad, state.position)) / precision
            cosine, sine = jnp.cos(step_size), jnp.sin(step_size)
            position = cosine * state.position + sine * velocity
            momentum = precision * (cosine * velocity - sine * state.position)
            logdensity, gradient = density(position)
            momentum += step_size / 2 * _excess(gradient, position)
            return IntegratorState(position, momentum, logdensity, gradient)

        def _excess(gradient: AnyArray, position: AnyArray) -> AnyArray:
            """Compute the force of the density less that of the Gaussian."""
            return gradient + precision * position

        return one_step

    return integrator
