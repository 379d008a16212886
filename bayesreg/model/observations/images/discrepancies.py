"""Discrepancies of residuals, in units of the noise sd that T_s implies, which test the noise model."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from bayesreg.types import AnyArray

DISCREPANCIES = ("sd", "greatest", "neighbours")


def discrepancies(
    z: Float[AnyArray, "points"], cells: Int[AnyArray, "points"], neighbours: Int[AnyArray, "pairs 2"], count: int
) -> Float[AnyArray, "3"]:
    """Compute figures of standardised residuals that would differ if the model were wrong (see `DISCREPANCIES`).

    Parameters
    ----------
    z : (q,) array
        Standardised residuals.
    cells : (q,) int array
        The cell of each.
    neighbours : (k, 2) int array
        Cells that share a face.
    count : int
        Number of cells.

    Returns
    -------
    (3,) array
        "sd": √(mean z²). "greatest": max |z|. "neighbours": autocorrelation at a lag of one cell: of the sums of z
        over cells, divided by the root of their number, between cells that share a face.
    """
    points = jax.ops.segment_sum(jnp.ones_like(z), cells, count)
    means = jax.ops.segment_sum(z, cells, count) / jnp.sqrt(jnp.maximum(points, 1))
    mean, neighbour_mean = means[neighbours].T
    # A cell without points (quadrature by voxels) is left out.
    both = (points[neighbours] > 0).all(axis=1)
    correlation = (both * mean * neighbour_mean).sum() / (both * (mean**2 + neighbour_mean**2) / 2).sum()
    return jnp.stack([jnp.sqrt(jnp.mean(z**2)), jnp.abs(z).max(), correlation])
