"""The normaliser of the elastic prior, as the samplers use it."""

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

# A modulus that underflows is replaced by this value.
SMALLEST = 1e-30


@dataclass(frozen=True)
class Normaliser:
    """The normaliser of the elastic prior as a function of λ and μ (`bayesreg.inference.target.Normaliser`).

    It is ½ log pdet S(λ, μ) − r/2 log(2π T_r) for the Boltzmann prior, and log pdet K(λ, μ) for random loads.

    Attributes
    ----------
    is_costly : bool
        Whether the normaliser costs much more than the rest of the density.
    """

    is_costly: bool

    @property
    def depends_on(self) -> tuple[str, ...]:
        """The names of the blocks on which it depends: λ and μ, the field that multiplies them, and T_r."""
        return (*LAME, "field", "field_sd", "t_elastic")

    def smooth_coordinates(self, data: Problem, estimands: Values) -> Float[AnyArray, "coordinates"]:
        """Return log(λ + 2μ) of every free λ, log μ of every free μ, the field, and the logarithms of scales.

        K is a sum of the moduli of longitudinal and shear waves, and is a smooth function of these at λ = 0.
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
        """Return the logarithm of this factor; zero for data without it."""
        return _log_normaliser(data, complete(data.blocks, estimands))

    def without(self, data: Problem) -> Problem:
        """Return the data of the same problem without the normaliser and its cost."""
        return data.with_term("elastic", data.terms["elastic"]._replace(determinant=None))


@jax.jit
def _log_normaliser(problem: Problem, values: dict[str, AnyArray]) -> Scalar:
    lam, mu = physical_lame_by_cell(problem.body, problem.blocks, values)
    return problem.terms["elastic"].log_normaliser(problem.body.system.elements, lam, mu, values)
