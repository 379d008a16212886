"""The skull. Hard: no sampled node lies in the region Ω_SK. Soft: a penalty grows with the depth in it."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from bayesreg.interpolation import Interpolator
from bayesreg.model.blocks import Values
from bayesreg.model.state import State
from bayesreg.model.term import PointCurvature
from bayesreg.types import AnyArray, Scalar


class Skull(NamedTuple):
    """The hard constraint: a factor that is zero if a sampled node lies in Ω_SK, and one otherwise.

    Attributes
    ----------
    distance : Interpolator
        Signed distance to Ω_SK, mm, positive outside Ω_SK.
    points : (b, 3) array
        Positions of the sampled nodes at rest, mm.
    """

    distance: Interpolator
    points: Float[AnyArray, "sampled 3"]

    @property
    def name(self) -> str:
        """The name of the term."""
        return "skull"

    def log(self, state: State) -> Scalar:
        """Return the logarithm of the factor: zero if the constraint holds, −∞ otherwise."""
        return jnp.where(self.allows(state.values), 0.0, -jnp.inf)

    def allows(self, values: Values) -> Bool[AnyArray, ""]:
        """Check whether all sampled nodes lie outside Ω_SK or on its surface."""
        return (self.gap(values["u_boundary"]) >= 0).all()

    def gap(self, u: Float[AnyArray, "sampled 3"]) -> Float[AnyArray, "sampled"]:
        """Return the signed distance, mm, of every sampled node to Ω_SK after its displacement by u, mm."""
        return self.distance(self.points + u)


class SoftSkull(NamedTuple):
    """A skull with an uncertain surface: the factor exp(−½ Σ (d / width)²).

    The sum is over the sampled nodes; d is the depth of a node in Ω_SK, mm, and is zero outside.

    Attributes
    ----------
    hard : Skull
        The hard constraint of the same skull; it provides the signed distance.
    nodes : (b,) int array
        Numbers of the sampled nodes.
    width : scalar
        The depth in Ω_SK that counts as one standard deviation, mm.
    """

    hard: Skull
    nodes: Int[AnyArray, "sampled"]
    width: Scalar

    @property
    def is_nearly_quadratic(self) -> bool:
        """Whether the logarithm of the factor is nearly quadratic in the displacements; it is not."""
        return False

    @property
    def name(self) -> str:
        """The name of the term."""
        return self.hard.name

    def gap(self, u: Float[AnyArray, "sampled 3"]) -> Float[AnyArray, "sampled"]:
        """Return the signed distance of every sampled node to Ω_SK, mm; see `Skull.gap`."""
        return self.hard.gap(u)

    def depth(self, u: Float[AnyArray, "sampled 3"]) -> Float[AnyArray, "sampled"]:
        """Return the depth d, mm, of every sampled node in Ω_SK after its displacement by u, mm; zero outside Ω_SK."""
        return -jnp.minimum(self.gap(u), 0.0)

    def log(self, state: State) -> Scalar:
        """Return the logarithm of the factor, −½ Σ (d / width)²."""
        return -0.5 * (self.depth(state.values["u_boundary"]) ** 2).sum() / self.width**2

    def gauss_newton(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Return the Gauss–Newton curvature of −log, 1/mm², at every sampled node.

        It is n nᵀ / width² in Ω_SK, where n is the gradient of the signed distance, and zero outside.
        """
        normal = jax.grad(lambda u: self.depth(u).sum())(values["u_boundary"]) / self.width
        weights = jnp.broadcast_to(jnp.eye(4)[0], (len(self.nodes), 4))
        nodes = jnp.broadcast_to(self.nodes[:, None], weights.shape)
        return PointCurvature(nodes, weights, normal[:, :, None] * normal[:, None])

    def remainder(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Return zeros, 1/mm²: the second derivatives of the distance are neglected, as the skull is nearly flat."""
        curvature = self.gauss_newton(u, values)
        return curvature._replace(matrices=jnp.zeros_like(curvature.matrices))


def mark_behind_skull(problem: Any, u: Float[AnyArray, "sampled 3"]) -> Bool[AnyArray, "sampled"]:
    """Mark the sampled nodes that lie in Ω_SK of a `Problem` after their displacement by u, mm."""
    return problem.terms["skull"].gap(u) < 0


def is_allowed(distance: Interpolator, points: Float[AnyArray, "nodes 3"]) -> Bool[AnyArray, "nodes"]:
    """Check which points (world, mm) lie outside Ω_SK or on its surface: their signed distance is not negative."""
    return distance(points) >= 0
