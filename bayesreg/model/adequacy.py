"""Does the noise model hold? Residuals in units of the noise that T_s stands for, and discrepancies of them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayesreg.model.blocks import Values
from bayesreg.model.image_pair import ImagePair
from bayesreg.model.posterior import Posterior
from bayesreg.model.state import state_of
from bayesreg.model.terms.landmarks import Landmarks
from bayesreg.model.terms.term import Outside, Standardised
from bayesreg.types import AnyArray

KINDS = {ImagePair: "images", Landmarks: "landmarks"}
DISCREPANCIES = ("sd", "greatest", "neighbours")


def describe_observations(posterior: Posterior, values: Values) -> dict[str, dict[str, Any]]:
    """How every observation fits at some values.

    Returns
    -------
    dict
        By the name of the observation its "kind" ("images", "landmarks" or "own"), the "log" of its term, and where the
        term knows its residuals their number, "values", and the root of the mean of their squares in units of their
        variance, "residual_rms".
    """
    filled = posterior.fill(values)
    state = state_of(posterior.data.body, posterior.data.blocks, filled)
    found = {}
    for name, given in posterior.observations.items():
        term = posterior.data.terms[name]
        # What stands for an observation from outside knows its log alone.
        shown = given if isinstance(term, Outside) else term
        found[name] = {"kind": KINDS.get(type(given), "own"), "log": float(term.log(state))}
        if isinstance(shown, Standardised):
            z = np.asarray(shown.standardised_residual(state))
            found[name] |= {"values": z.size, "residual_rms": float(np.sqrt(np.mean(z**2)))}
    return found


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
    one, other = means[neighbours].T
    # A cell without points (quadrature by voxels) has no say.
    both = (points[neighbours] > 0).all(axis=1)
    correlation = (both * one * other).sum() / (both * (one**2 + other**2) / 2).sum()
    return jnp.stack([jnp.sqrt(jnp.mean(z**2)), jnp.abs(z).max(), correlation])
