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

# Smaller moduli are replaced by this value, so that their logarithms are finite if they underflow to zero.
SMALLEST = 1e-30


@dataclass(frozen=True)
class Normaliser:
    """The normaliser of the elastic prior as a function of λ and μ (`bayesreg.inference.target.Normaliser`).

    For the Boltzmann prior its logarithm is ½ log pdet S(λ, μ) − r/2 log(2π T_r), where r is the rank of S, the Schur
    complement of the stiffness in the sampled nodes. For random loads it is log pdet K(λ, μ), the costly part of the
    logarithm of the normaliser.

    Attributes
    ----------
    is_costly : bool
        Whether the normaliser costs much more than the rest of the density.
    """

    is_costly: bool

    @property
    def depends_on(self) -> tuple[str, ...]:
        """The names of the blocks on which the normaliser may depend: λ, μ, the field of stiffness, its sd, and T_r."""
        return (*LAME, "field", "field_sd", "t_elastic")

    def smooth_coordinates(self, data: Problem, estimands: Values) -> Float[AnyArray, "coordinates"]:
        """Return log(λ + 2μ) of every free λ, log μ of every free μ, the field, and the logarithms of sampled scales.

        K is linear in λ + 2μ and μ, the moduli of longitudinal and shear waves. Unlike log λ, log(λ + 2μ) is finite at
        λ = 0, so that the normaliser is a smooth function of these coordinates there, too.
        """
        blocks = data.blocks
        values = complete(blocks, estimands)
        lam, mu = (jnp.asarray(values[name]) for name in LAME)
        moduli = {"lam": jnp.log(jnp.maximum(lam + 2 * mu, SMALLEST)), "mu": jnp.log(jnp.maximum(mu, SMALLEST))}
        coordinates = [moduli[name][blocks[name].free.index] for name in LAME]
        others = [name for name in self.depends_on[len(LAME) :] if name in blocks and blocks[name].is_sampled]
        for name in others:
            value = jnp.ravel(jnp.asarray(values[name]))
            coordinates.append(value if name == "field" else jnp.log(value))
        return jnp.concatenate(coordinates)

    def log(self, data: Problem, estimands: Values) -> Scalar:
        """Return the logarithm of the normaliser; it is zero if the data do not include the normaliser."""
        return _log_normaliser(data, complete(data.blocks, estimands))

    def without(self, data: Problem) -> Problem:
        """Return the data of the same problem without the normaliser, which is then not computed."""
        return data.with_term("elastic", data.terms["elastic"]._replace(determinant=None))


@jax.jit
def _log_normaliser(problem: Problem, values: dict[str, AnyArray]) -> Scalar:
    lam, mu = physical_lame_by_cell(problem.body, problem.blocks, values)
    return problem.terms["elastic"].log_normaliser(problem.body.system.elements, lam, mu, values)
