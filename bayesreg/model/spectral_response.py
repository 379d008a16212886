"""The response K⁺ of one tissue to loads, for all λ at once.

Only λ changes Gᵀ M G and Gᵀ A G (`bayesreg.model.point_algebra` has the symbols). At a known μ, K = μ K_μ + λ K_λ. The
generalised eigenvectors of (K_λ, μ K_μ), with values 0 ≤ ω ≤ 3 / (2 μ), since (tr ε)² ≤ 3 ε : ε, diagonalise K for all
λ at once; its inverse has the factors 1 / (1 + λ ω). They are analytic functions of x = log(1 + 3 λ / (2 μ)) up to the
distance π from the real axis. Chebyshev's polynomials of a moderate degree therefore give Gᵀ M G and Gᵀ A G at every λ
to about `PRECISION`.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.fft
import scipy.linalg
from jaxtyping import Float

from bayesreg.fem.elasticity import stiffness
from bayesreg.mesh import TetMesh
from bayesreg.types import AnyArray

# The relative error of the interpolation in λ; the elastic solves of other posteriors have a similar one.
PRECISION = 1e-8


class SpectralResponse:
    """The response of one tissue of known μ to loads; stiffnesses are rows (λ, μ).

    Parameters
    ----------
    mesh : TetMesh
    rigid : (3n, 6) array
        R.
    masses : (2, 3n) array
        The diagonals of M and A.
    interpolation : (m, 3n) array
        B.
    mu : float
    lam : (float, float)
        The least and the greatest λ.
    """

    def __init__(
        self,
        mesh: TetMesh,
        rigid: Float[np.ndarray, "unknowns 6"],
        masses: Float[np.ndarray, "2 unknowns"],
        interpolation: Float[np.ndarray, "coordinates unknowns"],
        mu: float,
        lam: tuple[float, float],
    ) -> None:
        self._steepness = 1.5 / mu
        self._vectors, self._ratios, self._log_of_shear = _eigenvectors(mesh, mu, rigid)
        self._pulled = pulled = self._vectors.T @ interpolation.T
        self._bounds = low, high = np.log1p(self._steepness * np.array(lam))
        degrees = _degrees(high - low)
        # Chebyshev's nodes, at which a cosine transform gives the coefficients.
        x = low + (high - low) * (1 + np.cos(np.pi * (np.arange(degrees) + 0.5) / degrees)) / 2
        triangle, squares, pushes = np.triu_indices(len(interpolation)), [], []
        for value in np.expm1(x) / self._steepness:
            responses = self._vectors @ (self._factors(float(value))[:, None] * pulled)
            squares.append([(responses.T @ (mass[:, None] * responses))[triangle] for mass in masses])
            pushes.append([(mass[:, None] * rigid).T @ responses for mass in masses])
        self._squares, self._pushes = (_coefficients(np.array(samples)) for samples in (squares, pushes))

    def covariances(
        self, stiffnesses: Float[np.ndarray, "chains 2"], sizes: Float[np.ndarray, "chains 2"]
    ) -> tuple[Float[np.ndarray, "chains entries"], Float[np.ndarray, "chains 6 coordinates"]]:
        """Return the upper triangles of Gᵀ D G, and Rᵀ D G."""
        low, high = self._bounds
        x = np.log1p(self._steepness * stiffnesses[:, 0])
        # A known λ has one degree, whose polynomial is one everywhere.
        angles = np.arccos(np.clip((2 * x - low - high) / (high - low if high > low else 1.0), -1, 1))
        weights = np.cos(np.arange(len(self._squares)) * angles[:, None])[:, :, None] * sizes[:, None]
        return np.tensordot(weights, self._squares, axes=2), np.tensordot(weights, self._pushes, axes=2)

    def solve(
        self, stiffnesses: Float[np.ndarray, "chains 2"], loads: Float[np.ndarray, "chains unknowns"]
    ) -> Float[np.ndarray, "chains unknowns"]:
        """Return K⁺ times loads. Rows are chains, so that each product reads its matrix once for all of them."""
        factors = self._factors(stiffnesses[:, :1])
        return (factors * (loads @ self._vectors)) @ self._vectors.T

    def at_coordinates(
        self, stiffnesses: Float[np.ndarray, "chains 2"], loads: Float[np.ndarray, "chains unknowns"]
    ) -> Float[np.ndarray, "chains coordinates"]:
        """Return Gᵀ times loads."""
        return (self._factors(stiffnesses[:, :1]) * (loads @ self._vectors)) @ self._pulled

    def to_coordinates(
        self, stiffnesses: Float[np.ndarray, "chains 2"], weights: Float[np.ndarray, "chains coordinates"]
    ) -> Float[np.ndarray, "chains unknowns"]:
        """Return G times weights."""
        return (self._factors(stiffnesses[:, :1]) * (weights @ self._pulled.T)) @ self._vectors.T

    def log_pseudo_determinants(self, stiffnesses: Float[np.ndarray, "chains 2"]) -> Float[np.ndarray, "chains"]:
        """Return log pdet K."""
        return self._log_of_shear + np.log1p(stiffnesses[:, :1] * self._ratios).sum(axis=1)

    def _factors(self, lam: AnyArray | float) -> Float[np.ndarray, "*chains modes"]:
        return 1 / (1 + lam * self._ratios)


def _eigenvectors(
    mesh: TetMesh, mu: float, rigid: Float[np.ndarray, "unknowns 6"]
) -> tuple[Float[np.ndarray, "unknowns modes"], Float[np.ndarray, "modes"], float]:
    """Compute the eigenvectors V of (K_λ, μ K_μ) without rigid motions, Vᵀ μ K_μ V = 1, ω, and log pdet μ K_μ."""
    ones, nothing = np.ones(len(mesh.cells)), np.zeros(len(mesh.cells))
    complement = scipy.linalg.qr(rigid)[0][:, 6:]
    volume, shear = (
        complement.T @ (stiffness(mesh, *moduli) @ complement) for moduli in ((ones, nothing), (nothing, mu * ones))
    )
    ratios, vectors = scipy.linalg.eigh(volume, shear)
    return complement @ vectors, ratios, float(np.linalg.slogdet(shear)[1])


def _degrees(extent: float) -> int:
    """Return the number of Chebyshev's polynomials for a function that is analytic within π of an interval."""
    if extent == 0:
        return 1
    # The greatest ellipse of Bernstein in which it is analytic has the half-axis π, where half the interval is 1.
    half_axis = 2 * math.pi / extent
    return math.ceil(-math.log(PRECISION) / math.log(half_axis + math.hypot(half_axis, 1)))


def _coefficients(samples: Float[np.ndarray, "degrees *shape"]) -> Float[np.ndarray, "degrees *shape"]:
    """Compute Chebyshev's coefficients from samples at Chebyshev's nodes, from the greatest node to the least."""
    coefficients = scipy.fft.dct(samples, axis=0) / len(samples)
    coefficients[0] /= 2
    return coefficients
