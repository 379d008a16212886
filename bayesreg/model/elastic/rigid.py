"""A Gaussian prior of the rigid motions, for problems in which no skull and no image bounds them."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Float

from bayesreg.model.state import State
from bayesreg.types import AnyArray, Scalar


class RigidPrior(NamedTuple):
    """A Gaussian prior of the root-mean-square displacement of each rigid mode over the sampled nodes.

    Attributes
    ----------
    modes : (3b, 6) array
        Orthonormal basis of the sampled nodes' infinitesimal rigid motions.
    sd : scalar
        mm.
    """

    modes: Float[AnyArray, "rows 6"]
    sd: Scalar

    @property
    def name(self) -> str:
        """The name of the term."""
        return "rigid"

    def log(self, state: State) -> Scalar:
        """Return the log density up to a constant."""
        return self.log_of(self.modes.T @ state.values["u_boundary"].reshape(-1))

    def log_of(self, coefficients: Float[AnyArray, "6"]) -> Scalar:
        """Return the log density of the six coefficients of the modes."""
        mean_square = coefficients**2 / (len(self.modes) // 3)
        return -0.5 * (mean_square / self.sd**2).sum()

    def precision(self) -> Float[AnyArray, "rows rows"]:
        """Return the curvature in the displacements of the sampled nodes, 1/mm²."""
        return self.modes @ self.modes.T / ((len(self.modes) // 3) * self.sd**2)
