"""The search for a mode, as the samplers see it: easier problems on the way, and the curvature."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import jax
from jaxtyping import Float

from bayesreg.interpolation import Interpolation
from bayesreg.model.blocks import Scale, Values
from bayesreg.model.continuation import continuation
from bayesreg.model.coordinates import complete
from bayesreg.model.curvature import Curvature, displacement_curvature
from bayesreg.model.program import Problem
from bayesreg.model.state import state_of
from bayesreg.types import AnyArray


@dataclass(frozen=True, eq=False)
class ModeSearch:
    """The posterior as the search for a mode sees it (`bayesreg.inference.target.ModeSearch`).

    Attributes
    ----------
    data : Problem
    observations : mapping
        By name, as they were given.
    interpolation : {"linear", "cubic"}
        Interpolation of the moving images.
    """

    data: Problem
    observations: Mapping[str, Any]
    interpolation: Interpolation

    @property
    def scales(self) -> tuple[str, ...]:
        """T_r and the scales that observations brought, such as the sd of landmarks, where they are sampled."""
        own = [name for one in self.observations.values() for name in getattr(one, "blocks", {})]
        blocks = {name: self.data.blocks[name] for name in ("t_elastic", *own)}
        return tuple(name for name, block in blocks.items() if isinstance(block, Scale) and block.is_sampled)

    def continuation(self) -> Iterator[Problem]:
        """Problems of growing difficulty, in the displacements alone, that lead to this one."""
        return continuation(self.data, self.observations, self.interpolation)

    def curvature(self, data: Problem, estimands: Values) -> Curvature:
        """Curvature of −log p(u, λ, μ | m) in "field", if there is one, and "u_boundary".

        Returns
        -------
        Curvature
            First the k components of the field, then row k + 3 · node + axis, 1/mm². The elastic energy counts by its
            curvature in the displacements alone.
        """
        values = complete(data.blocks, estimands)
        return displacement_curvature(data, values, _equilibrium(data, values))


@jax.jit
def _equilibrium(problem: Problem, values: Values) -> Float[AnyArray, "nodes 3"]:
    return state_of(problem.body, problem.blocks, values).u
