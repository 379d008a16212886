"""The posterior of the map from the world of the fixed image to that of the moving one, and of its inverse."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement, product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2
from scipy.stats.qmc import MultivariateNormalQMC

from bayesreg.fem.deformation import Deformer, Displaced
from bayesreg.fem.location import Location
from bayesreg.image import slices
from bayesreg.mesh import TetMesh
from bayesreg.model.submesh import submesh_variance
from bayesreg.pose import Pose


@dataclass(frozen=True, eq=False)
class Transform:
    """y = pose(x + u(x)) with draws of u, or, where it is turned round, x as a function of y.

    Attributes
    ----------
    deformer : Deformer
        The mesh, at rest in the fixed image's world.
    pose : Pose
        Between the two worlds; known, for what is unknown of it is part of u.
    u_mean : (n, 3) array
        Posterior mean of u at the nodes, mm.
    draws : (S, n, 3) array
        Draws of it.
    turned : bool
        Whether it leads from the moving image's world to that of the fixed one.
    seed : int
        Of what the mesh cannot follow.

    Notes
    -----
    A draw of u is linear between the nodes, and there it averages what these err by on their own: in the middle of a
    tetrahedron it varies by half as much as at its corners. The truth is not linear, and is not known any better there.
    A draw at a point is therefore that of the mesh and a Normal number, so that its variance is that of the nodes,
    interpolated as a standard deviation, and what the mesh cannot follow of a smooth displacement
    (`bayesreg.model.submesh`): the standard deviation that a run writes on the grid of its image. All points have the
    same Normal numbers, three to a draw, so that what is told of a point does not depend on which others there are;
    how points vary together is not told by them.
    """

    deformer: Deformer
    pose: Pose
    u_mean: Float[np.ndarray, "nodes 3"]
    draws: Float[np.ndarray, "draws nodes 3"]
    turned: bool = False
    seed: int = 0

    @property
    def mesh(self) -> TetMesh:
        """The mesh of the registration."""
        return self.deformer.mesh

    @property
    def inverse(self) -> Transform:
        """The map that leads back."""
        return replace(self, turned=not self.turned)

    @cached_property
    def mean(self) -> Displaced:
        """The mesh, displaced by the posterior mean."""
        return self.deformer.displaced(self.u_mean)

    @cached_property
    def _normal_numbers(self) -> Float[np.ndarray, "draws 3"]:
        """One for each draw and axis, of mean zero and of variance one over the draws."""
        numbers = np.random.default_rng(self.seed).standard_normal((len(self.draws), 3))
        numbers -= numbers.mean(axis=0)
        return numbers / np.maximum(numbers.std(axis=0, ddof=1), 1e-12) if len(numbers) > 1 else numbers

    @cached_property
    def folded(self) -> float:
        """The share of the draws that turn a tetrahedron of the mesh inside out."""
        return float(np.mean([self.deformer.displaced(u).folded > 0 for u in self.draws]))

    def place(self, points: Float[np.ndarray, "k 3"]) -> tuple[Float[np.ndarray, "k 3"], Location]:
        """Where the posterior mean of u takes points, mm, and where in the fixed image's world what moves them lies."""
        if self.turned:
            return self.mean.sources(self.pose.inverse.place(points))
        location = self.deformer.locate(points)
        return self.pose.place(points + self.mean.displacement(points, location)), location

    def place_by(
        self, draw: int, points: Float[np.ndarray, "k 3"], near: Location, unresolved_sd: Float[np.ndarray, "k 3"]
    ) -> Float[np.ndarray, "k 3"]:
        """Where one of the draws takes points, mm.

        Parameters
        ----------
        draw : int
        points : (k, 3) array
        near : Location
            As `place` gives it.
        unresolved_sd : (k, 3) array
            As `unresolved_sd` gives it there.
        """
        displaced = self.deformer.displaced(self.draws[draw])
        beside = unresolved_sd * self._normal_numbers[draw]
        if self.turned:
            return displaced.sources(self.pose.inverse.place(points), near)[0] - beside
        return self.pose.place(points + displaced.displacement(points, near) + beside)

    def for_each_draw(self, function: Callable[[int], Any]) -> Iterator[Any]:
        """Call a function with the number of each draw, some side by side, and yield what it returns, in order."""
        side_by_side = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        with ThreadPoolExecutor(side_by_side) as pool:
            for first in range(0, len(self.draws), side_by_side):
                yield from pool.map(function, range(first, min(first + side_by_side, len(self.draws))))

    def unresolved_sd(self, near: Location) -> Float[np.ndarray, "k 3"]:
        """What draws of u lack of its standard deviation at points, mm (see above); zero around the mesh."""
        return np.sqrt(self._unresolved_variance(near, self._drawn_covariance(near)))

    def covariance(self, near: Location) -> Float[np.ndarray, "k 3 3"]:
        """The posterior covariance of u at points, mm² (see above), along the axes of the fixed image's world.

        Around the mesh, where no draw is asked, it is NaN.
        """
        drawn = self._drawn_covariance(near)
        found = drawn + self._unresolved_variance(near, drawn)[:, :, None] * np.eye(3)
        found[~self.deformer.is_inside(near)] = np.nan
        return found

    def nodal_covariance(self) -> Float[np.ndarray, "nodes 3 3"]:
        """The posterior covariance of u at the nodes, mm², and of what the mesh cannot follow about them."""
        away = self.draws - self.draws.mean(axis=0)
        found = np.einsum("sni,snj->nij", away, away) / max(len(away) - 1, 1)
        total, volume = np.zeros((len(found), 3)), np.zeros(len(found))
        for corner in self.mesh.cells.T:
            np.add.at(total, corner, self.mesh.volumes[:, None] * self._submesh_variance)
            np.add.at(volume, corner, self.mesh.volumes)
        return found + (total / volume[:, None])[:, :, None] * np.eye(3)

    def _drawn_covariance(self, near: Location) -> Float[np.ndarray, "k 3 3"]:
        """The covariance of the draws, which are linear in every tetrahedron; zero around the mesh."""
        found = np.zeros((len(near.cell), 3, 3))
        inside = self.deformer.is_inside(near)
        cell, share = near.cell[inside], near.barycentric[inside]
        total = np.zeros((len(cell), 3, 3))
        for a, b in product(range(4), repeat=2):
            total += (share[:, a] * share[:, b])[:, None, None] * self._cell_covariance[cell, a, b]
        found[inside] = total
        return found

    def _unresolved_variance(self, near: Location, drawn: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, "k 3"]:
        """The variance of u (the nodes', interpolated, and what the mesh cannot follow) less that of the draws."""
        found = np.zeros((len(near.cell), 3))
        inside = self.deformer.is_inside(near)
        cell, share = near.cell[inside], near.barycentric[inside]
        nodal = np.einsum("ka,kai->ki", share, self._corner_sd[cell]) ** 2
        found[inside] = np.maximum(nodal + self._submesh_variance[cell] - np.einsum("kii->ki", drawn[inside]), 0)
        return found

    @cached_property
    def _corner_sd(self) -> Float[np.ndarray, "cells 4 3"]:
        return np.sqrt(np.einsum("maaii->mai", self._cell_covariance))

    @cached_property
    def _submesh_variance(self) -> Float[np.ndarray, "cells 3"]:
        return submesh_variance(self.mesh, self.u_mean)

    @cached_property
    def _cell_covariance(self) -> Float[np.ndarray, "cells 4 4 3 3"]:
        """The covariance of u between the corners of every tetrahedron."""
        away, cells = self.draws - self.draws.mean(axis=0), self.mesh.cells
        found = np.empty((len(cells), 4, 4, 3, 3))
        # A few tetrahedra at a time: all draws of their corners are in memory.
        for some in slices(len(cells), 500):
            corners = np.moveaxis(away[:, cells[some]], 0, 2)
            for a, b in combinations_with_replacement(range(4), 2):
                found[some, a, b] = np.swapaxes(corners[:, a], 1, 2) @ corners[:, b] / max(len(away) - 1, 1)
                found[some, b, a] = np.swapaxes(found[some, a, b], 1, 2)
        return found


class Spread(NamedTuple):
    """Where points may lie.

    Attributes
    ----------
    places : (k, 3) array
        By the posterior mean of the displacement, mm.
    covariance : (k, 3, 3) array
        Of the draws about that, mm²; NaN around the mesh, where nothing is observed and draws agree with one another
        because the displacement goes on in one way.
    far : (x, k) array
        P(a point lies further from there than so many mm), for each such distance; NaN there, too.
    inside : (k,) bool array
        Whether what moves the point lies in the mesh: outside nothing is observed.
    """

    places: Float[np.ndarray, "k 3"]
    covariance: Float[np.ndarray, "k 3 3"]
    far: Float[np.ndarray, "x k"]
    inside: Bool[np.ndarray, "k"]

    def part(self, chosen: Bool[np.ndarray, "k"]) -> Spread:
        """Take some of the points."""
        return Spread(self.places[chosen], self.covariance[chosen], self.far[:, chosen], self.inside[chosen])

    def ellipsoids(self, probability: float = 0.95) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 3"]]:
        """Half-axes, mm, the longest first, and their directions (rows) of the regions that hold a Normal point."""
        lengths, axes = np.full((len(self.places), 3), np.nan), np.full((len(self.places), 3, 3), np.nan)
        known = np.isfinite(self.covariance).all(axis=(1, 2))
        variance, directions = np.linalg.eigh(self.covariance[known])
        lengths[known] = np.sqrt(np.maximum(variance, 0) * chi2.ppf(probability, 3))[:, ::-1]
        axes[known] = np.swapaxes(directions, 1, 2)[:, ::-1]
        return lengths, axes


def spread(transform: Transform, points: Float[np.ndarray, "k 3"], far: Sequence[float] = ()) -> Spread:
    """Where a transform may take points; a few draws of all points are in memory at a time.

    Parameters
    ----------
    transform : Transform
    points : (k, 3) array
        mm.
    far : sequence of float
        Distances, mm.
    """
    places, near = transform.place(points)
    inside = transform.deformer.is_inside(near)
    known = np.flatnonzero(inside)
    here = Location(near.cell[known], near.barycentric[known])
    square, beyond_far = np.zeros((len(known), 3, 3)), np.zeros((len(far), len(known)))
    sd = transform.unresolved_sd(here)
    for there in transform.for_each_draw(lambda draw: transform.place_by(draw, points[known], here, sd)):
        away = there - places[known]
        square += away[:, :, None] * away[:, None]
        distance = np.linalg.norm(away, axis=1)
        beyond_far += distance > np.reshape(far, (-1, 1))
    count = len(transform.draws)
    covariance, share = np.full((len(points), 3, 3), np.nan), np.full((len(far), len(points)), np.nan)
    covariance[known], share[:, known] = square / max(count - 1, 1), beyond_far / count
    return Spread(places, covariance, share, inside)


class Distances(NamedTuple):
    """How far Normal vectors about zero lie from it.

    Attributes
    ----------
    radius : (k,) array
        Within which 95 % of them lie, mm.
    far : (x, k) array
        P(further than so many mm), for each such distance.
    """

    radius: Float[np.ndarray, "k"]
    far: Float[np.ndarray, "x k"]


def distances_of(covariance: Float[np.ndarray, "k 3 3"], far: Sequence[float] = (), level: float = 0.95) -> Distances:
    """How far Normal vectors of these covariances, mm², lie from zero; NaN where a covariance is.

    |x|² is Σ λ_i z_i² by the eigenvalues λ and independent Normal numbers z, here 1,024 quasi-random ones that all
    share: probabilities are right to 0.01.
    """
    squares = MultivariateNormalQMC(np.zeros(3), rng=np.random.default_rng(0)).random(1024) ** 2
    radius, probability = np.full(len(covariance), np.nan), np.full((len(far), len(covariance)), np.nan)
    known = np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2)))
    for first in range(0, len(known), 20_000):
        some = known[first : first + 20_000]
        square = np.maximum(np.linalg.eigvalsh(covariance[some]), 0) @ squares.T
        for index, distance in enumerate(far):
            probability[index, some] = (square > distance**2).mean(axis=1)
        place = int(np.ceil(level * square.shape[1])) - 1
        radius[some] = np.sqrt(np.partition(square, place, axis=1)[:, place])
    return Distances(radius, probability)
