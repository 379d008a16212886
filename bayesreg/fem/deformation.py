"""The map of space that a displacement, linear in every tetrahedron, defines, and its inverse (NumPy, on the host).

`bayesreg.fem.surroundings` extends the displacement beyond the mesh, so that every point has an image and a source.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from bayesreg.fem.location import CellSearch, Location, barycentric_maps
from bayesreg.fem.surroundings import Surroundings, surround
from bayesreg.mesh import TetMesh, faces_across, signed_volumes

# A point lies in a tetrahedron if no barycentric coordinate is below −TOLERANCE. A point that rounding leaves between
# two tetrahedra lies in one of them if none is below −GAP.
TOLERANCE, GAP = 1e-9, 1e-4
# The greatest number of steps between neighbouring tetrahedra in the search for the one that holds a point.
MOST_STEPS = 12
# At most this number of points are tried in all tetrahedra.
FEW = 100
CHUNK = 200_000


class Deformer:
    """The search for points in a mesh and its surroundings, and the maps that displacements of its nodes define.

    Parameters
    ----------
    mesh : TetMesh
    """

    def __init__(self, mesh: TetMesh) -> None:
        self.mesh = mesh

    @cached_property
    def surroundings(self) -> Surroundings:
        """The mesh with the tetrahedra around it."""
        return surround(self.mesh)

    @cached_property
    def across(self) -> Int[np.ndarray, "all_cells 4"]:
        """The tetrahedron beyond the face opposite to each corner; −1 if there is none."""
        return faces_across(self.surroundings.cells)

    @cached_property
    def _search(self) -> CellSearch:
        return CellSearch(self.surroundings.points, self.surroundings.cells, queries=CHUNK)

    def locate(self, points: Float[np.ndarray, "k 3"]) -> Location:
        """Find the tetrahedra that hold points, mm; those of the mesh are numbered first; −1 beyond the sphere."""
        return _search_twice(self._search, points)

    def is_inside(self, location: Location) -> Bool[np.ndarray, "k"]:
        """Mark the points that lie in the mesh itself."""
        return (location.cell >= 0) & (location.cell < len(self.mesh.cells))

    def displaced(self, u: Float[np.ndarray, "nodes 3"]) -> Displaced:
        """Displace the nodes of the mesh, mm."""
        return Displaced(self, np.asarray(u, float))


@dataclass(frozen=True, eq=False)
class Displaced:
    """A displaced mesh, with the displacement of points and its inverse.

    Attributes
    ----------
    deformer : Deformer
    u : (n, 3) array
        Displacement of every node, mm.
    """

    deformer: Deformer
    u: Float[np.ndarray, "nodes 3"]

    @cached_property
    def _everywhere(self) -> Float[np.ndarray, "all_nodes 3"]:
        return self.deformer.surroundings.extend(self.u)

    @cached_property
    def _points(self) -> Float[np.ndarray, "all_nodes 3"]:
        return self.deformer.surroundings.points + self._everywhere

    @cached_property
    def _upright(self) -> Bool[np.ndarray, "all_cells"]:
        return signed_volumes(self._points, self.deformer.surroundings.cells) > 0

    @property
    def folded(self) -> int:
        """The number of tetrahedra of the mesh that are turned inside out; points in these have several sources."""
        return int((~self._upright[: len(self.deformer.mesh.cells)]).sum())

    def displacement(self, points: Float[np.ndarray, "k 3"], location: Location) -> Float[np.ndarray, "k 3"]:
        """Compute the displacement of points, mm; `location` is the result of `Deformer.locate` for them."""
        displacements = _interpolate(self._everywhere, self.deformer.surroundings.cells, location)
        far = location.cell < 0
        if far.any():
            surroundings = self.deformer.surroundings
            displacements[far] = surroundings.move_rigidly(surroundings.rigid_motion(self.u), points[far])
        return displacements

    @cached_property
    def _to_barycentric(self) -> Float[np.ndarray, "all_cells 4 4"]:
        """The maps to barycentric coordinates: coordinate a of y in a displaced tetrahedron is row a times (1, y).

        A map is NaN if its tetrahedron is turned inside out.
        """
        corners = self._points[self.deformer.surroundings.cells]
        linear = np.full((len(corners), 4, 3), np.nan)
        linear[self._upright] = barycentric_maps(corners[self._upright])
        constant = -np.einsum("mai,mi->ma", linear, corners[:, 0])
        constant[:, 0] += 1
        return np.concatenate([constant[..., None], linear], axis=2)

    @cached_property
    def _search(self) -> tuple[CellSearch, Int[np.ndarray, "upright"]]:
        upright = np.flatnonzero(self._upright)
        return CellSearch(self._points, self.deformer.surroundings.cells[upright], queries=CHUNK), upright

    def sources(
        self, places: Float[np.ndarray, "k 3"], near: Location | None = None
    ) -> tuple[Float[np.ndarray, "k 3"], Location]:
        """Compute the points x with x + u(x) = y, mm, and their location in the mesh at rest.

        Parameters
        ----------
        places : (k, 3) array
            y, mm.
        near : Location, optional
            The location of the sources for a similar displacement, where the search begins.

        Notes
        -----
        The source has the same barycentric coordinates in a tetrahedron at rest as y has in the displaced one, so that
        the inverse is exact up to rounding. If tetrahedra are folded, one of several sources is returned.
        """
        location = self._locate(places) if near is None else self._step(places, near)
        surroundings = self.deformer.surroundings
        points = _interpolate(surroundings.points, surroundings.cells, location)
        far = location.cell < 0
        if far.any():
            points[far] = self._rigid_sources(places[far])
        return points, location

    def _locate(self, places: Float[np.ndarray, "k 3"]) -> Location:
        if len(places) <= FEW:
            return self._try_all(places)
        search, upright = self._search
        cell, barycentric = _search_twice(search, places)
        return Location(np.where(cell < 0, -1, upright[cell]), barycentric)

    def _try_all(self, places: Float[np.ndarray, "k 3"]) -> Location:
        """Find a few points by trying all tetrahedra, without the preparation of a `CellSearch`."""
        maps = self._to_barycentric
        coordinates = np.einsum("mai,ki->kma", maps[:, :, 1:], places) + maps[:, :, 0]
        least = np.nan_to_num(coordinates.min(axis=2), nan=-np.inf)
        cell = np.where((least >= -TOLERANCE).any(axis=1), (least >= -TOLERANCE).argmax(axis=1), least.argmax(axis=1))
        rows = np.arange(len(places))
        barycentric = coordinates[rows, cell]
        cell[least[rows, cell] < -GAP] = -1
        return Location(cell, barycentric)

    def _step(self, places: Float[np.ndarray, "k 3"], near: Location) -> Location:
        """Find the displaced tetrahedra that hold points, by steps from `near`, or by a search if that fails."""
        across, cell = self.deformer.across, near.cell.copy()
        barycentric, left = np.full((len(places), 4), np.nan), np.flatnonzero(cell >= 0)
        lost = [np.flatnonzero(cell < 0)]
        for _ in range(MOST_STEPS):
            current = cell[left]
            maps = self._to_barycentric[current]
            coordinates = np.einsum("kai,ki->ka", maps[:, :, 1:], places[left]) + maps[:, :, 0]
            barycentric[left] = coordinates
            least = coordinates.argmin(axis=1)
            # In a tetrahedron that is turned inside out all coordinates are NaN: its points are left to the search.
            outside = ~(coordinates[np.arange(len(left)), least] >= -TOLERANCE)
            left, onwards = left[outside], across[current[outside], least[outside]]
            stuck = (onwards < 0) | np.isnan(coordinates[outside]).any(axis=1)
            lost.append(left[stuck])
            left, onwards = left[~stuck], onwards[~stuck]
            cell[left] = onwards
            if not len(left):
                break
        rest = np.concatenate([*lost, left])
        if len(rest):
            cell[rest], barycentric[rest] = self._locate(places[rest])
        return Location(cell, barycentric)

    def _rigid_sources(self, places: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
        """Compute the sources of points beyond the sphere, where y = x + a + ω × (x − c)."""
        surroundings = self.deformer.surroundings
        motion = surroundings.rigid_motion(self.u)
        linear = np.eye(3) + np.cross(motion[3:], np.eye(3)).T
        return surroundings.centre + np.linalg.solve(linear, (places - surroundings.centre - motion[:3]).T).T


def _interpolate(
    values: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"], location: Location
) -> Float[np.ndarray, "k 3"]:
    """Interpolate nodal values at points; the result is NaN for points in no tetrahedron."""
    corners = cells[location.cell]
    interpolated = location.barycentric[:, :1] * values[corners[:, 0]]
    for corner in range(1, 4):
        interpolated += location.barycentric[:, corner : corner + 1] * values[corners[:, corner]]
    return interpolated


def _search_twice(search: CellSearch, points: Float[np.ndarray, "k 3"]) -> Location:
    """Find the tetrahedra that hold points; repeat with a larger tolerance for points between two tetrahedra."""
    cell, barycentric = search(points, TOLERANCE)
    out = np.flatnonzero(cell < 0)
    if len(out):
        cell[out], barycentric[out] = search(points[out], GAP)
    return Location(cell, barycentric)
