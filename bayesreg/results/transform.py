"""The posterior of the map from the fixed image's world to the moving image's world, and of its inverse."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement, product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import chi2
from scipy.stats.qmc import MultivariateNormalQMC

from bayesreg.fem.deformation import Deformer, Displaced
from bayesreg.fem.location import Location
from bayesreg.image import slices
from bayesreg.mesh import TetMesh
from bayesreg.model.submesh import Unresolved
from bayesreg.pose import Pose


@dataclass(frozen=True, eq=False)
class Transform:
    """The map y = pose(x + u(x)) with draws of u or, if it is inverted (`turned`), x as a function of y.

    Attributes
    ----------
    deformer : Deformer
        The mesh, undeformed in the fixed image's world.
    pose : Pose
        The rigid map between the two worlds. It has no uncertainty, since u includes the error of the pose.
    u_mean : (n, 3) array
        Posterior mean of u at the nodes, mm.
    draws : (S, n, 3) array
        Draws of u at the nodes, mm.
    unresolved : Unresolved
        The distribution of the displacement that the mesh cannot resolve.
    turned : bool
        Whether the map leads from the moving image's world to the fixed image's world.
    seed : int
        Seed of the draws of the displacement that the mesh cannot resolve.

    Notes
    -----
    A draw at a point is the draw of the mesh, which is linear in every tetrahedron, plus two parts. One is a draw of
    the displacement that the mesh cannot resolve (`bayesreg.model.submesh`), which has no jumps and is common to all
    points; of every two draws, the second has the opposite sign, so that their mean is zero. The other is a Normal
    number: in the middle of a tetrahedron the mesh averages independent errors of the nodes, and the truth is no better
    known there than at the corners. With it, the variance of the mesh is that of the nodes, interpolated as a standard
    deviation. All points share these numbers, three for each draw. A run writes the standard deviation of the sum on
    the grid of its image.
    """

    deformer: Deformer
    pose: Pose
    u_mean: Float[np.ndarray, "nodes 3"]
    draws: Float[np.ndarray, "draws nodes 3"]
    unresolved: Unresolved
    turned: bool = False
    seed: int = 0

    @property
    def mesh(self) -> TetMesh:
        """The mesh of the registration."""
        return self.deformer.mesh

    @property
    def inverse(self) -> Transform:
        """The inverse map between the two worlds."""
        return replace(self, turned=not self.turned)

    @cached_property
    def mean(self) -> Displaced:
        """The mesh after displacement by the posterior mean."""
        return self.deformer.displaced(self.u_mean)

    @cached_property
    def folded(self) -> float:
        """The share of the draws that invert a tetrahedron of the mesh."""
        return float(np.mean([self.deformer.displaced(u).folded > 0 for u in self.draws]))

    def place(self, points: Float[np.ndarray, "k 3"]) -> tuple[Float[np.ndarray, "k 3"], Location]:
        """Map points by the posterior mean of u, mm; also locate them in the mesh in the fixed image's world."""
        if self.turned:
            return self.mean.sources(self.pose.inverse.place(points))
        location = self.deformer.locate(points)
        return self.pose.place(points + self.mean.displacement(points, location)), location

    @cached_property
    def _normal_numbers(self) -> Float[np.ndarray, "draws 3"]:
        """Normal numbers for each draw and axis, with mean zero and variance one over the draws."""
        numbers = np.random.default_rng((self.seed, len(self.draws))).standard_normal((len(self.draws), 3))
        numbers -= numbers.mean(axis=0)
        return numbers / np.maximum(numbers.std(axis=0, ddof=1), 1e-12) if len(numbers) > 1 else numbers

    def place_by(
        self, draw: int, points: Float[np.ndarray, "k 3"], near: Location, averaged_sd: Float[np.ndarray, "k 3"]
    ) -> Float[np.ndarray, "k 3"]:
        """Map points by one of the draws, mm.

        Parameters
        ----------
        draw : int
            The number of the draw.
        points : (k, 3) array
            The points before the map, mm.
        near : Location
            The locations of the points from `place`.
        averaged_sd : (k, 3) array
            From `Transform.averaged_sd` at these locations, mm.
        """
        displaced = self.deformer.displaced(self.draws[draw])
        beside = self._unresolved_by(draw, near) + averaged_sd * self._normal_numbers[draw]
        if self.turned:
            return displaced.sources(self.pose.inverse.place(points), near)[0] - beside
        return self.pose.place(points + displaced.displacement(points, near) + beside)

    def for_each_draw(self, function: Callable[[int], Any]) -> Iterator[Any]:
        """Call a function with the number of each draw, in parallel threads, and yield its results in order."""
        side_by_side = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        with ThreadPoolExecutor(side_by_side) as pool:
            for first in range(0, len(self.draws), side_by_side):
                yield from pool.map(function, range(first, min(first + side_by_side, len(self.draws))))

    def _unresolved_by(self, draw: int, near: Location) -> Float[np.ndarray, "k 3"]:
        """Compute the displacement that the mesh cannot resolve at points in one of the draws, mm; zero around it."""
        pair, turn = divmod(draw, 2)
        amplitudes = (1 - 2 * turn) * self.unresolved.draw((self.seed, pair))
        displacement, inside = np.zeros((len(near.cell), 3)), self.deformer.is_inside(near)
        displacement[inside] = self.unresolved.displacement(amplitudes, near.cell[inside], near.barycentric[inside])
        return displacement

    def averaged_sd(self, near: Location) -> Float[np.ndarray, "k 3"]:
        """Compute the standard deviation that the draws of the mesh lack at points, mm; zero around the mesh."""
        sd, inside = np.zeros((len(near.cell), 3)), self.deformer.is_inside(near)
        cell, share = near.cell[inside], near.barycentric[inside]
        sd[inside] = np.sqrt(self._averaged_variance(cell, share, self._drawn_covariance(cell, share)))
        return sd

    def unresolved_sd(self, near: Location) -> Float[np.ndarray, "k 3"]:
        """Compute the standard deviation of all that is added to draws of the mesh at points, mm; zero around it."""
        variance, inside = self.averaged_sd(near) ** 2, self.deformer.is_inside(near)
        variance[inside] += self.unresolved.variance_at(near.cell[inside], near.barycentric[inside])
        return np.sqrt(variance)

    def covariance(self, near: Location) -> Float[np.ndarray, "k 3 3"]:
        """Compute the posterior covariance of u at points, mm², along the axes of the fixed image's world.

        The notes of `Transform` define it. It is NaN around the mesh, where nothing is observed.
        """
        inside = self.deformer.is_inside(near)
        cell, share = near.cell[inside], near.barycentric[inside]
        drawn = self._drawn_covariance(cell, share)
        averaged = self._averaged_variance(cell, share, drawn)[:, :, None] * np.eye(3)
        covariance = np.full((len(near.cell), 3, 3), np.nan)
        covariance[inside] = drawn + averaged + self.unresolved.covariance_at(cell, share)
        return covariance

    def variances(self, cell: Int[np.ndarray, "k"], share: Float[np.ndarray, "k 4"]) -> Float[np.ndarray, "2 k 3"]:
        """Compute the variances of u at points in tetrahedra, mm², along the axes of the moving image's world.

        The first is that of the nodes, interpolated as a standard deviation, and the second that of what the mesh
        cannot resolve.
        """
        interpolated = self._interpolated_variance(cell, share, self.pose.rotation)
        return np.stack([interpolated, self.unresolved.turned(self.pose.rotation).variance_at(cell, share)])

    def _interpolated_variance(
        self, cell: Int[np.ndarray, "k"], share: Float[np.ndarray, "k 4"], axes: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "k 3"]:
        """Compute the variance of the nodes along some axes (rows), interpolated at points as a standard deviation."""
        nodal = np.sqrt(np.einsum("ij,maajk,ik->mai", axes, self._cell_covariance, axes))
        return np.einsum("ka,kai->ki", share, nodal[cell]) ** 2

    def _drawn_covariance(
        self, cell: Int[np.ndarray, "k"], share: Float[np.ndarray, "k 4"]
    ) -> Float[np.ndarray, "k 3 3"]:
        """Compute the covariance of the draws of the mesh, which are linear in every tetrahedron, at points, mm²."""
        total = np.zeros((len(cell), 3, 3))
        for a, b in product(range(4), repeat=2):
            total += (share[:, a] * share[:, b])[:, None, None] * self._cell_covariance[cell, a, b]
        return total

    def _averaged_variance(
        self, cell: Int[np.ndarray, "k"], share: Float[np.ndarray, "k 4"], drawn: Float[np.ndarray, "k 3 3"]
    ) -> Float[np.ndarray, "k 3"]:
        """Compute the variance that the draws of the mesh lack at points, mm²."""
        interpolated = self._interpolated_variance(cell, share, np.eye(3))
        return np.maximum(interpolated - np.einsum("kii->ki", drawn), 0)

    def nodal_covariance(self) -> Float[np.ndarray, "nodes 3 3"]:
        """Compute the posterior covariance of u at the nodes, mm²."""
        away = self.draws - self.draws.mean(axis=0)
        return np.einsum("sni,snj->nij", away, away) / max(len(away) - 1, 1)

    @cached_property
    def _cell_covariance(self) -> Float[np.ndarray, "cells 4 4 3 3"]:
        """The covariance of u between the corners of every tetrahedron, mm²."""
        away, cells = self.draws - self.draws.mean(axis=0), self.mesh.cells
        covariance = np.empty((len(cells), 4, 4, 3, 3))
        # Blocks of tetrahedra limit the memory for all draws of their corners.
        for block in slices(len(cells), 500):
            corners = np.moveaxis(away[:, cells[block]], 0, 2)
            for a, b in combinations_with_replacement(range(4), 2):
                covariance[block, a, b] = np.swapaxes(corners[:, a], 1, 2) @ corners[:, b] / max(len(away) - 1, 1)
                covariance[block, b, a] = np.swapaxes(covariance[block, a, b], 1, 2)
        return covariance


class Spread(NamedTuple):
    """The posterior of the coordinates of mapped points.

    Attributes
    ----------
    places : (k, 3) array
        The points mapped by the posterior mean of the displacement, mm.
    covariance : (k, 3, 3) array
        Covariance of the draws about `places`, mm². NaN around the mesh: nothing is observed there, and the draws agree
        too well because the displacement continues in one way only.
    far : (x, k) array
        P(distance from `places` > d) for each of x distances d; NaN around the mesh.
    inside : (k,) bool array
        Whether the point, in the fixed image's world, lies in the mesh; outside nothing is observed.
    """

    places: Float[np.ndarray, "k 3"]
    covariance: Float[np.ndarray, "k 3 3"]
    far: Float[np.ndarray, "x k"]
    inside: Bool[np.ndarray, "k"]

    def selected(self, chosen: Bool[np.ndarray, "k"]) -> Spread:
        """Select some of the points."""
        return Spread(self.places[chosen], self.covariance[chosen], self.far[:, chosen], self.inside[chosen])

    def ellipsoids(self, probability: float = 0.95) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 3"]]:
        """Compute the ellipsoids that hold Normal points of these covariances with a probability.

        The results are the half-axes, mm, the longest first, and their directions (rows).
        """
        lengths, axes = np.full((len(self.places), 3), np.nan), np.full((len(self.places), 3, 3), np.nan)
        is_finite = np.isfinite(self.covariance).all(axis=(1, 2))
        variance, directions = np.linalg.eigh(self.covariance[is_finite])
        lengths[is_finite] = np.sqrt(np.maximum(variance, 0) * chi2.ppf(probability, 3))[:, ::-1]
        axes[is_finite] = np.swapaxes(directions, 1, 2)[:, ::-1]
        return lengths, axes


def spread(transform: Transform, points: Float[np.ndarray, "k 3"], far: Sequence[float] = ()) -> Spread:
    """Compute the posterior of points mapped by a transform.

    Only a few draws of all points are in memory at a time.

    Parameters
    ----------
    transform : Transform
    points : (k, 3) array
        The points before the map, mm.
    far : sequence of float
        The distances d of `Spread.far`, mm.
    """
    places, near = transform.place(points)
    inside = transform.deformer.is_inside(near)
    inside_index = np.flatnonzero(inside)
    location = Location(near.cell[inside_index], near.barycentric[inside_index])
    square, beyond_far = np.zeros((len(inside_index), 3, 3)), np.zeros((len(far), len(inside_index)))
    sd = transform.averaged_sd(location)
    for drawn_places in transform.for_each_draw(
        lambda draw: transform.place_by(draw, points[inside_index], location, sd)
    ):
        away = drawn_places - places[inside_index]
        square += away[:, :, None] * away[:, None]
        distance = np.linalg.norm(away, axis=1)
        beyond_far += distance > np.reshape(far, (-1, 1))
    count = len(transform.draws)
    covariance, share = np.full((len(points), 3, 3), np.nan), np.full((len(far), len(points)), np.nan)
    covariance[inside_index], share[:, inside_index] = square / max(count - 1, 1), beyond_far / count
    return Spread(places, covariance, share, inside)


class Distances(NamedTuple):
    """The distribution of the length of Normal vectors of mean zero.

    Attributes
    ----------
    radius : (k,) array
        The radius that 95 % of the vectors do not exceed, mm (or another share, see `distances_of`).
    far : (x, k) array
        P(length > d) for each of x distances d.
    """

    radius: Float[np.ndarray, "k"]
    far: Float[np.ndarray, "x k"]


def distances_of(covariance: Float[np.ndarray, "k 3 3"], far: Sequence[float] = (), level: float = 0.95) -> Distances:
    """Compute the distribution of the length of Normal vectors of given covariances, mm²; NaN if a covariance is NaN.

    The squared length is Σ λ_i z_i² with the eigenvalues λ of the covariance and independent Normal numbers z. All
    covariances share 1,024 quasi-random z, which give probabilities with an error of 0.01.
    """
    squares = MultivariateNormalQMC(np.zeros(3), rng=np.random.default_rng(0)).random(1024) ** 2
    radius, probability = np.full(len(covariance), np.nan), np.full((len(far), len(covariance)), np.nan)
    finite_index = np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2)))
    for first in range(0, len(finite_index), 20_000):
        block = finite_index[first : first + 20_000]
        square = np.maximum(np.linalg.eigvalsh(covariance[block]), 0) @ squares.T
        for index, distance in enumerate(far):
            probability[index, block] = (square > distance**2).mean(axis=1)
        rank = int(np.ceil(level * square.shape[1])) - 1
        radius[block] = np.sqrt(np.partition(square, rank, axis=1)[:, rank])
    return Distances(radius, probability)
