"""Hamiltonian dynamics about a Gaussian, for BlackJAX.

In coordinates ξ in which the Gaussian is N(0, I), the Hamiltonian has two parts. The part of the Gaussian is
½|ξ|² + ½|p|², and its flow is a rotation of (ξ, p). The remainder is −log π(ξ) − ½|ξ|², and its flow changes only p, a
kick. The Strang composition of the two flows is exact for a Gaussian posterior, in any dimension (Beskos et al. 2011),
and so allows long steps for a posterior that is nearly Gaussian.

To first order in the remainder, the energy error of a trajectory is the error of a quadrature of the remainder's power
along the rotation, with the kicks as its nodes (McLachlan 1995; Laskar and Robutel 2001). Equal steps are the
trapezoidal rule. Gregory's end correction of this rule costs nothing, and makes the error one order smaller.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from blackjax.mcmc.integrators import IntegratorState

from bayesreg.types import AnyArray, Scalar

# Gregory's correction takes this share of a whole kick from the first and the last kick of a trajectory, and gives it
# to the kick next to each of them.
GREGORY = 1 / 12


def rotation(precision: AnyArray | float = 1.0) -> Callable:
    """Make an integrator for BlackJAX: half a kick, a rotation about the Gaussian N(0, I / precision), half a kick.

    The mass is the precision; BlackJAX takes the inverse of the mass.
    """

    def integrator(logdensity_fn: Callable, kinetic_energy_fn: Any) -> Callable:
        density = jax.value_and_grad(logdensity_fn)

        def one_step(state: IntegratorState, step_size: AnyArray | float) -> IntegratorState:
            return _turn(density, precision, state, step_size, 0.5, 0.5)

        return one_step

    return integrator


def corrected_rotation(steps: AnyArray) -> Callable:
    """Make an integrator for BlackJAX whose step is a whole trajectory about N(0, I), with Gregory's correction.

    Parameters
    ----------
    steps : scalar integer
        The number of rotations by the step size.
    """

    def integrator(logdensity_fn: Callable, kinetic_energy_fn: Any) -> Callable:
        density = jax.value_and_grad(logdensity_fn)
        # A single step has no inner kick.
        correction = jnp.where(steps > 1, GREGORY, 0.0)

        def trajectory(state: IntegratorState, step_size: AnyArray | float) -> IntegratorState:
            def one_step(k: AnyArray, state: IntegratorState) -> IntegratorState:
                shift = correction * ((k == 0).astype(float) - (k == steps - 1))
                return _turn(density, 1.0, state, step_size, 0.5 - shift, 0.5 + shift)

            return jax.lax.fori_loop(0, steps, one_step, state)

        return trajectory

    return integrator


def _turn(
    density: Callable[[AnyArray], tuple[Scalar, AnyArray]],
    precision: AnyArray | float,
    state: IntegratorState,
    step_size: AnyArray | float,
    before: AnyArray | float,
    after: AnyArray | float,
) -> IntegratorState:
    """Kick, rotate by the step size, and kick again; `before` and `after` are shares of a whole kick."""

    def excess(gradient: AnyArray, position: AnyArray) -> AnyArray:
        """Compute the force of the density less that of the Gaussian."""
        return gradient + precision * position

    velocity = (state.momentum + before * step_size * excess(state.logdensity_grad, state.position)) / precision
    cosine, sine = jnp.cos(step_size), jnp.sin(step_size)
    position = cosine * state.position + sine * velocity
    momentum = precision * (cosine * velocity - sine * state.position)
    logdensity, gradient = density(position)
    momentum += after * step_size * excess(gradient, position)
    return IntegratorState(position, momentum, logdensity, gradient)
