"""Scales of what has many components, where a mode would mislead.

With a field s = sd · B z, z ~ N(0, I), the joint mode of (z, log sd) lies at a great sd and small z: it ignores how
much less room z has the greater sd is. The Gaussian is better placed where the evidence of sd has its maximum, by
MacKay's fixed point (1992): |z|² = γ, the number of components that the data determine.

T_r is such a scale of u_B, whose prior's curvature P falls as 1 / T_r: the joint mode lies next to T_r = 0, where
nothing moves. So is the sd of landmarks: nodes may follow all of them, and the joint mode lies next to sd = 0. With u_B
integrated out by Laplace's approximation, H its curvature and C = H⁻¹, the log density of the logarithm θ of such a
scale gains −½ log det H, whose derivatives are

∂/∂θ_k = −½ tr(C H_k) and −∂²/∂θ_k∂θ_l = ½ tr(C H_kl) − ½ tr(C H_k C H_l), where H_kl = 0 for k ≠ l.

For T_r these are ½ tr(C P) and ½ tr(C P − (C P)²), so that 2 E_r / T_r = γ where its prior says nothing. At a typical
draw of u_B, whose energies are greater than at the mode, the density itself is more curved in θ_k, by ½ tr(C H_kk).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from bayesreg.inference.layout import Placed, marked
from bayesreg.inference.target import Target

SCALE, COMPONENTS = "field_sd", "field"
_MOST = 1.0


def mark_scales(target: Target) -> Bool[np.ndarray, "dimension"]:
    """Mark the entries of a flat position that hold the logarithm of a scale, that of the field included."""
    return marked(target, SCALE) | mark_scales_of_displacements(target)


def mark_scales_of_displacements(target: Target) -> Bool[np.ndarray, "dimension"]:
    """Mark the entries of a flat position that hold the logarithm of a scale of the displacements."""
    return marked(target, *(target.mode_search.scales if target.mode_search else ()))


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


class Volume(NamedTuple):
    """Derivatives of −½ log det H in the logarithms θ of scales.

    Attributes
    ----------
    slope : (k,) array
    curvature : (k, k) array
        Minus the second derivatives.
    excess : (k,) array
        By how much the log density is more curved in each θ at a typical draw of the displacements than at their mode.
    covariance : (r, r) array
        C.
    """

    slope: Float[np.ndarray, "scales"]
    curvature: Float[np.ndarray, "scales scales"]
    excess: Float[np.ndarray, "scales"]
    covariance: Float[np.ndarray, "rows rows"]


def volume_of(
    curvature: Float[np.ndarray, "rows rows"],
    derivatives: Sequence[tuple[Float[np.ndarray, "rows rows"], Float[np.ndarray, "rows rows"]]],
) -> Volume:
    """The derivatives of −½ log det H.

    Parameters
    ----------
    curvature : (r, r) array
        H.
    derivatives : sequence
        H_k and H_kk of every scale.
    """
    covariance = scipy.linalg.cho_solve(scipy.linalg.cho_factor(curvature), np.eye(len(curvature)))
    excess = np.array([(covariance * second).sum() / 2 for _, second in derivatives])
    shares = np.array([covariance @ first for first, _ in derivatives])
    slope = -np.trace(shares, axis1=1, axis2=2) / 2
    return Volume(slope, np.diag(excess) - np.einsum("kij,lji->kl", shares, shares) / 2, excess, covariance)


def newton_step(
    slope: Float[np.ndarray, "scales"], curvature: Float[np.ndarray, "scales scales"]
) -> Float[np.ndarray, "scales"]:
    """A step of the logarithms of scales towards the maximum of their evidence, of 1 at most in each.

    Where the evidence is not convex, it counts by the size of its curvature.
    """
    values, vectors = np.linalg.eigh((curvature + curvature.T) / 2)
    step = vectors @ ((vectors.T @ slope) / np.maximum(np.abs(values), np.finfo(float).tiny))
    return np.clip(step, -_MOST, _MOST)
