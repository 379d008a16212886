"""The normaliser of the elastic prior, as the samplers see it."""

from __future__ import annotations

from dataclasses import dataclass

import jax

from bayesreg.model.blocks import LAME, Values
from bayesreg.model.coordinates import complete
from bayesreg.model.program import Problem
from bayesreg.model.state import physical_lame_by_cell
from bayesreg.types import AnyArray, Scalar


@dataclass(frozen=True)
class Normaliser:
    """What the elastic prior's normaliser has of λ and μ (`bayesreg.inference.target.Normaliser`).

    ½ log pdet S(λ, μ) − r/2 log(2π T_r) of the Boltzmann prior, and log pdet K(λ, μ) of random loads.

    Attributes
    ----------
    is_costly : bool
        Whether it costs much more than the rest of the density.
    """

    is_costly: bool

    @property
    def depends_on(self) -> tuple[str, ...]:
        """λ and μ, the field that multiplies them, and T_r."""
        return (*LAME, "field", "field_sd", "t_elastic")

    def log(self, data: Problem, estimands: Values) -> Scalar:
        """The logarithm of this factor; zero in data from which it was left out."""
        return _log_normaliser(data, complete(data.blocks, estimands))

    def without(self, data: Problem) -> Problem:
        """The data of the same problem without it, and without its cost."""
        return data.with_term("elastic", data.terms["elastic"]._replace(determinant=None))


@jax.jit
def _log_normaliser(problem: Problem, values: dict[str, AnyArray]) -> Scalar:
    lam, mu = physical_lame_by_cell(problem.body, problem.blocks, values)
    return problem.terms["elastic"].log_normaliser(problem.body.system.elements, lam, mu, values)
