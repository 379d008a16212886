"""A polynomial stand-in for a normaliser that is too costly for every step of a trajectory.

The normaliser of the elastic prior depends on the parameters only, and is a smooth function of a few coordinates. A
kernel that is reversible for the density with the stand-in makes a proposal. The proposal is accepted with the ratio of
the normaliser to the stand-in at the proposal, divided by the same ratio at the current state. This is exact (the
surrogate transition method, Liu 2001; delayed acceptance, Christen and Fox 2005). Reversible kernels in a palindromic
order are reversible together, so that one normaliser tests several transitions at once.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import combinations_with_replacement
from math import comb
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayesreg.inference.gaussian.density import mark_normaliser, normaliser_and_slope
from bayesreg.inference.gaussian.laplace import Gaussian
from bayesreg.inference.kernel import Info, joined
from bayesreg.inference.layout import dimension, unravel
from bayesreg.inference.target import Target, estimands_of, has_costly_normaliser
from bayesreg.types import AnyArray, Scalar

# The degree of the polynomial is the highest one with at most MOST_TERMS terms: the cost of the fit grows with them.
HIGHEST_DEGREE, MOST_TERMS = 4, 150
# The polynomial is fitted up to this distance from the middle, in standard deviations of the Gaussian: the posterior of
# a parameter is wider than the Gaussian (see `average_gaussian`), and skew.
REACH = 5.0
# The number of values and slopes that are computed for each coefficient.
REDUNDANCY = 2
# The number of transitions that are tested at once: one normaliser costs about as much as one transition, and the test
# seldom rejects a good stand-in.
TOGETHER = 2


class StandIn(NamedTuple):
    """A polynomial in the normaliser's smooth coordinates (a pytree) that approximates its logarithm up to a constant.

    Attributes
    ----------
    centre, unit : (k,) arrays
        The factors of the terms are z = (coordinates − centre) / unit.
    reach : scalar
        The length of z beyond which the polynomial is continued linearly.
    factors : (terms, degree) int array
        The factors of each term: 0 stands for the number 1, and i + 1 for z_i.
    coefficients : (terms,) array
    """

    centre: Float[AnyArray, "coordinates"]
    unit: Float[AnyArray, "coordinates"]
    reach: Scalar
    factors: Int[AnyArray, "terms degree"]
    coefficients: Float[AnyArray, "terms"]

    def __call__(self, coordinates: Float[AnyArray, "coordinates"]) -> Scalar:
        """Evaluate the polynomial at smooth coordinates."""
        z = (coordinates - self.centre) / self.unit
        near = z * jnp.minimum(1.0, self.reach / jnp.sqrt((z**2).sum() + 1e-12))
        value, change = jax.jvp(self._polynomial, (near,), (z - near,))
        return value + change

    def _polynomial(self, z: Float[AnyArray, "coordinates"]) -> Scalar:
        return terms_of(self.factors, z) @ self.coefficients


class Delayed(NamedTuple):
    """The state of a chain whose kernel uses the stand-in.

    Attributes
    ----------
    kernel : state of the kernel
    log_normaliser : scalar
        The logarithm of the normaliser at the state of the chain.
    """

    kernel: Any
    log_normaliser: Scalar


def terms_of(factors: Int[AnyArray, "terms degree"], z: Float[AnyArray, "entries"]) -> Float[AnyArray, "terms"]:
    """Evaluate the terms of a polynomial at z."""
    return jnp.concatenate([jnp.ones(1), z])[factors].prod(axis=1)


def smooth_coordinates(target: Target, data: Any, flat: AnyArray) -> Float[AnyArray, "coordinates"]:
    """Compute the normaliser's smooth coordinates at a flat position; the array is empty without a normaliser."""
    if target.normaliser is None:
        return jnp.zeros(0)
    return target.normaliser.smooth_coordinates(data, estimands_of(target, data, unravel(target)(flat)))


def no_stand_in(target: Target) -> StandIn:
    """Make a stand-in that is zero, for a density without a normaliser or before the fit."""
    count = len(jax.eval_shape(partial(smooth_coordinates, target), target.data, jnp.zeros(dimension(target))))
    degrees = range(HIGHEST_DEGREE, 1, -1)
    degree = next((degree for degree in degrees if comb(count + degree, degree) <= MOST_TERMS), 1)
    factors = np.array(list(combinations_with_replacement(range(count + 1), degree)))
    zeros, ones = jnp.zeros(count), jnp.ones(count)
    return StandIn(zeros, ones, jnp.ones(()), jnp.asarray(factors), jnp.zeros(len(factors)))


def make_stand_in(target: Target, gaussian: Gaussian, middle: AnyArray) -> StandIn:
    """Fit a polynomial to the normaliser and its slopes about a flat position, by least squares."""
    stand_in = no_stand_in(target)
    if not has_costly_normaliser(target) or not len(stand_in.centre):
        return stand_in
    entries, middle = np.flatnonzero(mark_normaliser(target)), np.asarray(middle)
    unit, rng = np.linalg.norm(np.asarray(gaussian.factor)[entries], axis=1), np.random.default_rng(0)
    samples = []
    # The 2 makes sure that a linear polynomial is fitted at several points, too.
    for _ in range(2 + REDUNDANCY * len(stand_in.factors) // (len(entries) + 1)):
        direction, position = rng.normal(size=len(entries)), np.array(middle)
        position[entries] += unit * REACH * rng.uniform() * direction / np.linalg.norm(direction)
        value, slope = normaliser_and_slope(target, position)
        coordinates, change = _coordinates_and_change(target, target.data, jnp.asarray(position), jnp.asarray(entries))
        samples.append((value, unit * slope[entries], np.asarray(coordinates), np.asarray(change) * unit))
    values, slopes, coordinates, changes = (np.stack(columns) for columns in zip(*samples, strict=True))
    centre, spread = coordinates.mean(axis=0), coordinates.std(axis=0)
    z, changes = (coordinates - centre) / spread, changes / spread[:, None]
    rows = [terms_of(stand_in.factors, point)[None] for point in z]
    rows += [(_slopes_of_terms(stand_in.factors, point) @ change).T for point, change in zip(z, changes, strict=True)]
    coefficients = np.linalg.lstsq(np.concatenate(rows), np.concatenate([values, slopes.ravel()]))[0]
    return stand_in._replace(
        centre=jnp.asarray(centre),
        unit=jnp.asarray(spread),
        reach=jnp.asarray(np.linalg.norm(z, axis=1).max()),
        coefficients=jnp.asarray(coefficients),
    )


_slopes_of_terms = jax.jit(jax.jacfwd(terms_of, argnums=1))


@partial(jax.jit, static_argnums=0)
def _coordinates_and_change(
    target: Target, data: Any, flat: AnyArray, entries: AnyArray
) -> tuple[Float[AnyArray, "coordinates"], Float[AnyArray, "coordinates entries"]]:
    """Compute the smooth coordinates at a flat position, and their derivatives by some of its entries."""

    def coordinates_of(some: AnyArray) -> AnyArray:
        return smooth_coordinates(target, data, flat.at[entries].set(some))

    return coordinates_of(flat[entries]), jax.jacfwd(coordinates_of)(flat[entries])


def delay_acceptance(
    step: Callable[[Any, Any, AnyArray, Any], tuple[Any, Info]],
    move: Callable[[Any, Any, AnyArray, Any], Any],
    flat_of: Callable[[Any, Any], AnyArray],
    log_normaliser: Callable[[Any, AnyArray], Scalar],
    stand_in: Callable[[Any, Any, AnyArray], Scalar],
) -> Callable[[Any, Any, AnyArray, Delayed], tuple[Delayed, Info]]:
    """Turn kernels for the density with the stand-in into one step for the density with the normaliser.

    The proposal is the result of `TOGETHER` steps with a move between each two of them.

    Parameters
    ----------
    step : callable
        (data, setup, key, state) → (state, info); reversible.
    move : callable
        (data, setup, key, state) → state; reversible.
    flat_of : callable
        (setup, state) → flat position.
    log_normaliser : callable
        (data, flat position) → the logarithm of the normaliser.
    stand_in : callable
        (data, setup, flat position) → the value of the stand-in.
    """

    def whole_step(data: Any, setup: Any, key: AnyArray, state: Delayed) -> tuple[Delayed, Info]:
        key_steps, key_moves, key_accept = jax.random.split(key, 3)

        def one_step(k: AnyArray, kernel_and_info: tuple[Any, Info]) -> tuple[Any, Info]:
            kernel, info = step(data, setup, jax.random.fold_in(key_steps, k), kernel_and_info[0])
            moved = partial(move, data, setup, jax.random.fold_in(key_moves, k))
            kernel = jax.lax.cond(k < TOGETHER - 1, moved, lambda kernel: kernel, kernel)
            return kernel, joined(kernel_and_info[1], info)

        blank = jax.eval_shape(lambda key: step(data, setup, key, state.kernel)[1], key)
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), blank)
        proposed, info = jax.lax.fori_loop(0, TOGETHER, one_step, (state.kernel, nothing))
        current_flat, proposed_flat = flat_of(setup, state.kernel), flat_of(setup, proposed)
        true = log_normaliser(data, proposed_flat)
        gain = true - state.log_normaliser - stand_in(data, setup, proposed_flat) + stand_in(data, setup, current_flat)
        probability = jnp.exp(jnp.minimum(jnp.nan_to_num(gain, nan=-jnp.inf), 0.0))
        accepted = jax.random.uniform(key_accept) < probability
        candidate = Delayed(proposed, true)
        next_state = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), candidate, state)
        return next_state, info._replace(acceptance_rate=info.acceptance_rate / TOGETHER * probability)

    return whole_step
