"""The elastic prior exp(−E_r / T_r) of eq. (12), with or without its normaliser."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Float

from bayesreg.fem.determinant import SchurDeterminant, log_pseudo_determinant
from bayesreg.fem.elements import Elements
from bayesreg.model.state import State
from bayesreg.types import AnyArray, Scalar


class ElasticPrior(NamedTuple):
    """The Boltzmann prior of the displacements.

    Attributes
    ----------
    determinant : SchurDeterminant or None
        None leaves the normaliser out, as the paper does.
    """

    determinant: SchurDeterminant | None

    @property
    def name(self) -> str:
        """The name of the term."""
        return "elastic"

    def log(self, state: State) -> Scalar:
        """−E_r / T_r, and the normaliser if it is part of the density."""
        t_elastic = state.values["t_elastic"]
        return -state.strain_energy / t_elastic + self.log_normaliser(state.elements, state.lam, state.mu, t_elastic)

    def log_normaliser(
        self, elements: Elements, lam: Float[AnyArray, "cells"], mu: Float[AnyArray, "cells"], t_elastic: Scalar
    ) -> Scalar:
        """½ log pdet S(λ, μ) − r/2 log(2π T_r), r the rank of S; zero where it is left out."""
        if self.determinant is None:
            return jnp.zeros(())
        log_pdet = log_pseudo_determinant(self.determinant, elements, lam, mu)
        return 0.5 * (log_pdet - self.determinant.rank * jnp.log(2 * jnp.pi * t_elastic))
