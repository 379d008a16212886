"""A displacement that is linear in every tetrahedron as a map of space, and its inverse (NumPy, on the host).

Beyond the mesh the displacement goes on as that of the nearest point of its surface: the map is continuous, linear in
the displacements of the nodes, and where the surface bends less than it is folded it has an inverse.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from bayesreg.fem.location import CellSearch, Location, SurfaceSearch, barycentric_maps
from bayesreg.mesh import TetMesh, signed_volumes

# A place lies in a tetrahedron where no barycentric coordinate is below minus this.
TOLERANCE = 1e-9
# Steps from tetrahedron to tetrahedron on the way to the one that holds a place.
MOST_STEPS = 12
# Beyond the mesh: mm between two iterates at which an inverse has been found, and how many there are at most.
PRECISION, MOST_ITERATIONS = 1e-7, 100
CHUNK = 200_000


@dataclass(frozen=True, eq=False)
class Weights:
    """How the displacement of points follows from that of the nodes.

    Attributes
    ----------
    nodes : (k, 4) int array
        The nodes of the tetrahedron that holds each point; beyond the mesh those of the nearest triangle, the first
        of them twice.
    weights : (k, 4) array
        Their shares; a node's second one is zero.
    cell : (k,) int array
        The tetrahedron that holds the point, or that owns the nearest triangle.
    beyond : (k,) array
        Distance from the mesh, mm, zero inside.
    """

    nodes: Int[np.ndarray, "k 4"]
    weights: Float[np.ndarray, "k 4"]
    cell: Int[np.ndarray, "k"]
    beyond: Float[np.ndarray, "k"]

    def __call__(self, values: Float[np.ndarray, "nodes *channels"]) -> Float[np.ndarray, "k *channels"]:
        """Values at the points of what is given at the nodes."""
        found = self.weights[:, 0].reshape(-1, *(1,) * (values.ndim - 1)) * values[self.nodes[:, 0]]
        for corner in range(1, 4):
            share = self.weights[:, corner].reshape(-1, *(1,) * (values.ndim - 1))
            found += share * values[self.nodes[:, corner]]
        return found

    @property
    def inside(self) -> Bool[np.ndarray, "k"]:
        """Which points lie in the mesh."""
        return self.beyond == 0

    def __getitem__(self, which: Bool[np.ndarray, "k"] | slice) -> Weights:
        return Weights(self.nodes[which], self.weights[which], self.cell[which], self.beyond[which])


class Deformer:
    """Deformations of one mesh, there and back: x → x + u(x), for any displacement of its nodes.

    Parameters
    ----------
    mesh : TetMesh
    """

    def __init__(self, mesh: TetMesh) -> None:
        self.mesh = mesh

    @cached_property
    def _cells(self) -> CellSearch:
        return CellSearch(self.mesh.points, self.mesh.cells, queries=CHUNK)

    @cached_property
    def _surface(self) -> SurfaceSearch:
        return SurfaceSearch(self.mesh.points, self.mesh.boundary_faces)

    def weights(self, points: Float[np.ndarray, "k 3"]) -> Weights:
        """Where points lie, mm, and how they follow the nodes."""
        mesh = self.mesh
        cell, barycentric = self._cells(points, TOLERANCE)
        found = Weights(mesh.cells[cell], barycentric, cell, np.zeros(len(points)))
        out = np.flatnonzero(cell < 0)
        if len(out):
            face, share = self._surface(points[out])
            triangle = mesh.boundary_faces[face]
            found.nodes[out], found.weights[out] = triangle[:, [0, 1, 2, 0]], np.pad(share, ((0, 0), (0, 1)))
            found.cell[out] = mesh.boundary_cells[face]
            nearest = np.einsum("ka,kai->ki", share, mesh.points[triangle])
            # What lies on the surface by rounding is beyond it, by next to nothing.
            found.beyond[out] = np.maximum(np.linalg.norm(points[out] - nearest, axis=1), np.finfo(float).tiny)
        return found

    def moved(self, u: Float[np.ndarray, "nodes 3"]) -> Moved:
        """The mesh with its nodes displaced, mm, which leads back."""
        return Moved(self, np.asarray(u, float))


class Moved:
    """A displaced mesh, which finds where its places came from.

    Attributes
    ----------
    folded : int
        How many tetrahedra are turned inside out; places in these have several sources, and get one of them.
    """

    def __init__(self, deformer: Deformer, u: Float[np.ndarray, "nodes 3"]) -> None:
        self._of, self.u = deformer, u
        self._points = deformer.mesh.points + u
        self._upright = signed_volumes(self._points, deformer.mesh.cells) > 0
        self.folded = int((~self._upright).sum())

    @cached_property
    def _to_barycentric(self) -> Float[np.ndarray, "cells 4 4"]:
        """Coordinate a of a place y in a displaced tetrahedron is row a times (1, y); NaN where it is turned over."""
        corners = self._points[self._of.mesh.cells]
        linear = np.full((len(corners), 4, 3), np.nan)
        linear[self._upright] = barycentric_maps(corners[self._upright])
        constant = -np.einsum("mai,mi->ma", linear, corners[:, 0])
        constant[:, 0] += 1
        return np.concatenate([constant[..., None], linear], axis=2)

    @cached_property
    def _cells(self) -> tuple[CellSearch, Int[np.ndarray, "upright"]]:
        upright = np.flatnonzero(self._upright)
        return CellSearch(self._points, self._of.mesh.cells[upright], queries=CHUNK), upright

    @cached_property
    def _surface(self) -> SurfaceSearch:
        return SurfaceSearch(self._points, self._of.mesh.boundary_faces)

    def sources(
        self,
        places: Float[np.ndarray, "k 3"],
        near: Weights | None = None,
        iterations: int = MOST_ITERATIONS,
    ) -> tuple[Float[np.ndarray, "k 3"], Weights]:
        """The points x with x + u(x) = y, mm, and how they follow the nodes.

        Parameters
        ----------
        places : (k, 3) array
            y, mm.
        near : Weights, optional
            The sources by a displacement that differs little, where the search begins.
        iterations : int
            Searches for the nearest point of the surface, at most, of each source beyond the mesh. With 0 that of
            `near` is taken, and the error is what the displacement of the surface changes over the difference of u.

        Notes
        -----
        Inside the displaced mesh y has barycentric coordinates in one tetrahedron, and x has the same: no more than
        rounding stands between the two. Beyond it x = y − u(x) is iterated, a contraction where the map is one to one.
        """
        mesh = self._of.mesh
        cell, barycentric = self._search(places, near)
        inside = cell >= 0
        weights = Weights(mesh.cells[cell], barycentric, cell, np.zeros(len(places)))
        points = weights(mesh.points)
        if not inside.all():
            out = np.flatnonzero(~inside)
            start = None if near is None else near[~inside]
            points[out], beyond = self._beyond(places[out], start, iterations)
            weights.nodes[out], weights.weights[out] = beyond.nodes, beyond.weights
            weights.cell[out], weights.beyond[out] = beyond.cell, beyond.beyond
        return points, weights

    def _search(self, places: Float[np.ndarray, "k 3"], near: Weights | None) -> Location:
        """The displaced tetrahedra that hold places, first by steps from those near by, then by search."""
        if near is None:
            cell, barycentric = self._cells[0](places, TOLERANCE)
            return Location(np.where(cell < 0, -1, self._cells[1][cell]), barycentric)
        across = self._of.mesh.across
        cell, barycentric = near.cell.copy(), np.empty((len(places), 4))
        left = np.arange(len(places))
        lost = []
        for _ in range(MOST_STEPS):
            here = cell[left]
            maps = self._to_barycentric[here]
            found = np.einsum("kai,ki->ka", maps[:, :, 1:], places[left]) + maps[:, :, 0]
            barycentric[left] = found
            least = found.argmin(axis=1)
            # Where a tetrahedron is turned over nothing is less than NaN: such places are searched for.
            outside = ~(found[np.arange(len(left)), least] >= -TOLERANCE)
            left, onwards = left[outside], across[here[outside], least[outside]]
            stuck = (onwards < 0) | np.isnan(found[outside]).any(axis=1)
            lost.append(left[stuck])
            left, onwards = left[~stuck], onwards[~stuck]
            cell[left] = onwards
            if not len(left):
                break
        lost = np.concatenate([*lost, left])
        if len(lost):
            found_cell, barycentric[lost] = self._search(places[lost], None)
            cell[lost] = found_cell
        return Location(cell, barycentric)

    def _beyond(
        self, places: Float[np.ndarray, "k 3"], near: Weights | None, iterations: int
    ) -> tuple[Float[np.ndarray, "k 3"], Weights]:
        """Sources of places beyond the displaced mesh."""
        if near is None:
            face, share = self._surface(places)
            points = places - np.einsum("ka,kai->ki", share, self.u[self._of.mesh.boundary_faces[face]])
            weights = self._of.weights(points)
        else:
            points, weights = places - near(self.u), near
        if not iterations:
            return points, weights
        left = np.arange(len(places))
        weights = Weights(*(array.copy() for array in (weights.nodes, weights.weights, weights.cell, weights.beyond)))
        for _ in range(iterations):
            found = self._of.weights(points[left])
            weights.nodes[left], weights.weights[left] = found.nodes, found.weights
            weights.cell[left], weights.beyond[left] = found.cell, found.beyond
            onwards = places[left] - found(self.u)
            moved = np.abs(onwards - points[left]).max(axis=1) > PRECISION
            points[left] = onwards
            left = left[moved]
            if not len(left):
                break
        return points, weights


def transfer(
    u: Float[np.ndarray, "nodes 3"], from_mesh: TetMesh, points: Float[np.ndarray, "queries 3"]
) -> Float[np.ndarray, "queries 3"]:
    """Values at any points of a P1 function given at the nodes of a mesh.

    Parameters
    ----------
    u : (n, 3) array
        Values at the nodes of `from_mesh`, for instance displacements in mm.
    from_mesh : TetMesh
    points : (k, 3) array
        Positions, mm. Outside the mesh the value at the nearest point of its surface is taken.

    Returns
    -------
    (k, 3) array
    """
    return Deformer(from_mesh).weights(points)(np.asarray(u, float))
