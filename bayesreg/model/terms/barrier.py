"""A barrier in the prior against tetrahedra that are turned inside out: matter does not."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Float

from bayesreg.fem.elements import Elements, displacement_gradient
from bayesreg.model.state import State
from bayesreg.types import AnyArray, Scalar

# Standard deviation of the logarithm of a share below the least: 0.9 of the least costs 0.14, half of it 6.
WIDTH = 0.2
# Below this share of the least volume the barrier goes on linearly: a search may come from a place behind it.
LINEAR_BELOW = 0.05


class Barrier(NamedTuple):
    """exp(−½ Σ (ln(J / least) / WIDTH)²) over the tetrahedra with J < least, J = det(I + ∇u) the share of volume left.

    With J its cost goes up to 112 and on, more steeply than any pair of images pulls: an inverted tetrahedron, J ≤ 0,
    has e^−187 of the density or less.

    Attributes
    ----------
    least : scalar
        Between 0 and 1.
    """

    least: Scalar

    @property
    def name(self) -> str:
        """The name of the term."""
        return "barrier"

    def log(self, state: State) -> Scalar:
        """The log density up to a constant."""
        return self.log_of(volume_shares(state.elements, state.u))

    def log_of(self, shares: Float[AnyArray, "cells"]) -> Scalar:
        """The log density where the tetrahedra are left with these shares of their volumes."""
        share = shares / self.least
        inside = jnp.clip(share, LINEAR_BELOW, 1.0)
        depth = jnp.log(inside) / WIDTH
        # The tangent where the linear part begins.
        beyond = jnp.minimum(share - inside, 0.0) * depth / (WIDTH * inside)
        return -(0.5 * depth**2 + beyond).sum()


def volume_shares(elements: Elements, u: Float[AnyArray, "nodes 3"]) -> Float[AnyArray, "cells"]:
    """J = det(I + ∇u) of every tetrahedron: its volume over that at rest, negative where it is inverted."""
    (a, b, c), (d, e, f), (g, h, i) = displacement_gradient(elements.derivative, u)
    a, e, i = 1 + a, 1 + e, 1 + i
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
