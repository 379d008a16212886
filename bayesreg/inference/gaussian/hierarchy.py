"""Scales of what has many components, where a mode would mislead.

With a field s = sd · B z, z ~ N(0, I), the joint mode of (z, log sd) lies at a great sd and small z: it ignores how
much less room z has the greater sd is. The Gaussian is better placed where the evidence of sd has its maximum, by
MacKay's fixed point (1992): |z|² = γ, the number of components that the data determine.

T_r is such a scale of u_B, whose prior's curvature P falls as 1 / T_r: the joint mode lies next to T_r = 0, where
nothing moves. With u_B integrated out by Laplace's approximation, C its covariance, ∂ log p / ∂ log T_r gains
½ tr(C P), which makes 2 E_r / T_r = γ where the prior of T_r says nothing, and its curvature ½ tr(C P − (C P)²). At a
typical draw of u_B, where E_r / T_r is greater by ½ tr(C P) than at the mode, the curvature is greater by as much.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from bayesreg.inference.layout import Placed, marked

SCALE, COMPONENTS, TEMPERATURE = "field_sd", "field", "t_elastic"
_MOST = 1.0


def is_scale(target: Placed) -> Float[np.ndarray, "dimension"]:
    """One at the entries of a flat position that hold log sd or log T_r, zero elsewhere."""
    return marked(target, SCALE, TEMPERATURE).astype(float)


def is_temperature(target: Placed) -> Float[np.ndarray, "dimension"]:
    """One at the entry of a flat position that holds log T_r, zero elsewhere."""
    return marked(target, TEMPERATURE).astype(float)


def balance_field(
    target: Placed,
    flat: Float[np.ndarray, "dimension"],
    factor: Callable[[], Float[np.ndarray, "dimension dimension"]],
) -> Float[np.ndarray, "dimension"]:
    """A flat position with sd nearer to the maximum of its evidence and the field s as it was.

    Parameters
    ----------
    target : Placed
    flat : (d,) array
        A mode given sd.
    factor : callable
        () → F, where F Fᵀ is the covariance there; not asked for where there is no field.
    """
    scale = np.flatnonzero(marked(target, SCALE))
    if not len(scale):
        return flat
    components = np.flatnonzero(marked(target, COMPONENTS))
    rows = np.asarray(factor())[np.concatenate([components, scale])]
    covariance = rows @ rows.T
    # Given sd.
    variances = np.diag(covariance)[:-1] - covariance[:-1, -1] ** 2 / covariance[-1, -1]
    determined = max(float((1 - variances).sum()), 1.0)
    z = flat[components]
    # The one: log sd has the density of sd times sd, and that of a half-normal sd is flat near zero.
    change = float(np.clip(0.5 * np.log((z @ z + 1) / determined), -_MOST, _MOST))
    moved = np.array(flat)
    moved[components], moved[scale] = z * np.exp(-change), flat[scale] + change
    return moved


def balance_temperature(
    target: Placed,
    flat: Float[np.ndarray, "dimension"],
    slope: float,
    curvature: float,
    shares: Float[np.ndarray, "rows rows"],
) -> Float[np.ndarray, "dimension"]:
    """A flat position with T_r nearer to the maximum of its evidence.

    Parameters
    ----------
    target : Placed
    flat : (d,) array
        A mode given T_r.
    slope, curvature : float
        Slope of the log density and curvature of minus it in log T_r, there.
    shares : (r, r) array
        C P: in its eigenvectors, how much of what holds a component of u_B is the prior's.
    """
    moved = np.array(flat)
    change = (slope + np.trace(shares) / 2) / (curvature + evidence_curvature(shares))
    moved[is_temperature(target) > 0] += np.clip(change, -_MOST, _MOST)
    return moved


def evidence_curvature(shares: Float[np.ndarray, "rows rows"]) -> float:
    """By how much the evidence of log T_r is more curved than the log density: ½ tr(C P − (C P)²)."""
    return float(np.trace(shares) - (shares * shares.T).sum()) / 2
