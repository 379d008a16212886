"""The scale of a field of many components, where a mode would mislead.

With s = sd · B z, z ~ N(0, I), the joint mode of (z, log sd) lies at a great sd and small z: it ignores how much less
room z has the greater sd is. The reference is better placed where the evidence of sd has its maximum, by MacKay's fixed
point (1992): |z|² = γ, the number of components that the data determine.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from bayesreg.inference.target import Estimands
from bayesreg.types import AnyArray

SCALE, COMPONENTS = "field_sd", "field"
_MOST = 1.0


@runtime_checkable
class Placed(Protocol):
    """What is asked of a target here."""

    def reference(self) -> dict[str, AnyArray]:
        """Values at rest."""

    def unconstrain(self, values: Estimands) -> dict[str, AnyArray]:
        """Position of values."""


def is_scale(target: Placed) -> Float[np.ndarray, "dimension"]:
    """One at the entry of a flat position that holds log sd, zero elsewhere."""
    return _marked(target, SCALE)


def balanced(
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
    scale = np.flatnonzero(is_scale(target))
    if not len(scale):
        return flat
    components = np.flatnonzero(_marked(target, COMPONENTS))
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


def _marked(target: Placed, wanted: str) -> Float[np.ndarray, "dimension"]:
    position = target.unconstrain(target.reference())
    marks = {name: np.full(np.shape(value), float(name == wanted)) for name, value in position.items()}
    return np.asarray(ravel_pytree(marks)[0])
