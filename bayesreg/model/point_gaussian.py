"""The Gaussian of the observed shifts of points, given the stiffness, the loads and the variances of the errors.

`bayesreg.model.point_algebra` has the formulas and the symbols.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtri


class GivenShifts(NamedTuple):
    """The Gaussian of y at given λ, sizes and errors.

    Attributes
    ----------
    rigid : (m, 6) array
        H.
    triangle : two (t,) int arrays
        The rows and columns of the upper triangle of an (m, m) array.
    square : (t,) array
        Gᵀ D G there.
    push : (6, m) array
        Rᵀ D G.
    balance : (6, 6) array
        (Rᵀ D R)⁻¹.
    noise : (m,) array
        The diagonal of Σ, mm².
    precision : float
        The diagonal of Λ, 1/mm².
    """

    rigid: Float[np.ndarray, "coordinates 6"]
    triangle: tuple[np.ndarray, np.ndarray]
    square: Float[np.ndarray, "entries"]
    push: Float[np.ndarray, "6 coordinates"]
    balance: Float[np.ndarray, "6 6"]
    noise: Float[np.ndarray, "coordinates"]
    precision: float

    def factorised(self) -> Factorised:
        """Compute S, factorise it, and solve with it for H."""
        covariance = np.zeros((len(self.noise),) * 2)
        covariance[self.triangle] = self.square
        covariance -= self.push.T @ (self.balance @ self.push)
        covariance[np.diag_indices(len(covariance))] += self.noise
        lower, failure = dpotrf(covariance.T, lower=1, overwrite_a=1)
        if failure:
            lower = np.full_like(lower, np.nan)
        whitened = dpotrs(lower, self.rigid, lower=1)[0]
        information = self.rigid.T @ whitened + self.precision * np.eye(6)
        return Factorised(lower, whitened, information, self.balance)

    def log_density(self, shift: Float[np.ndarray, "coordinates"]) -> float:
        """Compute log p(y) for shifts y, mm, up to a constant."""
        factorised = self.factorised()
        # NaN where S is not positive definite.
        with np.errstate(invalid="ignore"):
            log_dets = np.log(np.diag(factorised.lower)).sum() + np.linalg.slogdet(factorised.information)[1] / 2
        return float(-log_dets - shift @ factorised.solve(shift)[0] / 2)


class Factorised(NamedTuple):
    """The factors of S and of the information about the rigid motion.

    Attributes
    ----------
    lower : (m, m) array
        The Cholesky factor of S; NaN if S is not positive definite.
    whitened : (m, 6) array
        S⁻¹ H.
    information : (6, 6) array
        Hᵀ S⁻¹ H + Λ.
    balance : (6, 6) array
        (Rᵀ D R)⁻¹.
    """

    lower: Float[np.ndarray, "coordinates coordinates"]
    whitened: Float[np.ndarray, "coordinates 6"]
    information: Float[np.ndarray, "6 6"]
    balance: Float[np.ndarray, "6 6"]

    def solve(self, shift: Float[np.ndarray, "coordinates"]) -> tuple[Float[np.ndarray, "coordinates"], np.ndarray]:
        """Return S⁻¹ (y − H b) and b for shifts y, mm."""
        rigid = np.linalg.solve(self.information, self.whitened.T @ shift)
        return dpotrs(self.lower, shift, lower=1)[0] - self.whitened @ rigid, rigid

    def leave_out(
        self, shift: Float[np.ndarray, "coordinates"]
    ) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 3"]]:
        """Return P y and the blocks of P for each point, where P = S⁻¹ − S⁻¹ H (Hᵀ S⁻¹ H)⁻¹ Hᵀ S⁻¹."""
        inverse = dtrtri(self.lower, lower=1)[0].reshape(len(shift), -1, 3)
        whitened = self.whitened.reshape(-1, 3, 6)
        information = np.einsum("rki,rkj->kij", inverse, inverse)
        information -= whitened @ np.linalg.solve(self.information, whitened.mT)
        return self.solve(shift)[0].reshape(-1, 3), information
