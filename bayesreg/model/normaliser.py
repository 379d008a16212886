"""The normaliser of the elastic prior, as the samplers see it."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Float

from bayesreg.model.blocks import LAME, Values
from bayesreg.model.coordinates import complete
from bayesreg.model.program import Problem
from bayesreg.model.state import physical_lame_by_cell
from bayesreg.types import AnyArray, Scalar

# A modulus that underflows counts as this.
SMALLEST = 1e-30


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

    def smooth_coordinates(self, data: Problem, estimands: Values) -> Float[AnyArray, "coordinates"]:
        """log(λ + 2μ) for every free λ and log μ for every free μ; the field and the logarithms of scales.

        K is a sum of the moduli of longitudinal and of shear waves, and goes on smoothly to λ = 0.
        """
        blocks = data.blocks
        values = complete(blocks, estimands)
        lam, mu = (jnp.asarray(values[name]) for name in LAME)
        moduli = {"lam": jnp.log(jnp.maximum(lam + 2 * mu, SMALLEST)), "mu": jnp.log(jnp.maximum(mu, SMALLEST))}
        found = [moduli[name][blocks[name].free.index] for name in LAME]
        others = [name for name in self.depends_on[len(LAME) :] if name in blocks and blocks[name].is_sampled]
        for name in others:
            value = jnp.ravel(jnp.asarray(values[name]))
            found.append(value if name == "field" else jnp.log(value))
        return jnp.concatenate(found)

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
