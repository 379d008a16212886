"""A barrier in the prior against inverted tetrahedra, which real tissue cannot have."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayesreg.fem.elements import Elements, displacement_gradient
from bayesreg.model.blocks import Values
from bayesreg.model.state import State
from bayesreg.model.term import PointCurvature, SharedCurvature
from bayesreg.types import AnyArray, Scalar

# Standard deviation of the logarithm of a share below the least share. A share of 0.9 of the least costs 0.14, a share
# of 0.5 costs 6.
WIDTH = 0.2
# Below this share of the least volume, a second-order expansion continues the barrier, because a search may start
# behind it.
QUADRATIC_BELOW = 0.05


class Barrier(NamedTuple):
    """The factor exp(−½ Σ (ln(J / least) / WIDTH)²) over the tetrahedra with J = det(I + ∇u) < least.

    J is the share of its volume that a tetrahedron keeps. The cost is 112 at `QUADRATIC_BELOW` times the least share.
    Below that it continues to grow, more steeply than the log likelihood of any pair of images. An inverted
    tetrahedron, J ≤ 0, has a density of at most e^−237.

    Attributes
    ----------
    least : scalar
        The least share of volume without cost, between 0 and 1.
    elements : Elements
    """

    least: Scalar
    elements: Elements

    @property
    def is_nearly_quadratic(self) -> bool:
        """Whether the log is nearly quadratic in the displacements; it is not."""
        return False

    @property
    def name(self) -> str:
        """The name of the term."""
        return "barrier"

    def log(self, state: State) -> Scalar:
        """Return the log density up to a constant."""
        return -cost(volume_shares(self.elements, state.u) / self.least).sum()

    def gauss_newton(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Compute the second derivative of the cost times ∇J ∇Jᵀ of every tetrahedron below the least volume, 1/mm²."""
        gradient = np.stack([np.stack(row) for row in displacement_gradient(self.elements.derivative, jnp.asarray(u))])
        shares = np.asarray(volume_shares(self.elements, jnp.asarray(u)) / self.least)
        below = np.flatnonzero(shares < 1)
        F = np.eye(3) + np.moveaxis(gradient[..., below], -1, 0)
        # Row k of the cofactors is ∂J/∂F_k, and F_kj changes by ∂N_a/∂x_j with u_k of node a.
        cofactors = np.stack([np.cross(F[:, (k + 1) % 3], F[:, (k + 2) % 3]) for k in range(3)], axis=1)
        by_node = np.einsum("ckj,ajc->cak", cofactors, np.asarray(self.elements.gradients)[..., below])
        bending = np.asarray(jax.vmap(jax.grad(jax.grad(cost)))(jnp.asarray(shares[below]))) / float(self.least) ** 2
        vectors = np.sqrt(bending)[:, None, None] * by_node
        nodes = np.asarray(self.elements.cells)[:, below].T.reshape(-1, 1)
        weights = np.broadcast_to(np.eye(4)[0], (len(nodes), 4))
        shared = SharedCurvature(np.repeat(np.arange(len(below)), 4), vectors.reshape(1, -1, 3), np.ones(1))
        return PointCurvature(np.broadcast_to(nodes, weights.shape), weights, np.zeros((len(nodes), 3, 3)), shared)

    def remainder(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Return zero: the remainder is smaller than the Gauss–Newton part by the factor J, below the least share."""
        curvature = self.gauss_newton(u, values)
        return curvature._replace(shared=None)


def cost(share: AnyArray) -> AnyArray:
    """Return ½ (ln(share) / WIDTH)² below 1, and its second-order expansion below a small share."""
    inside = jnp.clip(share, QUADRATIC_BELOW, 1.0)
    depth = jnp.log(inside) / WIDTH
    slope, bending = depth / (WIDTH * inside), (1 / WIDTH - depth) / (WIDTH * inside**2)
    beyond = jnp.minimum(share - inside, 0.0)
    return 0.5 * depth**2 + slope * beyond + 0.5 * bending * beyond**2


def volume_shares(elements: Elements, u: Float[AnyArray, "nodes 3"]) -> Float[AnyArray, "cells"]:
    """Compute J = det(I + ∇u) of every tetrahedron: volume over volume at rest; negative if it is inverted."""
    (a, b, c), (d, e, f), (g, h, i) = displacement_gradient(elements.derivative, u)
    a, e, i = 1 + a, 1 + e, 1 + i
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
