"""The elastic prior of eq. (12), exp(−E_r / T_r)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import Field, StrictBool, model_validator

from bayesreg.fem.determinant import SchurDeterminant
from bayesreg.fem.elements import Elements
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Values
from bayesreg.model.state import State
from bayesreg.model.stiffness_parts import StiffnessParts
from bayesreg.settings import KnownOrInferred, Section, Vector, is_inferred, wrong
from bayesreg.types import AnyArray, Matrix, Scalar

Node = Annotated[int, Field(ge=0)]


class Boltzmann(Section):
    """The prior exp(−E_r / T_r) of the sampled nodes, eq. (12); all others follow by the elastic solve, eq. (7)."""

    kind: Literal["boltzmann"] = "boltzmann"
    temperature: KnownOrInferred = 1e4
    """Boltzmann temperature T_r, an energy, or its prior."""
    normalised: StrictBool = False
    """false: the paper's density, without the normaliser of this prior in λ, μ. true: with it; then every free λ, μ
    needs a prior with a finite high, and fixed: {} lets all be free if T_r is known."""
    nodes: Literal["boundary", "all"] | list[Node] = "boundary"
    """The nodes whose displacements are sampled."""
    held: dict[Node, Vector] = Field(default={})
    """Nodes with a known displacement (x, y, z), mm; they are not sampled. Elastography: all boundary nodes held and
    nodes: [] ; λ, μ alone are then sampled, and E_r, the prior of the sampled nodes, is no part of the density."""

    @model_validator(mode="after")
    def _is_proper(self) -> Boltzmann:
        if is_inferred(self.temperature) and not self.normalised:
            raise wrong("temperature", "a T_r with a prior needs normalised: true; without it T_r has no likelihood")
        if not self.normalised:
            return self
        if self.samples_no_node:
            raise wrong("normalised", "expected false where no node is sampled: a given u_B has no prior")
        for node, displacement in self.held.items():
            if any(displacement):
                raise wrong(
                    f"held.{node}",
                    "with normalised: true a node is held where it is, (0, 0, 0), only: the energy of a prescribed "
                    "displacement is part of the normaliser, which leaves it out",
                )
        return self

    @property
    def samples_no_node(self) -> bool:
        """Whether no displacement is sampled because all are known or follow from known ones (elastography)."""
        return not isinstance(self.nodes, str) and not set(self.nodes) - set(self.held)

    @property
    def scales(self) -> dict[str, KnownOrInferred]:
        """The scales of this prior by the names of their blocks."""
        return {"t_elastic": self.temperature}

    def on(self, mesh: TetMesh, determinant: SchurDeterminant | None) -> BoltzmannTerm:
        """Make the term on a mesh."""
        return BoltzmannTerm(determinant)


class BoltzmannTerm(NamedTuple):
    """The factor exp(−E_r / T_r), eq. (12), with or without its normaliser.

    Attributes
    ----------
    determinant : SchurDeterminant or None
        If it is None, the normaliser is omitted, as in the paper.
    """

    determinant: SchurDeterminant | None

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        """The names of the scales whose joint mode with the displacements misleads."""
        return tuple(self.powers)

    @property
    def powers(self) -> dict[str, float]:
        """The scales by the names of their blocks; each is the temperature to the given power."""
        return {"t_elastic": 1.0}

    @property
    def name(self) -> str:
        """The name of the term."""
        return "elastic"

    def log(self, state: State) -> Scalar:
        """Return −E_r / T_r, plus the log normaliser if it is part of the density."""
        energy = state.strain_energy / state.values["t_elastic"]
        return -energy + self.log_normaliser(state.elements, state.lam, state.mu, state.values)

    def log_normaliser(
        self, elements: Elements, lam: Float[AnyArray, "cells"], mu: Float[AnyArray, "cells"], values: Values
    ) -> Scalar:
        """Return ½ log pdet S(λ, μ) − r/2 log(2π T_r), where r is the rank of S; zero without normaliser."""
        if self.determinant is None:
            return jnp.zeros(())
        log_pdet = self.determinant.log_pseudo_determinant(elements, lam, mu)
        return 0.5 * (log_pdet - self.determinant.rank * jnp.log(2 * jnp.pi * values["t_elastic"]))

    def curvature(self, stiffness: Matrix, values: Values) -> Matrix:
        """Return S / T_r, 1/mm², where S is the Schur complement of the stiffness in the sampled nodes."""
        return stiffness / float(values["t_elastic"])

    def trace(
        self, parts: StiffnessParts, covariance: Float[np.ndarray, "unknowns unknowns"]
    ) -> Callable[[Float[np.ndarray, "parts"], Values], float]:
        """Make the function (φ, values) → tr(C K / T_r), where φ multiplies the parts of K."""
        form = parts.linear_form(covariance)
        return lambda coefficients, values: float(coefficients @ form / values["t_elastic"])
