"""Pairs of points with the displacements integrated out, for one tissue and random loads: its algebra on the host.

Given λ, the sizes s and t of the loads, and the variances Σ of the errors, the displacements u and the observed shifts
y of the points are jointly Gaussian. With the loads' variances D = s² M + t² A, the rigid motions R, and the
interpolation B at the points,

u = K⁺ q + R c,  q ~ N(0, D) given Rᵀ q = 0,  c flat,  y = B u + e,  e ~ N(0, Σ).

With G = K⁺ Bᵀ and H = B R, the covariance of y at a given rigid motion c, and the density of y, are

S = Gᵀ (D − D R (Rᵀ D R)⁻¹ Rᵀ D) G + Σ,
log p(y) = −½ (log det S + log det Hᵀ S⁻¹ H + yᵀ S⁻¹ (y − H b)) + const,  b = (Hᵀ S⁻¹ H)⁻¹ Hᵀ S⁻¹ y.

With P = S⁻¹ − S⁻¹ H (Hᵀ S⁻¹ H)⁻¹ Hᵀ S⁻¹ and its 3 × 3 blocks P_kk, the other points alone predict point k with the
residual P_kk⁻¹ (P y)_k, whose covariance is P_kk⁻¹.

S has three rows for each point and none for the nodes, and only λ changes Gᵀ M G and Gᵀ A G. At a known μ,
K = μ K_μ + λ K_λ. The generalised eigenvectors of (K_λ, μ K_μ), with values 0 ≤ ω ≤ 3 / (2 μ), since
(tr ε)² ≤ 3 ε : ε, diagonalise K for all λ at once; its inverse has the factors 1 / (1 + λ ω). They are analytic
functions of x = log(1 + 3 λ / (2 μ)) up to the distance π from the real axis. Chebyshev's polynomials of a moderate
degree therefore give Gᵀ M G and Gᵀ A G at every λ to about `PRECISION`.

The host computes, because programs of XLA with LAPACK's functions in loops did not always end (jaxlib 0.10.2, 2 cores).
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import jax
import jax.numpy as jnp
import numpy as np
import scipy.fft
import scipy.linalg
from jaxtyping import Float
from threadpoolctl import ThreadpoolController

from bayesreg.fem.elasticity import stiffness
from bayesreg.fem.elements import Elements
from bayesreg.mesh import TetMesh
from bayesreg.model.elastic.loads import LoadsTerm
from bayesreg.model.point_gaussian import GivenShifts
from bayesreg.types import AnyArray, Scalar

# The relative error of the interpolation in λ; the elastic solves of other posteriors have a similar one.
PRECISION = 1e-8
# The number of draws whose matrices are in memory together.
BLOCK = 8


class Spectrum(NamedTuple):
    """The eigenvalues of K by λ at a known μ (a pytree); it takes the place of a determinant in the elastic prior.

    Attributes
    ----------
    ratios : (3n − 6,) array
        ω of (K_λ, μ K_μ).
    log_of_shear : scalar
        log pdet μ K_μ.
    """

    ratios: Float[AnyArray, "modes"]
    log_of_shear: Scalar

    def log_pseudo_determinant(
        self, elements: Elements, lam: Float[AnyArray, "cells"], mu: Float[AnyArray, "cells"]
    ) -> Scalar:
        """Compute log pdet K for a λ that is the same in all cells, at the known μ."""
        return self.log_of_shear + jnp.log1p(lam[0] * self.ratios).sum()


class PointAlgebra:
    """The Gaussian of displacements and shifts.

    A program of JAX knows it by its number, an argument: programs then serve other points, and do not keep its arrays
    in memory.

    Parameters
    ----------
    mesh : TetMesh
    elastic : LoadsTerm
    interpolation : (m, 3n) array
        B, with m coordinates of points.
    shift : (m,) array
        y, mm.
    mu : float
    lam : (float, float)
        The least and the greatest λ.
    """

    def __init__(
        self,
        mesh: TetMesh,
        elastic: LoadsTerm,
        interpolation: Float[np.ndarray, "coordinates unknowns"],
        shift: Float[np.ndarray, "coordinates"],
        mu: float,
        lam: tuple[float, float],
    ) -> None:
        self.number = next(_numbers)
        _by_number[self.number] = self
        self._rigid, self._shift, self._steepness = np.asarray(elastic.rigid), shift, 1.5 / mu
        self._rigid_at_points = interpolation @ self._rigid
        self._masses = np.repeat(np.stack([np.asarray(elastic.volumes), np.asarray(elastic.areas)]), 3, axis=1)
        self._vectors, self.spectrum = _eigenvectors(mesh, mu, self._rigid)
        self._pulled = self._vectors.T @ interpolation.T
        self._bounds = low, high = np.log1p(self._steepness * np.array(lam))
        degrees = _degrees(high - low)
        # Chebyshev's nodes, at which a cosine transform gives the coefficients.
        x = low + (high - low) * (1 + np.cos(np.pi * (np.arange(degrees) + 0.5) / degrees)) / 2
        # S is symmetric: its upper triangle is enough, which is the lower one of LAPACK's order of columns.
        self._triangle, squares, pushes = np.triu_indices(len(shift)), [], []
        for value in np.expm1(x) / self._steepness:
            responses = self._vectors @ (self._factors(value)[:, None] * self._pulled)
            squares.append([(responses.T @ (mass[:, None] * responses))[self._triangle] for mass in self._masses])
            pushes.append([(mass[:, None] * self._rigid).T @ responses for mass in self._masses])
        self._squares, self._pushes = (_coefficients(np.array(samples)) for samples in (squares, pushes))
        self._balances = np.stack([self._rigid.T @ (mass[:, None] * self._rigid) for mass in self._masses])

    def log_densities(self, lam: np.ndarray, sizes: np.ndarray, noise: np.ndarray) -> Float[np.ndarray, "*chains"]:
        """Compute `log_density` of chains, which are the leading axes of all arguments."""
        with _one_thread_each() as side_by_side:
            logs = side_by_side(lambda given: given.log_density(self._shift), self._given(lam, sizes, noise))
            return np.reshape(list(logs), np.shape(lam))

    def draw_all(
        self, lam: np.ndarray, sizes: np.ndarray, noise: np.ndarray, white: np.ndarray, errors: np.ndarray
    ) -> Float[np.ndarray, "*chains unknowns"]:
        """Compute `draw` of chains, which are the leading axes of all arguments."""
        factors = np.stack([self._factors(value) for value in lam.ravel()])
        variances = sizes.reshape(-1, 2) @ self._masses
        with _one_thread_each() as side_by_side:
            conditionals = list(side_by_side(GivenShifts.factorised, self._given(lam, sizes, noise)))

            def balanced(load: np.ndarray) -> np.ndarray:
                """Return loads (chains as rows), less D R (Rᵀ D R)⁻¹ Rᵀ of them."""
                parts = [given.balance @ row for given, row in zip(conditionals, load @ self._rigid, strict=True)]
                return load - variances * (np.stack(parts) @ self._rigid.T)

            load = balanced(np.sqrt(variances) * white.reshape(variances.shape))
            error = (np.sqrt(noise) * errors).reshape(len(factors), -1)
            # Rows are chains, so that each product reads its matrix once for all of them.
            modes = factors * (load @ self._vectors)
            apart = self._shift - modes @ self._pulled - error
            solutions = [given.solve(shift) for given, shift in zip(conditionals, apart, strict=True)]
            weights, motions = (np.stack(part) for part in zip(*solutions, strict=True))
            pull = balanced(variances * ((factors * (weights @ self._pulled.T)) @ self._vectors.T))
            modes += factors * (pull @ self._vectors)
            u = modes @ self._vectors.T + motions @ self._rigid.T
        return u.reshape(white.shape)

    def leave_out(
        self, lam: np.ndarray, sizes: np.ndarray, noise: np.ndarray
    ) -> tuple[Float[np.ndarray, "draws k 3"], Float[np.ndarray, "draws k 3 3"]]:
        """Compute (P y)_k and P_kk of every point k, for draws, which are the leading axis of all arguments."""

        def leave_out(given: GivenShifts) -> tuple[np.ndarray, np.ndarray]:
            return given.factorised().leave_out(self._shift)

        blocks = (slice(first, first + BLOCK) for first in range(0, len(lam), BLOCK))
        with _one_thread_each() as side_by_side:
            parts = [
                part
                for block in blocks
                for part in side_by_side(leave_out, self._given(lam[block], sizes[block], noise[block]))
            ]
        pulls, information = zip(*parts, strict=True)
        return np.stack(pulls), np.stack(information)

    def _factors(self, lam: float) -> Float[np.ndarray, "modes"]:
        return 1 / (1 + lam * self.spectrum.ratios)

    def _given(self, lam: AnyArray, sizes: AnyArray, noise: AnyArray) -> list[GivenShifts]:
        """Return the Gaussian of y of every chain, not factorised."""
        low, high = self._bounds
        x, sizes = np.log1p(self._steepness * np.ravel(lam)), np.reshape(sizes, (-1, 2))
        # A known λ has one degree, whose polynomial is one everywhere.
        angles = np.arccos(np.clip((2 * x - low - high) / (high - low if high > low else 1.0), -1, 1))
        weights = np.cos(np.arange(len(self._squares)) * angles[:, None])[:, :, None] * sizes[:, None]
        squares, pushes = (np.tensordot(weights, array, axes=2) for array in (self._squares, self._pushes))
        balances = np.linalg.inv(np.tensordot(sizes, self._balances, axes=1))
        chains = zip(squares, pushes, balances, np.reshape(noise, (len(x), -1)), strict=True)
        return [GivenShifts(self._rigid_at_points, self._triangle, *arrays) for arrays in chains]


# The algebras that something else holds.
_by_number: WeakValueDictionary[int, PointAlgebra] = WeakValueDictionary()
_numbers = itertools.count()


def log_density(
    number: AnyArray, lam: Scalar, sizes: Float[AnyArray, "2"], noise: Float[AnyArray, "coordinates"]
) -> Scalar:
    """Compute log p(y) as part of a JAX program, up to a constant; NaN where S is not positive definite.

    Parameters
    ----------
    number : scalar integer
        `PointAlgebra.number`.
    lam : scalar
    sizes : (2,) array
        s² and t².
    noise : (m,) array
        The diagonal of Σ, mm².
    """
    result = jax.ShapeDtypeStruct((), float)
    return jax.pure_callback(_log_densities, result, number, lam, sizes, noise, vmap_method="broadcast_all")


def draw(
    number: AnyArray,
    lam: Scalar,
    sizes: Float[AnyArray, "2"],
    noise: Float[AnyArray, "coordinates"],
    white: Float[AnyArray, "unknowns"],
    errors: Float[AnyArray, "coordinates"],
) -> Float[AnyArray, "unknowns"]:
    """Draw u given y as part of a JAX program, mm, from independent Normal numbers for loads and errors.

    A draw of the prior is corrected by its difference from y (Matheron's rule). The flat prior of the rigid motion is
    the limit of a wide one.
    """
    result = jax.ShapeDtypeStruct(jnp.shape(white), float)
    arguments = number, lam, sizes, noise, white, errors
    return jax.pure_callback(_draw_all, result, *arguments, vmap_method="broadcast_all")


def algebra_of(number: AnyArray) -> PointAlgebra:
    """Return the algebra of this number; all entries of an array are the same."""
    return _by_number[int(np.ravel(number)[0])]


def _log_densities(number: AnyArray, *given: AnyArray) -> Float[np.ndarray, "*chains"]:
    lam, sizes, noise = map(np.asarray, given)
    return algebra_of(number).log_densities(lam, sizes, noise)


def _draw_all(number: AnyArray, *given: AnyArray) -> Float[np.ndarray, "*chains unknowns"]:
    lam, sizes, noise, white, errors = map(np.asarray, given)
    return algebra_of(number).draw_all(lam, sizes, noise, white, errors)


@contextmanager
def _one_thread_each() -> Iterator[Callable[..., Iterator[Any]]]:
    """Yield `map` for chains side by side, each in one thread; BLAS would share one small matrix among all threads."""
    controller, pool = _threads()
    with controller.limit(limits=1):
        yield pool.map


@lru_cache
def _threads() -> tuple[ThreadpoolController, ThreadPoolExecutor]:
    return ThreadpoolController(), ThreadPoolExecutor(os.cpu_count())


def _eigenvectors(
    mesh: TetMesh, mu: float, rigid: Float[np.ndarray, "unknowns 6"]
) -> tuple[Float[np.ndarray, "unknowns modes"], Spectrum]:
    """Compute the eigenvectors V of (K_λ, μ K_μ) in the complement of the rigid motions, Vᵀ μ K_μ V = 1, and ω."""
    ones, nothing = np.ones(len(mesh.cells)), np.zeros(len(mesh.cells))
    complement = scipy.linalg.qr(rigid)[0][:, 6:]
    volume, shear = (
        complement.T @ (stiffness(mesh, *moduli) @ complement) for moduli in ((ones, nothing), (nothing, mu * ones))
    )
    ratios, vectors = scipy.linalg.eigh(volume, shear)
    return complement @ vectors, Spectrum(ratios, np.linalg.slogdet(shear)[1])


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
