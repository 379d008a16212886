"""Scales of quantities with many components, whose joint mode is far from most of the probability.

Let a field be s = sd · B z with z ~ N(0, I). The joint mode of (z, log sd) lies at a large sd and a small z, because it
ignores that the volume of likely z decreases as sd grows. The maximum of the evidence of sd is a better centre of the
Gaussian. MacKay's fixed point (1992) gives it: |z|² = γ, the number of components that the data determine.

T_r is such a scale of u_B: the curvature P of the prior of u_B is proportional to 1 / T_r, and the joint mode lies next
to T_r = 0, where all displacements are zero. The sd of landmarks is another one: nodes can follow all landmarks, and
the joint mode lies next to sd = 0. λ and μ are in the curvature of the prior, too, and at the joint mode they would
allow any displacements. The displacements u_B are therefore integrated out by Laplace's approximation, with the
curvature H and C = H⁻¹. The log density of such hyperparameters θ, in the coordinates of a position, then gains
−½ log det H, whose derivatives are

∂/∂θ_k = −½ tr(C H_k) and −∂²/∂θ_k∂θ_l = ½ tr(C H_kl) − ½ tr(C H_k C H_l).

For T_r these are ½ tr(C P) and ½ tr(C P − (C P)²), so that 2 E_r / T_r = γ if its prior is flat. A typical draw of u_B
has greater energies than the mode. At such a draw the density itself is more curved in θ, by ½ tr(C H_kl).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from bayesreg.inference.layout import Placed, marked
from bayesreg.inference.target import Target
from bayesreg.types import Matrix

SCALE, COMPONENTS = "field_sd", "field"
_MOST = 1.0
# The number of random directions for the traces of products of matrices; they only define coordinates.
DIRECTIONS = 64


def mark_scales(target: Target) -> Bool[np.ndarray, "dimension"]:
    """Mark the entries of a flat position that hold hyperparameters, the logarithm of the field's sd included."""
    return marked(target, SCALE) | mark_hyperparameters(target)


def mark_hyperparameters(target: Target) -> Bool[np.ndarray, "dimension"]:
    """Mark the entries of a flat position that hold hyperparameters of the displacements."""
    return marked(target, *(target.mode_search.hyperparameters if target.mode_search else ()))


def mark_followed(target: Target) -> Bool[np.ndarray, "dimension"]:
    """Mark the entries of a flat position that hold hyperparameters which the displacements follow."""
    return marked(target, *(target.mode_search.followed if target.mode_search else ()))


def balance_field(
    target: Placed,
    flat: Float[np.ndarray, "dimension"],
    factor: Callable[[], Float[np.ndarray, "dimension dimension"]],
) -> Float[np.ndarray, "dimension"]:
    """Move sd towards the maximum of its evidence, with the field s unchanged.

    Parameters
    ----------
    target : Placed
    flat : (d,) array
        A mode given sd.
    factor : callable
        () → F, where F Fᵀ is the covariance at `flat`; it is called only if there is a field.
    """
    scale = np.flatnonzero(marked(target, SCALE))
    if not len(scale):
        return flat
    components = np.flatnonzero(marked(target, COMPONENTS))
    rows = np.asarray(factor())[np.concatenate([components, scale])]
    covariance = rows @ rows.T
    # These are the variances of the components given sd.
    variances = np.diag(covariance)[:-1] - covariance[:-1, -1] ** 2 / covariance[-1, -1]
    determined = max(float((1 - variances).sum()), 1.0)
    z = flat[components]
    # The 1 comes from the density of log sd, which is that of sd times sd; the half-normal density is flat near zero.
    change = float(np.clip(0.5 * np.log((z @ z + 1) / determined), -_MOST, _MOST))
    balanced = np.array(flat)
    balanced[components], balanced[scale] = z * np.exp(-change), flat[scale] + change
    return balanced


@dataclass(frozen=True, eq=False)
class Volume:
    """The second derivatives of −½ log det H in hyperparameters θ.

    Attributes
    ----------
    lower : (r, r) array
        The Cholesky factor L of H = L Lᵀ; its upper triangle is not used.
    covariance : (r, r) array
        C = H⁻¹.
    second_traces : (k, k) array
        tr(C H_kl).
    slopes : callable
        () → H_k of every hyperparameter, dense or sparse; a function because only `curvature` needs them.
    """

    lower: Float[np.ndarray, "rows rows"]
    covariance: Float[np.ndarray, "rows rows"]
    second_traces: Float[np.ndarray, "hyperparameters hyperparameters"]
    slopes: Callable[[], Sequence[Matrix]]

    @property
    def excess(self) -> Float[np.ndarray, "hyperparameters hyperparameters"]:
        """The curvature of −log density in θ at a typical draw of the displacements, less that at their mode."""
        return self.second_traces / 2

    @cached_property
    def curvature(self) -> Float[np.ndarray, "hyperparameters hyperparameters"]:
        """Minus the second derivatives of −½ log det H in θ.

        tr(C H_k C H_l) = tr(V_kᵀ V_l) with V_k = L⁻¹ H_k L⁻ᵀ. It is estimated by the images V_k Z of some random
        orthogonal directions Z (Hutchinson 1989); a matrix of few rows has them all, and the result is exact.
        """
        rows = len(self.lower)
        normal = np.random.default_rng(0).normal(size=(rows, min(rows, DIRECTIONS)))
        directions = np.linalg.qr(normal)[0] * np.sqrt(rows / normal.shape[1])
        pulled = scipy.linalg.solve_triangular(self.lower, directions, lower=True, trans="T")
        images = [scipy.linalg.solve_triangular(self.lower, slope @ pulled, lower=True) for slope in self.slopes()]
        squares = np.array([[np.vdot(image, other_image) for other_image in images] for image in images])
        return (self.second_traces - squares) / 2
