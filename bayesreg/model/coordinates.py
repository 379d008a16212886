"""The coordinates of a posterior: values, estimands and positions of all blocks together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Bool

from bayesreg.model.blocks import Blocks, Values
from bayesreg.types import AnyArray, Scalar


@dataclass(frozen=True, eq=False)
class Coordinates:
    """The map between estimands and positions for the samplers (`bayesreg.inference.target.Coordinates`).

    The argument `data` of its functions is a `Problem`: the posterior's own or a similar one.

    Attributes
    ----------
    blocks : dict
        The posterior's own.
    """

    blocks: Blocks

    def reference(self) -> dict[str, AnyArray]:
        """Return the estimands at rest."""
        return estimands_of(self.blocks, reference_values(self.blocks))

    def constrain(self, data: Any, position: Values) -> tuple[dict[str, AnyArray], Scalar]:
        """Return the estimands of a position, and the logarithm of the Jacobian."""
        return constrain(data.blocks, position)

    def unconstrain(self, data: Any, estimands: Values) -> dict[str, AnyArray]:
        """Return the position of estimands; this is the inverse of `constrain`."""
        return unconstrain(data.blocks, estimands)

    def least_curvature(self, data: Any, position: Values) -> dict[str, AnyArray]:
        """Return the curvature of −log density in every coordinate that the data hardly constrain."""
        blocks = sampled_blocks(data.blocks)
        return {name: block.least_curvature(position[name]) for name, block in blocks.items()}


def sampled_blocks(blocks: Blocks) -> Blocks:
    """Return the blocks that have unknown entries."""
    return {name: block for name, block in blocks.items() if block.is_sampled}


def reference_values(blocks: Blocks) -> dict[str, AnyArray]:
    """Return the value of every block at rest."""
    return {name: block.reference() for name, block in blocks.items()}


def fill(blocks: Blocks, values: Values) -> dict[str, AnyArray]:
    """Add the known values of blocks without unknowns that were omitted."""
    return {name: values[name] if name in values else block.reference() for name, block in blocks.items()}


def complete(blocks: Blocks, estimands: Values) -> dict[str, AnyArray]:
    """Return the values of estimands, with known entries and known blocks added."""
    return {
        name: block.complete(estimands[name]) if block.is_sampled else block.reference()
        for name, block in blocks.items()
    }


def estimands_of(blocks: Blocks, values: Values) -> dict[str, AnyArray]:
    """Return the sampled entries of values."""
    return {name: block.estimand(values[name]) for name, block in sampled_blocks(blocks).items()}


def constrain(blocks: Blocks, position: Values) -> tuple[dict[str, AnyArray], Scalar]:
    """Return the estimands of a position, and the logarithm of the Jacobian."""
    constrained = {name: block.constrain(position[name]) for name, block in sampled_blocks(blocks).items()}
    return {name: estimand for name, (estimand, _) in constrained.items()}, sum(log for _, log in constrained.values())


def unconstrain(blocks: Blocks, estimands: Values) -> dict[str, AnyArray]:
    """Return the position of estimands."""
    return {name: block.unconstrain(estimands[name]) for name, block in sampled_blocks(blocks).items()}


def is_in_range(blocks: Blocks, values: Values) -> Bool[AnyArray, ""]:
    """Check whether every value lies in the range of its prior."""
    in_range = jnp.array(True)
    for name, block in blocks.items():
        in_range &= block.allows(values[name])
    return in_range
