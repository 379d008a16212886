"""The log density of a flat position and its slope, as the search for a mode and Laplace's approximation see them."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from bayesreg.inference.layout import marked, unravel
from bayesreg.inference.target import Target, estimands_of, logdensity, without_normaliser
from bayesreg.types import AnyArray, Scalar

# Step of differences between gradients, in Normal scores and logarithms.
STEP = 1e-4


def height_and_slope(
    target: Target, data: Any, flat: Float[np.ndarray, "dimension"]
) -> tuple[float, Float[np.ndarray, "dimension"]]:
    """log π and ∇log π.

    Parameters
    ----------
    target : Target
    data : pytree
        The target's, or that of a similar problem.
    flat : (d,) array
        Flat position.
    """
    height, slope = _height_and_slope(target, data, jnp.asarray(flat))
    return float(height), np.asarray(slope)


@partial(jax.jit, static_argnums=0)
def _height_and_slope(target: Target, data: Any, flat: AnyArray) -> tuple[AnyArray, AnyArray]:
    return jax.value_and_grad(lambda x: logdensity(target, data, unravel(target)(x)))(flat)


@partial(jax.jit, static_argnums=0)
def estimands_at(target: Target, data: Any, flat: AnyArray) -> Any:
    """The estimands at a flat position."""
    return estimands_of(target, data, unravel(target)(flat))


def regular(curvature: Float[np.ndarray, "rows rows"]) -> Float[np.ndarray, "rows rows"]:
    """A trace of the identity keeps directions finite that neither images nor elasticity see."""
    return curvature + 1e-9 * np.trace(curvature) * np.eye(len(curvature))


def log_normaliser_at(target: Target, data: Any, flat: AnyArray) -> Scalar:
    """The logarithm of the normaliser at a flat position, as part of the log density; zero where there is none."""
    if target.normaliser is None:
        return jnp.zeros(())
    return target.normaliser.log(data, estimands_of(target, data, unravel(target)(flat)))


def normaliser_and_slope(
    target: Target, flat: Float[np.ndarray, "dimension"]
) -> tuple[float, Float[np.ndarray, "dimension"]]:
    """The part of the normaliser in `height_and_slope` of the target's own data."""
    value, slope = _normaliser_and_slope(target, target.data, jnp.asarray(flat))
    return float(value), np.asarray(slope)


_normaliser_and_slope = jax.jit(jax.value_and_grad(log_normaliser_at, argnums=2), static_argnums=0)


def mark_normaliser(target: Target) -> Bool[np.ndarray, "dimension"]:
    """Mark the entries of a flat position that the normaliser depends on."""
    return marked(target, *(() if target.normaliser is None else target.normaliser.depends_on))


def hessian_rows(
    target: Target, data: Any, flat: Float[np.ndarray, "dimension"], entries: Int[np.ndarray, "rows"]
) -> Float[np.ndarray, "rows dimension"]:
    """Rows of the Hessian of the log density, by differences of its gradient.

    The coordinates are Normal scores and logarithms, so that one step suits all. Exact rows would cost more to compile
    than the search. The normaliser, which may be costly, has a part in the rows of what it depends on alone.
    """
    rows, plain, normalised = [], without_normaliser(target, data), mark_normaliser(target)
    for entry in entries:
        step = np.zeros(len(flat))
        step[entry] = STEP
        seen = data if normalised[entry] else plain
        ahead, behind = (height_and_slope(target, seen, flat + way * step)[1] for way in (1, -1))
        rows.append((ahead - behind) / (2 * STEP))
    return np.array(rows)
