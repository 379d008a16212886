"""The response K⁺ of several tissues to loads, by a Cholesky factorisation for each stiffness.

With the nodes in the order of Cuthill and McKee, K is a band. Blocks as wide as the band make it block tridiagonal, so
that both the factorisation and the solves consist of products of matrices. Six unknowns that stop the rigid motions are
removed. For balanced loads, the solution then differs from K⁺ times the loads by a rigid motion, which a projection
removes.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float, Int
from scipy.linalg.lapack import dpotrf, dtrtrs

from bayesreg.fem.determinant import narrow_order
from bayesreg.fem.elasticity import stiffness
from bayesreg.mesh import TetMesh

# The number of stiffnesses whose factors are in memory: those of all chains, and of as many proposals.
KEPT = 12

Map = Callable[[Callable[..., Any], Iterable[Any]], Iterator[Any]]


class Kept(NamedTuple):
    """What belongs to one stiffness.

    Attributes
    ----------
    diagonal : list of (b, b) arrays
        The Cholesky factors L_k of the diagonal blocks.
    below : list of (b, b) arrays
        W_k, the blocks of the factor below them.
    squares : (2, t) array
        The upper triangles of Gᵀ M G and Gᵀ A G.
    pushes : (2, 6, m) array
        Rᵀ M G and Rᵀ A G.
    log_determinant : float
        log det of K without the removed unknowns.
    """

    diagonal: list[Float[np.ndarray, "b b"]]
    below: list[Float[np.ndarray, "b b"]]
    squares: Float[np.ndarray, "2 entries"]
    pushes: Float[np.ndarray, "2 6 coordinates"]
    log_determinant: float


class FactorisedResponse:
    """The response of a body of several tissues to loads; stiffnesses are rows (λ of all entries, μ of all entries).

    Parameters
    ----------
    mesh : TetMesh
    entries : (cells,) int array
        The entry of each cell in λ and μ.
    rigid : (3n, 6) array
        R.
    masses : (2, 3n) array
        The diagonals of M and A.
    interpolation : (m, 3n) array
        B.
    side_by_side : callable
        A map that calls a function for several chains, each in a thread.
    """

    def __init__(
        self,
        mesh: TetMesh,
        entries: Int[np.ndarray, "cells"],
        rigid: Float[np.ndarray, "unknowns 6"],
        masses: Float[np.ndarray, "2 unknowns"],
        interpolation: Float[np.ndarray, "coordinates unknowns"],
        side_by_side: Map,
    ) -> None:
        self._rigid, self._masses, self._map = rigid, masses, side_by_side
        self._interpolation, self._balanced = interpolation, self._without_rigid(interpolation.T)
        self._triangle = np.triu_indices(len(interpolation))
        isostatic = scipy.linalg.qr(rigid.T, pivoting=True, mode="r")[1][:6]
        self._log_null = 2 * float(np.linalg.slogdet(rigid[isostatic])[1])
        self._order = narrow_order(mesh, np.setdiff1d(np.arange(len(rigid)), isostatic))
        self._entries, self._places, self._shape = _blocks(mesh, entries, self._order)
        self._kept: OrderedDict[bytes, Kept] = OrderedDict()
        self._lock = Lock()

    def covariances(
        self, stiffnesses: Float[np.ndarray, "chains parameters"], sizes: Float[np.ndarray, "chains 2"]
    ) -> tuple[Float[np.ndarray, "chains entries"], Float[np.ndarray, "chains 6 coordinates"]]:
        """Return the upper triangles of Gᵀ D G, and Rᵀ D G."""
        kept = list(self._map(self._at, stiffnesses))
        squares = np.stack([size @ each.squares for size, each in zip(sizes, kept, strict=True)])
        return squares, np.stack([np.tensordot(size, each.pushes, 1) for size, each in zip(sizes, kept, strict=True)])

    def solve(
        self, stiffnesses: Float[np.ndarray, "chains parameters"], loads: Float[np.ndarray, "chains unknowns"]
    ) -> Float[np.ndarray, "chains unknowns"]:
        """Return K⁺ times loads."""

        def solve(chain: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
            given, load = chain
            kept = self._at(given)
            balanced = self._without_rigid(load[:, None])
            return self._without_rigid(self._solve(kept.diagonal, kept.below, balanced))[:, 0]

        return np.stack(list(self._map(solve, zip(stiffnesses, loads, strict=True))))

    def at_coordinates(
        self, stiffnesses: Float[np.ndarray, "chains parameters"], loads: Float[np.ndarray, "chains unknowns"]
    ) -> Float[np.ndarray, "chains coordinates"]:
        """Return Gᵀ times loads."""
        return self.solve(stiffnesses, loads) @ self._interpolation.T

    def to_coordinates(
        self, stiffnesses: Float[np.ndarray, "chains parameters"], weights: Float[np.ndarray, "chains coordinates"]
    ) -> Float[np.ndarray, "chains unknowns"]:
        """Return G times weights."""
        return self.solve(stiffnesses, weights @ self._interpolation)

    def log_pseudo_determinants(
        self, stiffnesses: Float[np.ndarray, "chains parameters"]
    ) -> Float[np.ndarray, "chains"]:
        """Return log pdet K; the kept factorisations have it already."""
        kept = self._map(self._at, stiffnesses)
        return np.array([each.log_determinant for each in kept]) - self._log_null

    def _at(self, given: Float[np.ndarray, "parameters"]) -> Kept:
        key = given.tobytes()
        with self._lock:
            if (kept := self._kept.get(key)) is not None:
                self._kept.move_to_end(key)
                return kept
        kept = self._factorise(given)
        with self._lock:
            self._kept[key] = kept
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
        return kept

    def _factorise(self, given: Float[np.ndarray, "parameters"]) -> Kept:
        diagonal, below = self._cholesky(given)
        G = self._without_rigid(self._solve(diagonal, below, self._balanced))
        squares = np.stack([(G.T @ (mass[:, None] * G))[self._triangle] for mass in self._masses])
        pushes = np.stack([(mass[:, None] * self._rigid).T @ G for mass in self._masses])
        used = np.concatenate([np.diag(lower) for lower in diagonal])[: len(self._order)]
        with np.errstate(invalid="ignore"):
            return Kept(diagonal, below, squares, pushes, float(2 * np.log(used).sum()))

    def _cholesky(self, given: Float[np.ndarray, "parameters"]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Compute L_k L_kᵀ = K_kk − W_{k−1} W_{k−1}ᵀ and W_k = K_{k+1,k} L_k⁻ᵀ; NaN if K is not positive definite."""
        blocks = np.zeros(self._shape)
        blocks.ravel()[self._places] = self._entries @ given
        # The last block has unused rows.
        unused = np.arange(len(self._order) % self._shape[-1] or self._shape[-1], self._shape[-1])
        blocks[-1, 0, unused, unused] = 1.0
        diagonal: list[np.ndarray] = []
        below: list[np.ndarray] = []
        for on, under in blocks:
            remaining = on - below[-1] @ below[-1].T if below else on
            lower, failure = dpotrf(remaining, lower=1, clean=1)
            diagonal.append(np.full_like(lower, np.nan) if failure else lower)
            below.append(dtrtrs(diagonal[-1], under.T, lower=1)[0].T)
        return diagonal, below

    def _solve(
        self, diagonal: list[np.ndarray], below: list[np.ndarray], loads: Float[np.ndarray, "unknowns columns"]
    ) -> Float[np.ndarray, "unknowns columns"]:
        """Solve for the displacements that are zero at the removed unknowns."""
        count, width = len(diagonal), self._shape[-1]
        padded = np.zeros((count * width, loads.shape[1]))
        padded[: len(self._order)] = loads[self._order]
        pieces = list(padded.reshape(count, width, -1))
        for k in range(count):
            rest = pieces[k] - below[k - 1] @ pieces[k - 1] if k else pieces[k]
            pieces[k] = dtrtrs(diagonal[k], rest, lower=1)[0]
        for k in reversed(range(count)):
            rest = pieces[k] - below[k].T @ pieces[k + 1] if k + 1 < count else pieces[k]
            pieces[k] = dtrtrs(diagonal[k], rest, lower=1, trans=1)[0]
        u = np.zeros_like(loads)
        u[self._order] = np.concatenate(pieces)[: len(self._order)]
        return u

    def _without_rigid(self, columns: Float[np.ndarray, "unknowns columns"]) -> Float[np.ndarray, "unknowns columns"]:
        return columns - self._rigid @ (self._rigid.T @ columns)


def _blocks(
    mesh: TetMesh, entries: Int[np.ndarray, "cells"], order: Int[np.ndarray, "unknowns"]
) -> tuple[Float[np.ndarray, "stored parts"], Int[np.ndarray, "stored"], tuple[int, int, int, int]]:
    """Return the stored entries of K by λ and μ, their places in blocks on and below the diagonal, and their shape."""
    nothing = np.zeros(len(mesh.cells))
    owned = [np.equal(entries, entry).astype(float) for entry in range(int(entries.max()) + 1)]
    parts = [stiffness(mesh, indicator, nothing) for indicator in owned]
    parts += [stiffness(mesh, nothing, indicator) for indicator in owned]
    parts = [part.tocsr()[order][:, order].tocoo() for part in parts]
    width = int(max(np.abs(part.row - part.col).max() for part in parts))
    count = -(-len(order) // width)
    shape = (count, 2, width, width)
    # A part stores what other parts do not.
    flat = [_places(part, width)[0] for part in parts]
    places = np.unique(np.concatenate(flat))
    values = np.zeros((len(places), len(parts)))
    for column, part in enumerate(parts):
        where, kept = _places(part, width)
        np.add.at(values[:, column], np.searchsorted(places, where), part.data[kept])
    return values, places, shape


def _places(part: Any, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the flat places of the entries of K that are stored, and which are."""
    block, under = part.col // width, part.row // width - part.col // width
    kept = (under == 0) | (under == 1)
    places = ((block * 2 + under) * width + part.row % width) * width + part.col % width
    return places[kept], kept
