"""A displacement that is linear in every tetrahedron as a map of space, and its inverse (NumPy, on the host).

Around the mesh it goes on as `bayesreg.fem.surroundings` says, so that there is an image, and a source, of every point.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from bayesreg.fem.location import CellSearch, Location, barycentric_maps
from bayesreg.fem.surroundings import Surroundings, surround
from bayesreg.mesh import TetMesh, faces_across, signed_volumes

# A place lies in a tetrahedron where no barycentric coordinate is below minus this; between two that a rounding parts,
# minus the second.
TOLERANCE, GAP = 1e-9, 1e-4
# Steps from tetrahedron to tetrahedron on the way to the one that holds a place.
MOST_STEPS = 12
# So few places are tried in all tetrahedra.
FEW = 100
CHUNK = 200_000


class Deformer:
    """Where the points of space lie in a mesh and around it, and what displacements of its nodes do to them.

    Parameters
    ----------
    mesh : TetMesh
    """

    def __init__(self, mesh: TetMesh) -> None:
        self.mesh = mesh

    @cached_property
    def surroundings(self) -> Surroundings:
        """The mesh and what surrounds it."""
        return surround(self.mesh)

    @cached_property
    def across(self) -> Int[np.ndarray, "all_cells 4"]:
        """The tetrahedron beyond the face opposite to each corner; −1 where there is none."""
        return faces_across(self.surroundings.cells)

    @cached_property
    def _search(self) -> CellSearch:
        return CellSearch(self.surroundings.points, self.surroundings.cells, queries=CHUNK)

    def locate(self, points: Float[np.ndarray, "k 3"]) -> Location:
        """Find the tetrahedron of points, mm: of the mesh, which come first, or around it; −1 beyond the sphere."""
        return _search_twice(self._search, points)

    def is_inside(self, location: Location) -> Bool[np.ndarray, "k"]:
        """Tell which points lie in the mesh itself."""
        return (location.cell >= 0) & (location.cell < len(self.mesh.cells))

    def displaced(self, u: Float[np.ndarray, "nodes 3"]) -> Displaced:
        """The mesh with its nodes displaced, mm."""
        return Displaced(self, np.asarray(u, float))


@dataclass(frozen=True, eq=False)
class Displaced:
    """A displaced mesh: it knows where points went, and where places came from.

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
        """How many tetrahedra of the mesh are turned inside out; places in these have several sources."""
        return int((~self._upright[: len(self.deformer.mesh.cells)]).sum())

    def displacement(self, points: Float[np.ndarray, "k 3"], location: Location) -> Float[np.ndarray, "k 3"]:
        """Displacement of points, mm, which lie where `Deformer.locate` has found them."""
        found = _interpolate(self._everywhere, self.deformer.surroundings.cells, location)
        far = location.cell < 0
        if far.any():
            around = self.deformer.surroundings
            found[far] = around.move_rigidly(around.rigid_motion(self.u), points[far])
        return found

    @cached_property
    def _to_barycentric(self) -> Float[np.ndarray, "all_cells 4 4"]:
        """Coordinate a of a place y in a displaced tetrahedron is row a times (1, y); NaN where it is turned over."""
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
        """The points x with x + u(x) = y, mm, and where they lie.

        Parameters
        ----------
        places : (k, 3) array
            y, mm.
        near : Location, optional
            Of the sources by a displacement that differs little, where the search begins.

        Notes
        -----
        A place has barycentric coordinates in one displaced tetrahedron, and its source has the same in the one at
        rest: no more than rounding stands between the two. Where tetrahedra are folded one of several sources is taken.
        """
        location = self._locate(places) if near is None else self._step(places, near)
        around = self.deformer.surroundings
        points = _interpolate(around.points, around.cells, location)
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
        """Find few places in all tetrahedra, without what it takes to search for many."""
        maps = self._to_barycentric
        found = np.einsum("mai,ki->kma", maps[:, :, 1:], places) + maps[:, :, 0]
        least = np.nan_to_num(found.min(axis=2), nan=-np.inf)
        cell = np.where((least >= -TOLERANCE).any(axis=1), (least >= -TOLERANCE).argmax(axis=1), least.argmax(axis=1))
        rows = np.arange(len(places))
        barycentric = found[rows, cell]
        cell[least[rows, cell] < -GAP] = -1
        return Location(cell, barycentric)

    def _step(self, places: Float[np.ndarray, "k 3"], near: Location) -> Location:
        """The displaced tetrahedra that hold places, by steps from those near by, else by search."""
        across, cell = self.deformer.across, near.cell.copy()
        barycentric, left = np.full((len(places), 4), np.nan), np.flatnonzero(cell >= 0)
        lost = [np.flatnonzero(cell < 0)]
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
        rest = np.concatenate([*lost, left])
        if len(rest):
            cell[rest], barycentric[rest] = self._locate(places[rest])
        return Location(cell, barycentric)

    def _rigid_sources(self, places: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
        """Beyond the sphere y = x + a + ω × (x − c)."""
        around = self.deformer.surroundings
        motion = around.rigid_motion(self.u)
        linear = np.eye(3) + np.cross(motion[3:], np.eye(3)).T
        return around.centre + np.linalg.solve(linear, (places - around.centre - motion[:3]).T).T


def _interpolate(
    values: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"], location: Location
) -> Float[np.ndarray, "k 3"]:
    """Nodal values at points; NaN where these lie in no tetrahedron."""
    corners = cells[location.cell]
    found = location.barycentric[:, :1] * values[corners[:, 0]]
    for corner in range(1, 4):
        found += location.barycentric[:, corner : corner + 1] * values[corners[:, corner]]
    return found


def _search_twice(search: CellSearch, points: Float[np.ndarray, "k 3"]) -> Location:
    """Search once more, less strictly, for points that fell between two tetrahedra."""
    cell, barycentric = search(points, TOLERANCE)
    out = np.flatnonzero(cell < 0)
    if len(out):
        cell[out], barycentric[out] = search(points[out], GAP)
    return Location(cell, barycentric)
