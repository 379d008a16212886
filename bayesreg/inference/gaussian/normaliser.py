"""A normaliser too costly for every step of a trajectory, which sees a polynomial instead: the test sees both.

The normaliser of the elastic prior depends on the parameters alone, a few coordinates in which it is smooth. A kernel
that is reversible for the density with a stand-in proposes; its proposal is accepted with the ratio of the normaliser
to the stand-in, there over here. That is exact (the surrogate transition method, Liu 2001; delayed acceptance,
Christen and Fox 2005), and costs one normaliser a transition.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations_with_replacement
from math import comb
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayesreg.inference.gaussian.density import mark_normaliser, normaliser_and_slope
from bayesreg.inference.gaussian.laplace import Gaussian
from bayesreg.inference.target import Target, has_costly_normaliser
from bayesreg.types import AnyArray, Scalar

# The degree of the polynomial is as high as its number of terms allows, which cost as many numbers to find.
HIGHEST_DEGREE, MOST_TERMS = 4, 150
# The polynomial is fitted so far about the middle, in standard deviations of the Gaussian, and goes on linearly: the
# posterior of a parameter is wider than the Gaussian (see `average_gaussian`), and skew.
REACH = 5.0
# So many values and slopes are found for each coefficient.
REDUNDANCY = 2


class StandIn(NamedTuple):
    """A polynomial about the middle of the chains (a pytree), the normaliser up to a constant.

    Attributes
    ----------
    entries : (k,) int array
        The entries of a flat position that the normaliser depends on.
    unit : (k,) array
        Their standard deviations in the Gaussian, in units of which they are factors of the terms.
    factors : (terms, degree) int array
        The factors of each term: 0 is one, and i + 1 is entry i.
    coefficients : (terms,) array
    """

    entries: Int[AnyArray, "entries"]
    unit: Float[AnyArray, "entries"]
    factors: Int[AnyArray, "terms degree"]
    coefficients: Float[AnyArray, "terms"]

    def __call__(self, away: Float[AnyArray, "dimension"]) -> Scalar:
        """The value at a flat position, given less the middle."""
        z = away[self.entries] / self.unit
        near = z * jnp.minimum(1.0, REACH / jnp.sqrt((z**2).sum() + 1e-12))
        value, change = jax.jvp(self._polynomial, (near,), (z - near,))
        return value + change

    def _polynomial(self, z: Float[AnyArray, "entries"]) -> Scalar:
        return terms_of(self.factors, z) @ self.coefficients


class Delayed(NamedTuple):
    """A chain whose kernel sees the stand-in.

    Attributes
    ----------
    kernel : state of the kernel
    log_normaliser : scalar
        The true one, where the chain stands.
    """

    kernel: Any
    log_normaliser: Scalar


def terms_of(factors: Int[AnyArray, "terms degree"], z: Float[AnyArray, "entries"]) -> Float[AnyArray, "terms"]:
    """The terms of a polynomial at z."""
    return jnp.concatenate([jnp.ones(1), z])[factors].prod(axis=1)


def no_stand_in(target: Target) -> StandIn:
    """The stand-in of a density without a normaliser, or before it is found: zero."""
    entries = np.flatnonzero(mark_normaliser(target))
    count = len(entries)
    degrees = range(HIGHEST_DEGREE, 1, -1)
    degree = next((degree for degree in degrees if comb(count + degree, degree) <= MOST_TERMS), 1)
    factors = np.array(list(combinations_with_replacement(range(count + 1), degree)))
    return StandIn(jnp.asarray(entries), jnp.ones(count), jnp.asarray(factors), jnp.zeros(len(factors)))


def make_stand_in(target: Target, gaussian: Gaussian, middle: AnyArray) -> StandIn:
    """The polynomial that fits the normaliser and its slopes about a flat position best, by least squares."""
    found = no_stand_in(target)
    entries, count = np.asarray(found.entries), len(found.entries)
    if not has_costly_normaliser(target) or not count:
        return found
    unit = np.linalg.norm(np.asarray(gaussian.factor)[entries], axis=1)
    terms, degree = found.factors.shape
    if degree == 1:
        slope = normaliser_and_slope(target, np.asarray(middle))[1][entries]
        return found._replace(unit=jnp.asarray(unit), coefficients=jnp.asarray(np.append(0.0, unit * slope)))
    rng = np.random.default_rng(0)
    rows, values = [], []
    for _ in range(-(-REDUNDANCY * terms // (count + 1))):
        direction = rng.normal(size=count)
        z = REACH * rng.uniform() * direction / np.linalg.norm(direction)
        there = np.array(middle)
        there[entries] += unit * z
        value, slope = normaliser_and_slope(target, there)
        rows += [terms_of(found.factors, z)[None], _slopes_of_terms(found.factors, z).T]
        values += [np.append(value, unit * slope[entries])]
    coefficients = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values))[0]
    return found._replace(unit=jnp.asarray(unit), coefficients=jnp.asarray(coefficients))


_slopes_of_terms = jax.jit(jax.jacfwd(terms_of, argnums=1))


def delay_acceptance(
    step: Callable[[Any, Any, AnyArray, Any], tuple[Any, Any]],
    flat_of: Callable[[Any, Any], AnyArray],
    log_normaliser: Callable[[Any, AnyArray], Scalar],
) -> Callable[[Any, Any, AnyArray, Delayed], tuple[Delayed, Any]]:
    """A step for the density with the stand-in made one for the density with the normaliser.

    Parameters
    ----------
    step : callable
        (data, setup, key, state) → (state, info); reversible, and setup with fields `middle` and `make_stand_in`.
    flat_of : callable
        (setup, state) → flat position.
    log_normaliser : callable
        (data, flat position) → the true one.
    """

    def whole_step(data: Any, setup: Any, key: AnyArray, state: Delayed) -> tuple[Delayed, Any]:
        key_step, key_accept = jax.random.split(key)
        proposed, info = step(data, setup, key_step, state.kernel)
        here, there = flat_of(setup, state.kernel), flat_of(setup, proposed)
        true = log_normaliser(data, there)
        middle, approximate = setup.middle, setup.stand_in
        gain = true - state.log_normaliser - approximate(there - middle) + approximate(here - middle)
        probability = jnp.exp(jnp.minimum(jnp.nan_to_num(gain, nan=-jnp.inf), 0.0))
        accepted = jax.random.uniform(key_accept) < probability
        moved = Delayed(proposed, true)
        kept = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), moved, state)
        return kept, info._replace(acceptance_rate=info.acceptance_rate * probability)

    return whole_step
