"""The skull constraint: no sampled node lies in Ω_SK (hard), or no node lies deep in it (soft)."""

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
    """The hard constraint: zero if a sampled node lies in the forbidden region, one otherwise.

    Attributes
    ----------
    distance : Interpolator
        Signed distance to Ω_SK, mm, positive outside it.
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
        """Return zero or −∞."""
        return jnp.where(self.allows(state.values), 0.0, -jnp.inf)

    def allows(self, values: Values) -> Bool[AnyArray, ""]:
        """Check whether all sampled nodes lie outside Ω_SK."""
        return (self.gap(values["u_boundary"]) >= 0).all()

    def gap(self, u: Float[AnyArray, "sampled 3"]) -> Float[AnyArray, "sampled"]:
        """Return the signed distances to Ω_SK of the sampled nodes, displaced by u, mm."""
        return self.distance(self.points + u)


class SoftSkull(NamedTuple):
    """A skull with an uncertain border: exp(−½ Σ (d / width)²); d is the depth of a sampled node inside the skull.

    Attributes
    ----------
    hard : Skull
    nodes : (b,) int array
        Numbers of the sampled nodes.
    width : scalar
        mm.
    """

    hard: Skull
    nodes: Int[AnyArray, "sampled"]
    width: Scalar

    @property
    def is_nearly_quadratic(self) -> bool:
        """Whether the log is nearly quadratic in the displacements; it is not."""
        return False

    @property
    def name(self) -> str:
        """The name of the term."""
        return self.hard.name

    def gap(self, u: Float[AnyArray, "sampled 3"]) -> Float[AnyArray, "sampled"]:
        """Return the signed distances to Ω_SK; see `Skull.gap`."""
        return self.hard.gap(u)

    def depth(self, u: Float[AnyArray, "sampled 3"]) -> Float[AnyArray, "sampled"]:
        """Return the depth of the sampled nodes inside the skull, displaced by u, mm; zero outside."""
        return -jnp.minimum(self.gap(u), 0.0)

    def log(self, state: State) -> Scalar:
        """Return −½ Σ (d / width)²."""
        return -0.5 * (self.depth(state.values["u_boundary"]) ** 2).sum() / self.width**2

    def gauss_newton(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Return n nᵀ / width² at every node inside, where n is the gradient of the distance, 1/mm²."""
        normal = jax.grad(lambda u: self.depth(u).sum())(values["u_boundary"]) / self.width
        own = jnp.broadcast_to(jnp.eye(4)[0], (len(self.nodes), 4))
        nodes = jnp.broadcast_to(self.nodes[:, None], own.shape)
        return PointCurvature(nodes, own, normal[:, :, None] * normal[:, None])

    def remainder(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Return zero: the surface of the skull is nearly flat."""
        found = self.gauss_newton(u, values)
        return found._replace(matrices=jnp.zeros_like(found.matrices))


def mark_behind_skull(problem: Any, u: Float[AnyArray, "sampled 3"]) -> Bool[AnyArray, "sampled"]:
    """Mark the sampled nodes that lie in the skull of a `Problem` if they are displaced by u, mm."""
    return problem.terms["skull"].gap(u) < 0


def is_allowed(distance: Interpolator, points: Float[AnyArray, "nodes 3"]) -> Bool[AnyArray, "nodes"]:
    """Check which points (world, mm) lie outside Ω_SK, by the signed distance."""
    return distance(points) >= 0
