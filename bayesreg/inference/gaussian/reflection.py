"""Hamiltonian dynamics about a Gaussian, reflected where a sampled node meets the skull.

In coordinates ξ in which the Gaussian (Laplace's approximation) is N(0, I), the Hamiltonian splits into that of the
Gaussian, ½|ξ|² + ½|p|², whose flow is a rotation of (ξ, p), and what the posterior adds to it, −log π(ξ) − ½|ξ|²,
whose flow is a kick. Their Strang composition is exact where the posterior is Gaussian, in any dimension (Beskos et al.
2011), and so takes long steps where it is nearly so.

The support has hard walls: the signed distance d of every sampled node to the forbidden region is at least zero. A
rotation that meets a wall is reflected there: with n the gradient of that node's distance in ξ, the momentum p becomes
p − 2 (p·n) n / |n|². This keeps volume, energy and reversibility (Pakman and Paninski 2014; Mohasel Afshar and Domke
2015), so that the Metropolis test of Hamiltonian Monte Carlo stays what it is. A reflection inside a leapfrog step
would cost an error of first order in the step times the force at the wall; here only the force beyond the Gaussian's
counts.

Samplers that know no Gaussian move in straight lines instead, reflected in the same way.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from blackjax.mcmc.integrators import (
    IntegratorState,
    esh_dynamics_momentum_update_one_step,
    mclachlan_coefficients,
)
from jaxtyping import Float, Int

from bayesreg.types import AnyArray

# Looks at every wall along a stretch, secant steps to a hit, and the most reflections of one drift.
_LOOKS, _SECANTS, _MOST = 8, 4, 400


class Walls(NamedTuple):
    """The nodes that may meet the skull, in the whitened space (a pytree).

    Attributes
    ----------
    centre : (k, 3) array
        Their displacements at ξ = 0, mm.
    rows : (k, 3, d) array
        ∂u/∂ξ.
    covariance : (k, 3, k, 3) array
        rows · rowsᵀ: what a reflection at one node does to the velocities of all.
    nodes : (k,) int array
        Rows of "u_boundary".
    """

    centre: Float[AnyArray, "walls 3"]
    rows: Float[AnyArray, "walls 3 dimension"]
    covariance: Float[AnyArray, "walls 3 walls 3"]
    nodes: Int[AnyArray, "walls"]


# Signed distance, mm, of the walls' nodes at some displacements (…, k, 3).
Clearance = Callable[[AnyArray], AnyArray]
# (position, momentum, time) → (position, momentum), where no wall is met.
Motion = Callable[[AnyArray, AnyArray, AnyArray | float], tuple[AnyArray, AnyArray]]


def walls(centre: Float[AnyArray, "nodes 3"], rows: Float[AnyArray, "nodes 3 dimension"], near: AnyArray) -> Walls:
    """The walls of the nodes whose indices are in `near`."""
    rows = rows[near]
    return Walls(centre[near], rows, jnp.einsum("aid,bjd->aibj", rows, rows), jnp.asarray(near))


def reflective_rotation(walls: Walls, clearance: Clearance, precision: AnyArray | float = 1.0) -> Callable:
    """An integrator for BlackJAX: half a kick, a rotation reflected at the walls, half a kick.

    The Gaussian is N(0, I / precision) and the mass the precision, of which BlackJAX takes the inverse.
    """

    def integrator(logdensity_fn: Callable, kinetic_energy_fn: Any) -> Callable:
        density = jax.value_and_grad(logdensity_fn)

        def one_step(state: IntegratorState, step_size: AnyArray | float) -> IntegratorState:
            momentum = state.momentum + step_size / 2 * (state.logdensity_grad + precision * state.position)
            position, velocity = rotate(walls, clearance, state.position, momentum / precision, step_size)
            logdensity, gradient = density(position)
            momentum = precision * velocity + step_size / 2 * (gradient + precision * position)
            return IntegratorState(position, momentum, logdensity, gradient)

        return one_step

    return integrator


def reflective_leapfrog(walls: Walls, clearance: Clearance) -> Callable:
    """An integrator for BlackJAX: half a kick, a straight flight reflected at the walls, half a kick; unit mass."""

    def integrator(logdensity_fn: Callable, kinetic_energy_fn: Any) -> Callable:
        density = jax.value_and_grad(logdensity_fn)

        def one_step(state: IntegratorState, step_size: AnyArray | float) -> IntegratorState:
            momentum = state.momentum + step_size / 2 * state.logdensity_grad
            position, momentum = shift(walls, clearance, state.position, momentum, step_size)
            logdensity, gradient = density(position)
            return IntegratorState(position, momentum + step_size / 2 * gradient, logdensity, gradient)

        return one_step

    return integrator


def reflective_microcanonical(walls: Walls, clearance: Clearance) -> Callable:
    """BlackJAX's isokinetic integrator of McLachlan's with flights reflected at the walls.

    A reflection keeps the speed, which is one, and so the energy that the kicks are corrected for.
    """

    def integrator(logdensity_fn: Callable, inverse_mass_matrix: Any) -> Callable:
        density = jax.value_and_grad(logdensity_fn)
        kick = esh_dynamics_momentum_update_one_step(inverse_mass_matrix)
        *way, last = mclachlan_coefficients

        def one_step(state: IntegratorState, step_size: AnyArray | float) -> tuple[IntegratorState, AnyArray]:
            position, momentum, logdensity, gradient = state
            change = None
            for push, flight in zip(way[::2], way[1::2], strict=True):
                momentum, _, change = kick(momentum, gradient, step_size, push, change)
                position, momentum = shift(walls, clearance, position, momentum, flight * step_size)
                logdensity, gradient = density(position)
            momentum, _, change = kick(momentum, gradient, step_size, last, change)
            return IntegratorState(position, momentum, logdensity, gradient), change

        return one_step

    return integrator


class _Flight(NamedTuple):
    position: AnyArray
    momentum: AnyArray
    u: AnyArray
    velocity: AnyArray
    left: AnyArray
    reflections: AnyArray


def rotate(
    walls: Walls, clearance: Clearance, position: AnyArray, momentum: AnyArray, time: AnyArray | float
) -> tuple[AnyArray, AnyArray]:
    """Position and momentum after the Gaussian's own motion for some time (either sign), reflected at the walls.

    A flight that is not over after many reflections ends outside the support of any density: at NaN.
    """
    return _reflect(_turn, walls, clearance, position, momentum, time)


def shift(
    walls: Walls, clearance: Clearance, position: AnyArray, momentum: AnyArray, time: AnyArray | float
) -> tuple[AnyArray, AnyArray]:
    """Move in a straight line, and reflect at the walls as `rotate` does."""
    return _reflect(_shift, walls, clearance, position, momentum, time)


def _reflect(
    motion: Motion,
    walls: Walls,
    clearance: Clearance,
    position: AnyArray,
    momentum: AnyArray,
    time: AnyArray | float,
) -> tuple[AnyArray, AnyArray]:
    if not len(walls.nodes):
        return motion(position, momentum, time)
    # Backward in time is forward with the momentum reversed.
    sign = jnp.sign(time)
    first = _Flight(
        position=position,
        momentum=sign * momentum,
        u=walls.rows @ position,
        velocity=sign * (walls.rows @ momentum),
        left=jnp.abs(time),
        reflections=jnp.zeros((), int),
    )

    def going(flight: _Flight) -> AnyArray:
        return (flight.left > 0) & (flight.reflections < _MOST)

    def stretch(flight: _Flight) -> _Flight:
        hit, node = _first_hit(motion, walls, clearance, flight)
        time = jnp.minimum(hit, flight.left)
        position, momentum = motion(flight.position, flight.momentum, time)
        u, velocity = motion(flight.u, flight.velocity, time)
        place = walls.centre + u
        normal = jax.grad(lambda at: clearance(place.at[node].set(at))[node])(place[node])
        speed = normal @ velocity[node]
        factor = 2 * speed / (normal @ walls.covariance[node, :, node] @ normal)
        # A node that already leaves the wall it touches is left alone.
        factor = jnp.where((hit < flight.left) & (speed < 0), factor, 0.0)
        return _Flight(
            position=position,
            momentum=momentum - factor * (normal @ walls.rows[node]),
            u=u,
            velocity=velocity - factor * jnp.einsum("i,ibj->bj", normal, walls.covariance[node]),
            left=flight.left - time,
            reflections=flight.reflections + 1,
        )

    last = jax.lax.while_loop(going, stretch, first)
    return jnp.where(last.left > 0, jnp.nan, last.position), sign * last.momentum


def _turn(position: AnyArray, momentum: AnyArray, angle: AnyArray | float) -> tuple[AnyArray, AnyArray]:
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    return cosine * position + sine * momentum, cosine * momentum - sine * position


def _shift(position: AnyArray, momentum: AnyArray, time: AnyArray | float) -> tuple[AnyArray, AnyArray]:
    return position + time * momentum, momentum


def _first_hit(motion: Motion, walls: Walls, clearance: Clearance, flight: _Flight) -> tuple[AnyArray, AnyArray]:
    """Time and row of the first node to meet its wall; infinite where none does in the time left."""

    def clear(times: AnyArray) -> AnyArray:
        return clearance(walls.centre + motion(flight.u, flight.velocity, times[..., None])[0])

    times = jnp.linspace(0, 1, _LOOKS + 1)[:, None] * flight.left * jnp.ones(len(walls.nodes))
    found = clear(times)
    through = found[1:] < 0
    step = jnp.argmax(through, axis=0)
    rows = jnp.arange(through.shape[1])
    low, high = times[step, rows], times[step + 1, rows]
    above, below = jnp.maximum(found[step, rows], 0.0), found[step + 1, rows]

    def secant(_: AnyArray | int, bracket: tuple[AnyArray, ...]) -> tuple[AnyArray, ...]:
        low, high, above, below = bracket
        middle = low + (high - low) * above / jnp.maximum(above - below, 1e-300)
        value = clear(middle)
        inside = value >= 0
        return (
            jnp.where(inside, middle, low), jnp.where(inside, high, middle),
            jnp.where(inside, value, above), jnp.where(inside, below, value),
        )  # fmt: skip

    low, high, above, below = jax.lax.fori_loop(0, _SECANTS, secant, (low, high, above, below))
    middle = low + (high - low) * above / jnp.maximum(above - below, 1e-300)
    hit = jnp.where(through.any(axis=0), middle, jnp.inf)
    node = jnp.argmin(hit)
    return hit[node], node
