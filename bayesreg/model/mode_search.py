"""The interface of the search for a mode: easier problems, and the curvature."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from bayesreg.model.blocks import LAME, Values
from bayesreg.model.continuation import continuation
from bayesreg.model.coordinates import complete
from bayesreg.model.curvature import (
    Curvature,
    displacement_curvature,
    is_nearly_quadratic,
    quadratic_curvature,
    quadratic_trace,
)
from bayesreg.model.program import Problem
from bayesreg.model.state import state_of
from bayesreg.model.stiffness_parts import has_few_entries
from bayesreg.types import AnyArray

# The search begins with an elastic prior of so many times the temperature if the images say little about each place.
# From the stiff side it would not come to the loads with which the displacement explains the images: they are a mode of
# the evidence of their own. On sag 31 in ultrasound this mode is 0.55 mm off, and the stiff one 1.5 mm.
LOOSE = 100.0
# With more unknown entries of λ or μ, the derivatives in all of them would cost too much.
FEW_ENTRIES = 20


@dataclass(frozen=True, eq=False)
class ModeSearch:
    """The posterior as the search for a mode uses it (`bayesreg.inference.target.ModeSearch`).

    Attributes
    ----------
    data : Problem
    observations : mapping
        By name.
    search_start : mapping or None
        Estimands near the mode, found by an earlier search.
    tempering : callable or None
        Maps estimands near the mode to the posterior tempered by its residuals there; None if it is tempered already.
    """

    data: Problem
    observations: Mapping[str, Any]
    search_start: Values | None = None
    tempering: Callable[[Values], Any] | None = None

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        """The names of the scales of the elastic prior and of observations (T_r, the sd of landmarks), and λ and μ.

        λ and μ are included if the elastic prior is normalised and they have few entries.
        """
        names = [name for term in self.data.terms.values() for name in getattr(term, "hyperparameters", ())]
        elastic = self.data.terms.get("elastic")
        if elastic is not None and elastic.determinant is not None and has_few_entries(self.data.body):
            names += [name for name in LAME if len(self.data.blocks[name].free.index) <= FEW_ENTRIES]
        return tuple(name for name in names if name in self.data.blocks and self.data.blocks[name].is_sampled)

    @property
    def separable(self) -> tuple[str, ...]:
        """The hyperparameters on which the images do not depend at fixed sampled displacements.

        λ and μ are among them if every node is sampled; else nodes follow the sampled ones as λ and μ have it.
        """
        has_followers = len(self.data.body.system.free) > 0
        return tuple(name for name in self.hyperparameters if not (has_followers and name in LAME))

    @property
    def followed(self) -> tuple[str, ...]:
        """The hyperparameters that the sampled displacements follow: all of them if images say little of each place."""
        return self.separable if self._is_weak and "field" not in self.data.blocks else ()

    @property
    def _is_weak(self) -> bool:
        return any(getattr(pair, "is_weak", False) for pair in self.observations.values())

    @property
    def loosening(self) -> dict[str, float]:
        """The factors on the sampled scales of the elastic prior; empty if no observation is weak."""
        elastic = self.data.terms.get("elastic")
        if elastic is None or not self._is_weak:
            return {}
        return {name: LOOSE**power for name, power in elastic.powers.items() if self.data.blocks[name].is_sampled}

    def continuation(self) -> Iterator[Problem]:
        """Yield problems of growing difficulty that lead to this one, in the displacements; none after an approach."""
        if self.search_start is not None:
            return iter(())
        return continuation(self.data, self.observations)

    def curvature(self, data: Problem, estimands: Values) -> Curvature:
        """Compute the curvature of −log p(u, λ, μ | m) in "field", if there is one, and "u_boundary".

        Returns
        -------
        Curvature
            First the k components of the field, then row k + 3 · node + axis, 1/mm². The elastic energy contributes
            only its curvature in the displacements.
        """
        values = complete(data.blocks, estimands)
        return displacement_curvature(data, values, _equilibrium(data, values))

    def quadratic_part(self, data: Problem) -> Problem:
        """Return the problem without images, barrier and skull; it is nearly quadratic in the displacements."""
        others = [name for name, term in data.terms.items() if not is_nearly_quadratic(term)]
        return reduce(Problem.without_term, others, data)

    def quadratic_curvature(self, data: Problem, estimands: Values, near: Values) -> Any:
        """Compute the part of `curvature` that belongs to `quadratic_part`.

        The equilibrium depends on the sampled nodes as at the estimands `near`. The result is sparse if every node is
        sampled.
        """
        values, others = (complete(data.blocks, point) for point in (estimands, near))
        return quadratic_curvature(data, values, others, _equilibrium(data, others))

    def quadratic_trace(
        self, data: Problem, near: Values, covariance: Float[np.ndarray, "rows rows"]
    ) -> Callable[[Values], float]:
        """Make the function from estimands to tr(C R), up to a constant.

        C is a covariance, and R is the `quadratic_curvature` with the equilibrium as at the estimands `near`.
        """
        near_values = complete(data.blocks, near)
        trace = quadratic_trace(data, near_values, _equilibrium(data, near_values), covariance)
        return lambda estimands: trace(complete(data.blocks, estimands))


@jax.jit
def _equilibrium(problem: Problem, values: Values) -> Float[AnyArray, "nodes 3"]:
    return state_of(problem.body, problem.blocks, values).u
