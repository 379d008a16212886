"""A polynomial stand-in for a normaliser that is too costly for every step of a trajectory.

The normaliser of the elastic prior depends on the parameters only, and is a smooth function of a few coordinates. The
draws do not depend on the stand-in (see `delayed_acceptance`).
"""

from __future__ import annotations

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
from bayesreg.inference.layout import dimension, unravel
from bayesreg.inference.target import Target, estimands_of
from bayesreg.types import AnyArray, Scalar

# The degree of the polynomial is the highest one with at most MOST_TERMS terms: the cost of the fit grows with them.
HIGHEST_DEGREE, MOST_TERMS = 8, 150
# The polynomial is fitted up to this distance from the middle, in standard deviations of the Gaussian: the posterior of
# a parameter is wider than the Gaussian (see `average_gaussian`), and skew.
REACH = 5.0
# The number of values and slopes that are computed for each coefficient.
REDUNDANCY = 2


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
    if target.surrogate is None or not len(stand_in.centre):
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
