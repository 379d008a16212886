"""The hard skull constraint: no sampled node lies in Ω_SK."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from bayesreg.interpolation import Interpolator
from bayesreg.model.blocks import Values
from bayesreg.model.state import State
from bayesreg.types import AnyArray, Scalar


class Skull(NamedTuple):
    """Zero where a sampled node lies in the forbidden region, one elsewhere: such a state cannot have made the image.

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
        """Zero or −∞."""
        return jnp.where(self.allows(state.values), 0.0, -jnp.inf)

    def allows(self, values: Values) -> Bool[AnyArray, ""]:
        """Whether no sampled node lies in Ω_SK."""
        return is_allowed(self.distance, self.points + values["u_boundary"]).all()

    def clearance(
        self, u: Float[AnyArray, "*batch nodes 3"], nodes: Int[AnyArray, "nodes"]
    ) -> Float[AnyArray, "*batch nodes"]:
        """Signed distance to Ω_SK, mm, of some rows of "u_boundary" displaced by u."""
        return self.distance(self.points[nodes] + u)


class Walls:
    """The skull, as the samplers see it (`bayesreg.inference.target.Walls`); the data are a `Problem`."""

    def clearance(
        self, data: Any, u: Float[AnyArray, "*batch nodes 3"], nodes: Int[AnyArray, "nodes"]
    ) -> Float[AnyArray, "*batch nodes"]:
        """See `Skull.clearance`; infinite in data without a skull."""
        skull = data.terms.get("skull")
        return jnp.full(u.shape[:-1], jnp.inf) if skull is None else skull.clearance(u, nodes)

    def without(self, data: Any) -> Any:
        """The data of the same problem without a skull."""
        return data.without_term("skull")


def is_allowed(distance: Interpolator, points: Float[AnyArray, "nodes 3"]) -> Bool[AnyArray, "nodes"]:
    """Tell which points (world, mm) lie outside Ω_SK, by the signed distance."""
    return distance(points) >= 0
