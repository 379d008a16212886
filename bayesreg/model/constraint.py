"""The hard skull constraint: where the sampled nodes may be."""

from __future__ import annotations

from jaxtyping import Bool, Float

from bayesreg.image import Interpolator
from bayesreg.types import AnyArray


def is_allowed(distance: Interpolator, points: Float[AnyArray, "nodes 3"]) -> Bool[AnyArray, "nodes"]:
    """Which points (world, mm) lie outside Ω_SK, by the signed distance."""
    return distance(points) >= 0
