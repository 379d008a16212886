"""A normaliser too costly for every step of a trajectory, which sees a quadratic instead: the test sees both.

The normaliser of the elastic prior depends on the parameters alone, a few coordinates in which it is smooth. A kernel
that is reversible for the density with a stand-in proposes; its proposal is accepted with the ratio of the normaliser
to the stand-in, there over here. That is exact (the surrogate transition method, Liu 2001; delayed acceptance,
Christen and Fox 2005), and costs one normaliser a transition.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayesreg.inference.gaussian.laplace import Gaussian
from bayesreg.inference.layout import others, unravel
from bayesreg.inference.target import Target, estimands_of, has_costly_normaliser
from bayesreg.types import AnyArray, Scalar

# With more parameters than this the stand-in is linear: its curvature would cost two gradients for each of them.
MOST_CURVED = 20


class StandIn(NamedTuple):
    """The normaliser to second order about the middle of the chains, less its value there (a pytree).

    Attributes
    ----------
    entries : (k,) int array
        The entries of a flat position that are no displacements.
    slope : (k,) array
    curvature : (k, k) array
    """

    entries: Int[AnyArray, "parameters"]
    slope: Float[AnyArray, "parameters"]
    curvature: Float[AnyArray, "parameters parameters"]

    def __call__(self, away: Float[AnyArray, "dimension"]) -> Scalar:
        """The value at a flat position, given less the middle."""
        x = away[self.entries]
        return self.slope @ x + 0.5 * (x @ self.curvature @ x)


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


def no_stand_in(target: Target) -> StandIn:
    """The stand-in of a density without a normaliser, or before it is found."""
    entries = others(target)
    return StandIn(jnp.asarray(entries), jnp.zeros(len(entries)), jnp.zeros((len(entries), len(entries))))


def make_stand_in(target: Target, gaussian: Gaussian, middle: AnyArray) -> StandIn:
    """The normaliser's slope at a flat position, and its curvature by differences over one sd of the Gaussian."""
    found, entries = no_stand_in(target), others(target)
    count = len(entries)
    if not has_costly_normaliser(target) or not count:
        return found
    slope_at = partial(_slope, target, target.data)
    found = found._replace(slope=slope_at(middle)[entries])
    if count > MOST_CURVED:
        return found
    sd = np.minimum(np.linalg.norm(np.asarray(gaussian.factor)[entries], axis=1), 1.0)
    rows = []
    for index, h in zip(entries, sd, strict=True):
        step = jnp.zeros_like(middle).at[index].set(h)
        rows.append((slope_at(middle + step) - slope_at(middle - step))[entries] / (2 * h))
    curvature = jnp.stack(rows)
    return found._replace(curvature=(curvature + curvature.T) / 2)


def log_normaliser_at(target: Target, data: Any, flat: AnyArray) -> Scalar:
    """The true one, at a flat position."""
    assert target.normaliser is not None
    return target.normaliser.log(data, estimands_of(target, data, unravel(target)(flat)))


_slope = jax.jit(jax.grad(log_normaliser_at, argnums=2), static_argnums=0)


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
