"""The Gaussian of observed and touched coordinates, given the stiffness, the loads and the variances of the errors.

`bayesreg.model.point_algebra` has the formulas and the symbols.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg.blas import dsyrk
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtri, dtrtrs

# The variance of the difference of v from the touched unknowns, mm²: that of one micrometre. It keeps the covariance of
# v regular, which is known up to rounding.
LEAST_VARIANCE = 1e-6


class TouchedGaussian(NamedTuple):
    """The Gaussian of v given y, and how probable y is.

    Attributes
    ----------
    log : scalar
        log p(y), up to a constant; NaN where the covariance is not positive definite.
    mean : (t,) array
        mm.
    root : (t, t) array
        The Cholesky factor of the covariance, mm.
    """

    log: Any
    mean: Any
    root: Any


class GivenShifts(NamedTuple):
    """The Gaussian of all coordinates at given λ, sizes and errors: first the observed, then the touched ones.

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
    noise : (o,) array
        The diagonal of Σ, mm², of the observed coordinates.
    precision : float
        The diagonal of Λ, 1/mm².
    """

    rigid: Float[np.ndarray, "coordinates 6"]
    triangle: tuple[np.ndarray, np.ndarray]
    square: Float[np.ndarray, "entries"]
    push: Float[np.ndarray, "6 coordinates"]
    balance: Float[np.ndarray, "6 6"]
    noise: Float[np.ndarray, "observed"]
    precision: float

    def covariance(self) -> Float[np.ndarray, "m m"]:
        """Compute the covariance of all coordinates at a given rigid motion, without errors: its upper triangle."""
        covariance = np.zeros((len(self.rigid),) * 2)
        covariance[self.triangle] = self.square
        covariance -= self.push.T @ (self.balance @ self.push)
        return covariance

    def factorised(self) -> Factorised:
        """Compute S of the observed coordinates, factorise it, and solve with it for H."""
        return self._factorise_observed(self.covariance())

    def factorised_with_touched(self, points: int) -> Factorised:
        """Do the same for v and the coordinates of points, the first of the observed ones, in their place."""
        kept = np.r_[:points, len(self.noise) : len(self.rigid)]
        noise = np.concatenate([self.noise[:points], np.full(len(kept) - points, LEAST_VARIANCE)])
        return self._factorise(self.covariance()[np.ix_(kept, kept)], self.rigid[kept], noise)

    def log_density(self, shift: Float[np.ndarray, "observed"]) -> float:
        """Compute log p(y) for shifts y, mm, up to a constant."""
        return self.factorised().log_density(shift)

    def touched(self, shift: Float[np.ndarray, "observed"]) -> TouchedGaussian:
        """Compute the Gaussian of v given y: the observed coordinates correct a mean of zero."""
        observed, covariance = len(self.noise), self.covariance()
        factorised = self._factorise_observed(covariance)
        across, upper = covariance[:observed, observed:], covariance[observed:, observed:]
        weights, motion = factorised.solve(shift)
        rigid = self.rigid[observed:] - across.T @ factorised.whitened
        upper -= dsyrk(1.0, dtrtrs(factorised.lower, across, lower=1)[0], trans=1)
        upper += rigid @ np.linalg.solve(factorised.information, rigid.T)
        upper[np.diag_indices(len(upper))] += LEAST_VARIANCE
        root, failure = dpotrf(upper.T, lower=1)
        log = np.nan if failure else factorised.log_density(shift)
        return TouchedGaussian(log, across.T @ weights + self.rigid[observed:] @ motion, root)

    def _factorise_observed(self, upper: Float[np.ndarray, "m m"]) -> Factorised:
        observed = len(self.noise)
        return self._factorise(upper[:observed, :observed], self.rigid[:observed], self.noise)

    def _factorise(
        self, upper: Float[np.ndarray, "o o"], rigid: Float[np.ndarray, "o 6"], noise: Float[np.ndarray, "o"]
    ) -> Factorised:
        upper[np.diag_indices(len(upper))] += noise
        lower, failure = dpotrf(upper.T, lower=1)
        if failure:
            lower = np.full_like(lower, np.nan)
        whitened = dpotrs(lower, rigid, lower=1)[0]
        return Factorised(lower, whitened, rigid.T @ whitened + self.precision * np.eye(6), self.balance)


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

    def log_density(self, shift: Float[np.ndarray, "coordinates"]) -> float:
        """Compute the log density of shifts, mm, up to a constant."""
        # NaN where S is not positive definite.
        with np.errstate(invalid="ignore"):
            log_dets = np.log(np.diag(self.lower)).sum() + np.linalg.slogdet(self.information)[1] / 2
        return float(-log_dets - shift @ self.solve(shift)[0] / 2)

    def solve(self, shift: Float[np.ndarray, "coordinates"]) -> tuple[Float[np.ndarray, "coordinates"], np.ndarray]:
        """Return S⁻¹ (y − H b) and b for shifts y, mm."""
        rigid = np.linalg.solve(self.information, self.whitened.T @ shift)
        return dpotrs(self.lower, shift, lower=1)[0] - self.whitened @ rigid, rigid

    def leave_out(
        self, shift: Float[np.ndarray, "coordinates"], points: int
    ) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 3"]]:
        """Return P y and the blocks of P for each point, whose coordinates come first.

        P = S⁻¹ − S⁻¹ H (Hᵀ S⁻¹ H)⁻¹ Hᵀ S⁻¹.
        """
        inverse = dtrtri(self.lower, lower=1)[0][:, :points].reshape(len(shift), -1, 3)
        whitened = self.whitened[:points].reshape(-1, 3, 6)
        information = np.einsum("rki,rkj->kij", inverse, inverse)
        information -= whitened @ np.linalg.solve(self.information, whitened.mT)
        return self.solve(shift)[0][:points].reshape(-1, 3), information
