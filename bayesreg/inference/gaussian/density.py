"""The log density of a flat position and its slope, for the search for a mode and Laplace's approximation."""

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

# The step of finite differences of the gradient, in Normal scores and logarithms.
STEP = 1e-4


def height_and_slope(
    target: Target, data: Any, flat: Float[np.ndarray, "dimension"]
) -> tuple[float, Float[np.ndarray, "dimension"]]:
    """Compute log π and ∇log π.

    Parameters
    ----------
    target : Target
    data : pytree
        The data of the target or of a similar problem.
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
    """Map a flat position to its estimands."""
    return estimands_of(target, data, unravel(target)(flat))


def regular(curvature: Float[np.ndarray, "rows rows"]) -> Float[np.ndarray, "rows rows"]:
    """Add a small multiple of the identity, for directions that neither images nor elasticity determine."""
    return curvature + 1e-9 * np.trace(curvature) * np.eye(len(curvature))


def log_normaliser_at(target: Target, data: Any, flat: AnyArray) -> Scalar:
    """Compute the logarithm of the normaliser at a flat position, as part of the log density; zero without one."""
    if target.normaliser is None:
        return jnp.zeros(())
    return target.normaliser.log(data, estimands_of(target, data, unravel(target)(flat)))


def normaliser_and_slope(
    target: Target, flat: Float[np.ndarray, "dimension"]
) -> tuple[float, Float[np.ndarray, "dimension"]]:
    """Compute the normaliser's part of `height_and_slope`, with the target's own data."""
    value, slope = _normaliser_and_slope(target, target.data, jnp.asarray(flat))
    return float(value), np.asarray(slope)


_normaliser_and_slope = jax.jit(jax.value_and_grad(log_normaliser_at, argnums=2), static_argnums=0)


def mark_normaliser(target: Target) -> Bool[np.ndarray, "dimension"]:
    """Mark the entries of a flat position that the normaliser depends on."""
    return marked(target, *(() if target.normaliser is None else target.normaliser.depends_on))


def hessian_rows(
    target: Target, data: Any, flat: Float[np.ndarray, "dimension"], entries: Int[np.ndarray, "rows"]
) -> Float[np.ndarray, "rows dimension"]:
    """Compute rows of the Hessian of the log density, by finite differences of its gradient.

    The coordinates are Normal scores and logarithms, so that one step suits all. Exact rows would take longer to
    compile than the search takes. The normaliser, which may be costly, and the images are evaluated only for the rows
    of the entries on which they depend.
    """
    assert target.mode_search is not None
    normalised, separable = mark_normaliser(target), marked(target, *target.mode_search.separable)
    rows = []
    for entry in entries:
        step = np.zeros(len(flat))
        step[entry] = STEP
        row_data = data if normalised[entry] else without_normaliser(target, data)
        row_data = target.mode_search.quadratic_part(row_data) if separable[entry] else row_data
        ahead, behind = (height_and_slope(target, row_data, flat + way * step)[1] for way in (1, -1))
        rows.append((ahead - behind) / (2 * STEP))
    return np.array(rows)
