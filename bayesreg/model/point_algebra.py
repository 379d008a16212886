"""Points and surfaces with the displacements integrated out, for random loads: the algebra on the host.

Given λ, the sizes s and t of the loads, and the variances Σ of the errors, the displacements u and the observed shifts
y of the points are jointly Gaussian. With the loads' variances D = s² M + t² A, the rigid motions R, and the
interpolation B at the points,

u = K⁺ q + R c,  q ~ N(0, D) given Rᵀ q = 0,  c flat,  y = B u + e,  e ~ N(0, Σ).

With G = K⁺ Bᵀ and H = B R, the covariance of y at a given rigid motion c, and the density of y, are

S = Gᵀ (D − D R (Rᵀ D R)⁻¹ Rᵀ D) G + Σ,
log p(y) = −½ (log det S + log det Hᵀ S⁻¹ H + yᵀ S⁻¹ (y − H b)) + const,  b = (Hᵀ S⁻¹ H)⁻¹ Hᵀ S⁻¹ y.

With P = S⁻¹ − S⁻¹ H (Hᵀ S⁻¹ H)⁻¹ Hᵀ S⁻¹ and its 3 × 3 blocks P_kk, the other points alone predict point k with the
residual P_kk⁻¹ (P y)_k, whose covariance is P_kk⁻¹.

A surface is not linear in u. It depends on few unknowns, those that it touches. A Gaussian factor stands for it: rows
of B and y with errors of variance one. The difference between both is a function of v, which are the touched unknowns
up to a micrometre. Further rows of B, which are not observed, select them. v given y is Gaussian, too; and given v and
the shifts of points, without the factor, so is u.

A Gaussian prior of the rigid motion, c ~ N(0, Λ⁻¹), adds Λ to Hᵀ S⁻¹ H; a flat one is its limit. S has three rows for
each point and none for the nodes, and only the stiffness changes Gᵀ M G and Gᵀ A G
(`bayesreg.model.spectral_response`, `bayesreg.model.factorised_response`).

The host computes, because programs of XLA with LAPACK's functions in loops did not always end (jaxlib 0.10.2, 2 cores).
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from threadpoolctl import ThreadpoolController

from bayesreg.model.point_gaussian import LEAST_VARIANCE, Factorised, GivenShifts, TouchedGaussian
from bayesreg.types import AnyArray, Scalar

# The number of draws whose matrices are in memory together.
BLOCK = 8


class ResponseDeterminant(NamedTuple):
    """log pdet K from the response of an algebra (a pytree), in place of a determinant in the elastic prior.

    Attributes
    ----------
    number : scalar integer
        `PointAlgebra.number`.
    cells : (entries,) int array
        A cell of each entry of λ and μ.
    """

    number: Int[AnyArray, ""]
    cells: Int[AnyArray, "entries"]

    def log_pseudo_determinant(
        self, _elements: Any, lam: Float[AnyArray, "cells"], mu: Float[AnyArray, "cells"]
    ) -> Scalar:
        """Compute log pdet K for λ and μ by cell."""
        stiffness, result = jnp.concatenate([lam[self.cells], mu[self.cells]]), jax.ShapeDtypeStruct((), float)
        return jax.pure_callback(_log_pseudo_determinants, result, self.number, stiffness, vmap_method="broadcast_all")


class PointAlgebra:
    """The Gaussian of displacements and shifts.

    A program of JAX knows it by its number, an argument: programs then serve other points, and do not keep its arrays
    in memory.

    Parameters
    ----------
    response : SpectralResponse or FactorisedResponse
        K⁺ of each stiffness.
    rigid : (3n, 6) array
        R.
    masses : (2, 3n) array
        The diagonals of M and A.
    precision : float
        That of each entry of c, 1/mm²; zero for a flat prior.
    interpolation : (m, 3n) array
        B: coordinates of points, rows of the factors of surfaces, and touched unknowns.
    shift : (o,) array
        y, mm, of points and factors.
    points : int
        The number of coordinates of points.
    """

    def __init__(
        self,
        response: Any,
        rigid: Float[np.ndarray, "unknowns 6"],
        masses: Float[np.ndarray, "2 unknowns"],
        precision: float,
        interpolation: Float[np.ndarray, "coordinates unknowns"],
        shift: Float[np.ndarray, "observed"],
        points: int,
    ) -> None:
        self.number = next(_numbers)
        _by_number[self.number] = self
        self.response, self._rigid, self._masses, self._precision = response, rigid, masses, precision
        self._interpolation, self._shift, self._points = interpolation, shift, points
        self._rigid_at_points = interpolation @ rigid
        # S is symmetric: its upper triangle is enough, which is the lower one of LAPACK's order of columns.
        self._triangle = np.triu_indices(len(interpolation))
        self._balances = np.stack([rigid.T @ (mass[:, None] * rigid) for mass in masses])

    def log_densities(
        self, stiffness: np.ndarray, sizes: np.ndarray, noise: np.ndarray
    ) -> Float[np.ndarray, "*chains"]:
        """Compute `log_density` of chains, which are the leading axes of all arguments."""
        with one_thread_each() as side_by_side:
            logs = side_by_side(lambda given: given.log_density(self._shift), self._given(stiffness, sizes, noise))
            return np.reshape(list(logs), np.shape(sizes)[:-1])

    def touched_all(self, stiffness: np.ndarray, sizes: np.ndarray, noise: np.ndarray) -> TouchedGaussian:
        """Compute `touched_given` of chains, which are the leading axes of all arguments."""
        with one_thread_each() as side_by_side:
            given = self._given(stiffness, sizes, noise)
            touched = list(side_by_side(lambda given: given.touched(self._shift), given))
        chains = np.shape(sizes)[:-1]
        return TouchedGaussian(*(np.reshape(part, chains + np.shape(part[0])) for part in zip(*touched, strict=True)))

    def draw_all(
        self, stiffness: np.ndarray, sizes: np.ndarray, noise: np.ndarray, v: np.ndarray, white: np.ndarray
    ) -> Float[np.ndarray, "*chains unknowns"]:
        """Compute `draw` of chains, which are the leading axes of all arguments."""
        chains, observed, points = np.shape(sizes)[:-1], len(self._shift), self._points
        is_touched = v.shape[-1] > 0

        def factorised(given: GivenShifts) -> Factorised:
            return given.factorised_with_touched(points) if is_touched else given.factorised()

        with one_thread_each() as side_by_side:
            conditionals = list(side_by_side(factorised, self._given(stiffness, sizes, noise)))
        # Rows are chains.
        count, unknowns = len(conditionals), len(self._rigid)
        variances, given_stiffness = sizes.reshape(-1, 2) @ self._masses, stiffness.reshape(count, -1)
        balances = np.stack([given.balance for given in conditionals])
        errors, shift = np.sqrt(noise.reshape(count, -1)), np.broadcast_to(self._shift, (count, observed))
        kept = np.arange(observed)
        if is_touched:
            kept = np.r_[:points, observed : len(self._interpolation)]
            shift = np.concatenate([shift[:, :points], v.reshape(count, -1)], axis=1)
            least = np.full((count, v.shape[-1]), math.sqrt(LEAST_VARIANCE))
            errors = np.concatenate([errors[:, :points], least], axis=1)
        ends = [6, 6 + unknowns, 6 + unknowns + len(kept)]
        motions, loads, own_errors, _ = np.split(white.reshape(count, -1), ends, axis=1)
        motion = motions @ self._rigid.T / math.sqrt(self._precision) if self._precision else np.zeros_like(variances)

        def balanced(load: np.ndarray) -> np.ndarray:
            """Return loads less D R (Rᵀ D R)⁻¹ Rᵀ of them."""
            parts = np.einsum("rij,rj->ri", balances, load @ self._rigid)
            return load - variances * (parts @ self._rigid.T)

        load = balanced(np.sqrt(variances) * loads)
        drawn = self.response.at_coordinates(given_stiffness, load) + motion @ self._interpolation.T
        apart = shift - drawn[:, kept] - errors * own_errors
        solutions = [given.solve(each) for given, each in zip(conditionals, apart, strict=True)]
        weights = np.zeros_like(drawn)
        weights[:, kept] = [solution[0] for solution in solutions]
        load += balanced(variances * self.response.to_coordinates(given_stiffness, weights))
        u = self.response.solve(given_stiffness, load) + motion
        return (u + np.stack([solution[1] for solution in solutions]) @ self._rigid.T).reshape(*chains, -1)

    def leave_out(
        self, stiffness: np.ndarray, sizes: np.ndarray, noise: np.ndarray
    ) -> tuple[Float[np.ndarray, "draws k 3"], Float[np.ndarray, "draws k 3 3"]]:
        """Compute (P y)_k and P_kk of every point k, for draws, which are the leading axis of all arguments."""

        def leave_out(given: GivenShifts) -> tuple[np.ndarray, np.ndarray]:
            return given.factorised().leave_out(self._shift, self._points)

        blocks = (slice(first, first + BLOCK) for first in range(0, len(sizes), BLOCK))
        with one_thread_each() as side_by_side:
            parts = [
                part
                for block in blocks
                for part in side_by_side(leave_out, self._given(stiffness[block], sizes[block], noise[block]))
            ]
        pulls, information = zip(*parts, strict=True)
        return np.stack(pulls), np.stack(information)

    def _given(self, stiffness: AnyArray, sizes: AnyArray, noise: AnyArray) -> list[GivenShifts]:
        """Return the Gaussian of y of every chain, not factorised."""
        sizes = np.reshape(sizes, (-1, 2))
        squares, pushes = self.response.covariances(np.reshape(stiffness, (len(sizes), -1)), sizes)
        balances = np.linalg.inv(np.tensordot(sizes, self._balances, axes=1))
        chains = zip(squares, pushes, balances, np.reshape(noise, (len(sizes), -1)), strict=True)
        return [GivenShifts(self._rigid_at_points, self._triangle, *arrays, self._precision) for arrays in chains]


# The algebras that something else holds.
_by_number: WeakValueDictionary[int, PointAlgebra] = WeakValueDictionary()
_numbers = itertools.count()


def log_density(
    number: AnyArray,
    stiffness: Float[AnyArray, "entries"],
    sizes: Float[AnyArray, "2"],
    noise: Float[AnyArray, "observed"],
) -> Scalar:
    """Compute log p(y) as part of a JAX program, up to a constant; NaN where S is not positive definite.

    Parameters
    ----------
    number : scalar integer
        `PointAlgebra.number`.
    stiffness : (p,) array
        λ of all entries, then μ of all entries.
    sizes : (2,) array
        s² and t².
    noise : (o,) array
        The diagonal of Σ, mm².
    """
    result = jax.ShapeDtypeStruct((), float)
    return jax.pure_callback(_log_densities, result, number, stiffness, sizes, noise, vmap_method="broadcast_all")


def touched_given(
    number: AnyArray,
    stiffness: Float[AnyArray, "entries"],
    sizes: Float[AnyArray, "2"],
    noise: Float[AnyArray, "observed"],
    touched: int,
) -> TouchedGaussian:
    """Compute the Gaussian of so many touched unknowns given y as part of a JAX program, and log p(y)."""
    shapes = (), (touched,), (touched, touched)
    result = TouchedGaussian(*(jax.ShapeDtypeStruct(shape, float) for shape in shapes))
    return jax.pure_callback(_touched_all, result, number, stiffness, sizes, noise, vmap_method="broadcast_all")


def draw(
    number: AnyArray,
    stiffness: Float[AnyArray, "entries"],
    sizes: Float[AnyArray, "2"],
    noise: Float[AnyArray, "observed"],
    v: Float[AnyArray, "touched"],
    key: AnyArray,
    unknowns: int,
) -> Float[AnyArray, "unknowns"]:
    """Draw u given y as part of a JAX program, mm; if v is not empty, given v in place of the factors of surfaces.

    A draw of the prior is corrected by its difference from what is given (Matheron's rule). The flat prior of the rigid
    motion is the limit of a wide one.
    """
    # Independent Normal numbers for c, the loads and the errors.
    white = jax.random.normal(key, (6 + unknowns + len(noise) + len(v),))
    result = jax.ShapeDtypeStruct((unknowns,), float)
    arguments = number, stiffness, sizes, noise, v, white
    return jax.pure_callback(_draw_all, result, *arguments, vmap_method="broadcast_all")


def algebra_of(number: AnyArray) -> PointAlgebra:
    """Return the algebra of this number; all entries of an array are the same."""
    return _by_number[int(np.ravel(number)[0])]


def _log_pseudo_determinants(number: AnyArray, stiffness: AnyArray) -> Float[np.ndarray, "*chains"]:
    stiffness = np.asarray(stiffness)
    rows = stiffness.reshape(-1, stiffness.shape[-1])
    with one_thread_each():
        return algebra_of(number).response.log_pseudo_determinants(rows).reshape(stiffness.shape[:-1])


def _log_densities(number: AnyArray, *given: AnyArray) -> Float[np.ndarray, "*chains"]:
    return algebra_of(number).log_densities(*map(np.asarray, given))


def _touched_all(number: AnyArray, *given: AnyArray) -> TouchedGaussian:
    return algebra_of(number).touched_all(*map(np.asarray, given))


def _draw_all(number: AnyArray, *given: AnyArray) -> Float[np.ndarray, "*chains unknowns"]:
    return algebra_of(number).draw_all(*map(np.asarray, given))


@contextmanager
def one_thread_each() -> Iterator[Callable[..., Iterator[Any]]]:
    """Yield `map` for chains side by side, each in one thread; BLAS would share one small matrix among all threads."""
    controller, pool = _threads()
    with controller.limit(limits=1):
        yield pool.map


def side_by_side(function: Callable[..., Any], *chains: Iterable[Any]) -> Iterator[Any]:
    """Call a function for several chains, each in one thread."""
    return _threads()[1].map(function, *chains)


@lru_cache
def _threads() -> tuple[ThreadpoolController, ThreadPoolExecutor]:
    return ThreadpoolController(), ThreadPoolExecutor(os.cpu_count())
