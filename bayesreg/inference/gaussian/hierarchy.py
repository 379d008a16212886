"""Scales of what has many components, where a mode would mislead.

With a field s = sd · B z, z ~ N(0, I), the joint mode of (z, log sd) lies at a great sd and small z: it ignores how
much less room z has the greater sd is. The Gaussian is better placed where the evidence of sd has its maximum, by
MacKay's fixed point (1992): |z|² = γ, the number of components that the data determine.

T_r is such a scale of u_B, whose prior's curvature P falls as 1 / T_r: the joint mode lies next to T_r = 0, where
nothing moves. So is the sd of landmarks: nodes may follow all of them, and the joint mode lies next to sd = 0. λ and μ
are in the prior's curvature, too: the joint mode would have them wherever they let all displacements pass. With u_B
integrated out by Laplace's approximation, H its curvature and C = H⁻¹, the log density of such hyperparameters θ, in
the coordinates of a position, gains −½ log det H, whose derivatives are

∂/∂θ_k = −½ tr(C H_k) and −∂²/∂θ_k∂θ_l = ½ tr(C H_kl) − ½ tr(C H_k C H_l).

For T_r these are ½ tr(C P) and ½ tr(C P − (C P)²), so that 2 E_r / T_r = γ where its prior says nothing. At a typical
draw of u_B, whose energies are greater than at the mode, the density itself is more curved in θ, by ½ tr(C H_kl).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float

from bayesreg.inference.layout import Placed, marked
from bayesreg.inference.target import Target
from bayesreg.types import Matrix

SCALE, COMPONENTS = "field_sd", "field"
_MOST = 1.0


def mark_scales(target: Target) -> Bool[np.ndarray, "dimension"]:
    """Mark the entries of a flat position that hold hyperparameters, the logarithm of the field's sd included."""
    return marked(target, SCALE) | mark_hyperparameters(target)


def mark_hyperparameters(target: Target) -> Bool[np.ndarray, "dimension"]:
    """Mark the entries of a flat position that hold hyperparameters of the displacements."""
    return marked(target, *(target.mode_search.hyperparameters if target.mode_search else ()))


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


@dataclass(frozen=True, eq=False)
class Volume:
    """Second derivatives of −½ log det H in hyperparameters θ.

    Attributes
    ----------
    covariance : (r, r) array
        C.
    second_traces : (k, k) array
        tr(C H_kl).
    slopes : callable
        () → H_k of every hyperparameter, dense or sparse, which not everybody needs.
    """

    covariance: Float[np.ndarray, "rows rows"]
    second_traces: Float[np.ndarray, "hyperparameters hyperparameters"]
    slopes: Callable[[], Sequence[Matrix]]

    @property
    def excess(self) -> Float[np.ndarray, "hyperparameters hyperparameters"]:
        """By how much the log density is more curved in θ at a typical draw of the displacements than at their mode."""
        return self.second_traces / 2

    @cached_property
    def curvature(self) -> Float[np.ndarray, "hyperparameters hyperparameters"]:
        """Minus the second derivatives."""
        # Products of dense matrices are faster than those with a sparse one of so many entries.
        shares = [(one.toarray() if scipy.sparse.issparse(one) else one) @ self.covariance for one in self.slopes()]
        squares = np.zeros(self.second_traces.shape)
        for row, one in enumerate(shares):
            turned = np.ascontiguousarray(one.T)
            for column, other in enumerate(shares[: row + 1]):
                squares[row, column] = squares[column, row] = np.vdot(turned, other)
        return (self.second_traces - squares) / 2
