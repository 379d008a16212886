"""The surroundings of a mesh: tetrahedra between the mesh and a sphere, to which its displacements are extended.

There are no observations and there is no model outside the mesh. The extension is the sum of the nearest rigid motion
and a harmonic part, which is zero on the sphere; beyond the sphere it is the rigid motion. It is continuous, linear in
the displacements of the mesh's nodes, and linear in every tetrahedron, so that it is inverted as inside the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay, cKDTree

from bayesreg.fem.location import CellSearch
from bayesreg.mesh import TetMesh, signed_volumes
from bayesreg.pose import rigid_projection

# The radius of the sphere, in radii of the smallest sphere about the mesh's centre that holds the mesh; and the number
# of nodes on it.
RADIUS, ON_SPHERE = 2.0, 400
# Shells of nodes between the surface and the sphere, in mean edges of the surface: least distance from the surface,
# greatest distance, and spacing.
SHELLS = ((0.8, 2.0, 1.0), (2.0, 5.0, 2.0), (5.0, 1e9, 4.0))
# The surface is refined until its triangles are faces of the surroundings. The limits are: the number of rounds, the
# number of nodes in multiples of those of the surface, and the shortest edge as a share of the mean edge.
MOST_ROUNDS, MOST_NODES, FINEST = 20, 12, 1 / 16


@dataclass(frozen=True, eq=False)
class Surroundings:
    """A mesh and the tetrahedra around it.

    Attributes
    ----------
    mesh : TetMesh
        The mesh itself.
    points : (N, 3) array
        The nodes of the mesh, then those around it, mm.
    cells : (M, 4) int array
        The tetrahedra of the mesh, then those around it.
    harmonic : (N − n, b) matrix
        The map from the harmonic part at the nodes of the mesh's boundary to that at the nodes around the mesh.
    centre : (3,) array
        The centre of rotation of the rigid motion, mm.
    projection : (6, n, 3) array
        See `bayesreg.pose.rigid_projection`.
    """

    mesh: TetMesh
    points: Float[np.ndarray, "all_nodes 3"]
    cells: Int[np.ndarray, "all_cells 4"]
    harmonic: Float[np.ndarray, "around boundary"]
    centre: Float[np.ndarray, "3"]
    projection: Float[np.ndarray, "6 nodes 3"]

    def rigid_motion(self, u: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "6"]:
        """Compute the small rigid motion nearest to a displacement: translation, mm, and rotation vector, radians."""
        return np.einsum("aki,ki->a", self.projection, u)

    def move_rigidly(self, motion: Float[np.ndarray, "6"], points: Float[np.ndarray, "k 3"]) -> np.ndarray:
        """Compute the displacement of points by a small rigid motion, mm; linear in the motion and in the points."""
        return motion[:3] + np.cross(motion[3:], points - self.centre)

    def extend(self, u: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "all_nodes 3"]:
        """Extend a displacement of the mesh's nodes, mm, to the nodes around the mesh."""
        motion, boundary = self.rigid_motion(u), self.mesh.boundary
        rest = u[boundary] - self.move_rigidly(motion, self.mesh.points[boundary])
        outer_points = self.points[len(self.mesh.points) :]
        return np.concatenate([u, self.move_rigidly(motion, outer_points) + self.harmonic @ rest])


def surround(mesh: TetMesh) -> Surroundings:
    """Fill the space between a mesh and a sphere about it with tetrahedra.

    Notes
    -----
    The tetrahedra are a Delaunay tetrahedralisation of the nodes on the boundary, of nodes on the sphere and of a
    lattice between them that becomes coarser with the distance. Some triangles of the surface are not faces of it.
    Their edges are halved until all triangles are faces (conforming Delaunay refinement); the displacement of a new
    node is the mean of those at the ends of its edge. If the surface has sharp creases, the refinement may reach its
    limits first, and some tetrahedra then extend a little into the mesh. A point in the mesh is never searched for in
    these tetrahedra.
    """
    centre, projection = rigid_projection(mesh.points, mesh.nodal_volumes)
    surface = _Surface.of(mesh)
    outer_points = np.concatenate([_lattice(mesh, centre), _sphere(mesh, centre)])
    cells = Delaunay(np.concatenate([surface.points, outer_points])).simplices
    for _ in range(MOST_ROUNDS):
        refined = surface.refined(surface.missing(cells))
        if not len(surface.points) < len(refined.points) < MOST_NODES * len(mesh.boundary):
            break
        surface = refined
        cells = Delaunay(np.concatenate([surface.points, outer_points])).simplices
    points = np.concatenate([surface.points, outer_points])
    cells = _outside(mesh, points, cells)
    count = len(surface.points)
    harmonic = _harmonic(points, cells, surface.weights, count, len(points) - ON_SPHERE)
    # The nodes of the mesh's boundary come first; they are nodes of the mesh, too.
    boundary_count = len(mesh.boundary)
    number = np.concatenate([mesh.boundary, len(mesh.points) + np.arange(len(points) - boundary_count)])
    return Surroundings(
        mesh=mesh,
        points=np.concatenate([mesh.points, points[boundary_count:]]),
        cells=np.concatenate([mesh.cells, number[cells]]),
        harmonic=harmonic[boundary_count:],
        centre=centre,
        projection=projection,
    )


@dataclass(frozen=True, eq=False)
class _Surface:
    """A triangulation that refines the boundary of a mesh.

    Attributes
    ----------
    points : (p, 3) array
        The nodes of the boundary, then the midpoints of halved edges, mm.
    triangles : (t, 3) int array
    weights : (p, b) sparse matrix
        The weights of each point as a mean of the nodes of the boundary.
    finest : float
        The length below which edges are not halved, mm.
    """

    points: Float[np.ndarray, "p 3"]
    triangles: Int[np.ndarray, "t 3"]
    weights: scipy.sparse.csr_array
    finest: float

    @classmethod
    def of(cls, mesh: TetMesh) -> _Surface:
        triangles = np.searchsorted(mesh.boundary, mesh.boundary_faces)
        points = mesh.points[mesh.boundary]
        return cls(points, triangles, scipy.sparse.eye_array(len(points), format="csr"), FINEST * mesh.boundary_edge)

    def missing(self, cells: Int[np.ndarray, "cells 4"]) -> Bool[np.ndarray, "t"]:
        """Mark the triangles that are not faces of the tetrahedra."""
        faces = np.concatenate([np.delete(cells, corner, axis=1) for corner in range(4)])
        return ~np.isin(self._keys(self.triangles), self._keys(faces[(faces < len(self.points)).all(axis=1)]))

    def _keys(self, triangles: Int[np.ndarray, "t 3"]) -> Int[np.ndarray, "t"]:
        """Compute a number for each triangle that does not depend on the order of its corners."""
        ordered, count = np.sort(triangles, axis=1).astype(np.int64), len(self.points)
        return (ordered[:, 0] * count + ordered[:, 1]) * count + ordered[:, 2]

    def refined(self, which: Bool[np.ndarray, "t"]) -> _Surface:
        """Halve the longest edge of some triangles, which also cuts the triangle on the other side of that edge."""
        corner = self.points[self.triangles]
        length = np.linalg.norm(corner - np.roll(corner, -1, axis=1), axis=2)
        longest = length.argmax(axis=1)
        rows = np.flatnonzero(which & (length.max(axis=1) > self.finest))
        if not len(rows):
            return self
        ends = np.stack([self.triangles, np.roll(self.triangles, -1, axis=1)], axis=2)
        chosen = np.unique(np.sort(ends[rows, longest[rows]], axis=1), axis=0)
        middle = {(int(a), int(b)): len(self.points) + k for k, (a, b) in enumerate(chosen)}
        triangles: list[tuple[int, int, int]] = []
        for triangle in self.triangles.tolist():
            triangles += _split(triangle, middle)
        halves = self.weights[chosen[:, 0]] / 2 + self.weights[chosen[:, 1]] / 2
        return _Surface(
            np.concatenate([self.points, self.points[chosen].mean(axis=1)]),
            np.array(triangles),
            scipy.sparse.vstack([self.weights, halves], format="csr"),
            self.finest,
        )


def _split(triangle: list[int], middle: dict[tuple[int, int], int]) -> list[tuple[int, int, int]]:
    """Cut a triangle at the midpoints of its halved edges, one edge after the other."""
    for start in range(3):
        a, b, c = triangle[start], triangle[(start + 1) % 3], triangle[(start + 2) % 3]
        new = middle.get((min(a, b), max(a, b)))
        if new is not None:
            return [*_split([a, new, c], middle), *_split([new, b, c], middle)]
    return [(triangle[0], triangle[1], triangle[2])]


def _sphere(mesh: TetMesh, centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "k 3"]:
    """Compute nodes on the sphere along a Fibonacci spiral."""
    index = np.arange(ON_SPHERE) + 0.5
    z, turn = 1 - 2 * index / ON_SPHERE, np.pi * (1 + 5**0.5) * index
    flat = np.sqrt(1 - z**2)
    return centre + _radius(mesh, centre) * np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def _radius(mesh: TetMesh, centre: Float[np.ndarray, "3"]) -> float:
    return RADIUS * float(np.linalg.norm(mesh.points - centre, axis=1).max())


def _lattice(mesh: TetMesh, centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "k 3"]:
    """Compute nodes of a body-centred lattice between the surface and the sphere.

    The nodes have small random shifts, so that no five of them lie on one sphere.
    """
    edge, radius, rng = mesh.boundary_edge, _radius(mesh, centre), np.random.default_rng(0)
    search, boundary, shells = CellSearch(mesh.points, mesh.cells), _samples(mesh), []
    for nearest, furthest, separation in SHELLS:
        spacing = 1.25 * separation * edge
        reach = np.minimum(np.ptp(mesh.points, axis=0).max() / 2 + furthest * edge, radius)
        ticks = np.arange(-reach, reach + spacing, spacing)
        grid = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        points = centre + np.concatenate([grid, grid + spacing / 2])
        points = points + 0.1 * spacing * rng.uniform(-1, 1, points.shape)
        distance = boundary.query(points)[0] / edge
        within = np.linalg.norm(points - centre, axis=1) < radius - 0.6 * separation * edge
        points = points[(distance >= nearest) & (distance < furthest) & within]
        shells.append(points[search(points).cell < 0])
    return np.concatenate(shells)


def _samples(mesh: TetMesh) -> cKDTree:
    """Make a search tree of the corners, midpoints of edges and centres of the triangles of the surface."""
    corner = mesh.points[mesh.boundary_faces]
    edges = (corner + np.roll(corner, -1, axis=1)) / 2
    return cKDTree(np.concatenate([mesh.points[mesh.boundary], edges.reshape(-1, 3), corner.mean(axis=1)]))


def _outside(
    mesh: TetMesh, points: Float[np.ndarray, "k 3"], cells: Int[np.ndarray, "cells 4"]
) -> Int[np.ndarray, "some 4"]:
    """Select the tetrahedra that lie outside of a mesh, and orient them positively."""
    volumes = signed_volumes(points, cells)
    cells = np.where((volumes < 0)[:, None], cells[:, [1, 0, 2, 3]], cells)
    longest = np.ptp(points[cells], axis=1).max(axis=1)
    cells = cells[np.abs(volumes) > 1e-9 * longest**3]
    return cells[CellSearch(mesh.points, mesh.cells)(points[cells].mean(axis=1)).cell < 0]


def _harmonic(
    points: Float[np.ndarray, "k 3"],
    cells: Int[np.ndarray, "cells 4"],
    surface: scipy.sparse.csr_array,
    first: int,
    last: int,
) -> Float[np.ndarray, "k boundary"]:
    """Compute the harmonic extension from the surface (the first nodes) to zero on the sphere (the last nodes).

    The weight of an edge in the Laplacian is its length, as the ratio of face area to distance is in a regular mesh.
    With positive weights every value is a mean of the values at its neighbours, and so of the values on the surface,
    even if tetrahedra are flat. The Laplacian of finite elements does not have this property.
    """
    pairs = np.array(list(combinations(range(4), 2)))
    start, end = np.unique(np.sort(cells[:, pairs].reshape(-1, 2), axis=1), axis=0).T
    length = np.linalg.norm(points[start] - points[end], axis=1)
    count = len(points)
    links = scipy.sparse.coo_array((length, (start, end)), (count, count))
    links = (links + links.T).tocsr()
    laplacian = (scipy.sparse.diags_array(links.sum(axis=1)) - links).tocsr()
    extension = np.zeros((count, surface.shape[1]))
    extension[:first] = surface.toarray()
    # A node that belongs to no tetrahedron outside the mesh, for instance within a crease, is not needed.
    used = np.setdiff1d(cells, [*range(first), *range(last, count)])
    inner = laplacian[used]
    extension[used] = splu(inner[:, used].tocsc()).solve(-(inner[:, :first] @ extension[:first]))
    return extension
