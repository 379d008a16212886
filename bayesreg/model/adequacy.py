"""Does the noise model hold? Residuals in units of the noise that T_s stands for, and discrepancies of them."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from bayesreg.model.posterior import Posterior
from bayesreg.types import AnyArray, Scalar

DISCREPANCIES = ("sd", "greatest", "neighbours")


def standardised_residual(
    posterior: Posterior, u: Float[AnyArray, "nodes 3"], t_similarity: Scalar | float
) -> Float[AnyArray, "points"]:
    """(f(x_q) − m(x_q + u(x_q))) / √(T_s / 2w_q): where the model holds independent numbers, standard
    Normal or of Student's t."""
    return posterior.residuals(u) * jnp.sqrt(2 * posterior.images.quadrature.weights / t_similarity)


def t_similarity_of(posterior: Posterior, draw: Mapping[str, AnyArray]) -> Scalar | float:
    """T_s of a draw: its own where it is sampled, else that of the model."""
    return draw.get("t_similarity", posterior.data.blocks["t_similarity"].reference())


def discrepancies(
    z: Float[AnyArray, "points"], cells: Int[AnyArray, "points"], neighbours: Int[AnyArray, "pairs 2"], count: int
) -> Float[AnyArray, "3"]:
    """What would show in standardised residuals if the model were wrong, in the order of `DISCREPANCIES`.

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
    one, other = means[neighbours].T
    # A cell without points (quadrature by voxels) has no say.
    both = (points[neighbours] > 0).all(axis=1)
    correlation = (both * one * other).sum() / (both * (one**2 + other**2) / 2).sum()
    return jnp.stack([jnp.sqrt(jnp.mean(z**2)), jnp.abs(z).max(), correlation])
