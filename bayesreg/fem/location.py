"""Search for the tetrahedron that holds a point, and evaluation of P1 functions at points (NumPy, on the host)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from bayesreg.mesh import TetMesh
from bayesreg.types import InputError

_CHUNK, _THREADS = 50_000, 4


class Location(NamedTuple):
    """The location of points in a mesh.

    Attributes
    ----------
    cell : (k,) int array
        The tetrahedron (or triangle) of each point; −1 outside.
    barycentric : (k, 4) or (k, 3) array
        Barycentric coordinates there; NaN outside.
    """

    cell: Int[np.ndarray, "queries"]
    barycentric: Float[np.ndarray, "queries corners"]


def locate(
    points: Float[np.ndarray, "nodes 3"],
    cells: Int[np.ndarray, "cells 4"],
    query: Float[np.ndarray, "queries 3"],
    tolerance: float = 1e-9,
) -> Location:
    """Find the tetrahedron that holds each point.

    Parameters
    ----------
    points : (n, 3) array
        Nodes of a mesh at rest or of a deformed mesh, mm.
    cells : (m, 4) int array
        Tetrahedra of positive volume.
    query : (k, 3) array
        Points, mm.
    tolerance : float, default 1e-9
        The greatest distance of a barycentric coordinate below zero, so that no point falls between two cells.

    Returns
    -------
    Location
        The location of each point. If two or more cells hold a point, it is the cell with the lowest index.

    Notes
    -----
    A grid of bins lists the cells that reach into each bin, and each point is tested in the cells of its own bin. A
    million points take about a second.
    """
    return CellSearch(points, cells, queries=len(query))(query, tolerance)


class CellSearch:
    """The search for tetrahedra (`locate`), prepared once for many points or many times.

    Parameters
    ----------
    points, cells
        As in `locate`.
    queries : int
        The approximate number of points, which determines the number of bins.
    """

    def __init__(
        self, points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"], queries: int = 0
    ) -> None:
        corners = points[cells]
        self._origin, self._to_barycentric = corners[:, 0], barycentric_maps(corners)
        self._bins = _Bins(corners, self._to_barycentric, pairs=min(max(queries // 4, 30 * len(cells)), 3_000_000))

    def __call__(self, query: Float[np.ndarray, "queries 3"], tolerance: float = 1e-9) -> Location:
        """Find the tetrahedron that holds each point; see `locate`."""
        return _in_threads(
            lambda points: _search(points, self._bins, self._origin, self._to_barycentric, tolerance), query, 4
        )


def interpolation_at(
    mesh: TetMesh, points: Float[np.ndarray, "k 3"], labels: Sequence[str] | None = None
) -> tuple[Int[np.ndarray, "k 4"], Float[np.ndarray, "k 4"]]:
    """Find the nodes and barycentric weights of points inside a mesh.

    Parameters
    ----------
    mesh : TetMesh
    points : (k, 3) array
        World RAS, mm.
    labels : sequence of str, optional
        The name of each point in an error, such as "place 'ventricle'"; the default is its number.

    Raises
    ------
    InputError
        If a point lies outside the mesh, where no displacement is estimated.
    """
    # Rounding may put nodes on a curved boundary outside of every cell.
    cell, barycentric = locate(mesh.points, mesh.cells, points, tolerance=1e-6)
    outside = np.flatnonzero(cell < 0)
    if len(outside):
        first = outside[0]
        low, high = (corner.round(1).tolist() for corner in (mesh.points.min(axis=0), mesh.points.max(axis=0)))
        raise InputError(
            f"{labels[first] if labels else f'point {first}'} at {points[first].round(2).tolist()} mm lies outside the "
            f"mesh ({len(outside)} of {len(points)} do), which runs from {low} to {high} mm (world RAS, fixed image)"
        )
    return mesh.cells[cell], barycentric


def nearest_places(
    mesh: TetMesh, points: Float[np.ndarray, "k 3"]
) -> tuple[Int[np.ndarray, "k 4"], Float[np.ndarray, "k 4"], Float[np.ndarray, "k"]]:
    """Find the place of the mesh that is nearest to each point.

    Returns
    -------
    nodes : (k, 4) int array
        Nodes of the cell that holds the place; of a place on the surface, of a triangle and one of them again.
    weights : (k, 4) array
        Barycentric coordinates there.
    distance : (k,) array
        The distance from the point, mm; zero inside.
    """
    cell, weights = locate(mesh.points, mesh.cells, points, tolerance=1e-6)
    nodes, distance, outside = mesh.cells[cell], np.zeros(len(points)), cell < 0
    if outside.any():
        face, on_face = nearest_on_surface(mesh.points, mesh.boundary_faces, points[outside])
        corners = mesh.boundary_faces[face]
        nodes[outside], weights[outside] = np.c_[corners, corners[:, 0]], np.c_[on_face, np.zeros(len(face))]
        places = np.einsum("ka,kai->ki", on_face, mesh.points[corners])
        distance[outside] = np.linalg.norm(points[outside] - places, axis=1)
    return nodes, weights, distance


def barycentric_maps(corners: np.ndarray) -> np.ndarray:
    """Compute the (m, 4, 3) maps to barycentric coordinates of tetrahedra.

    Coordinate a of x is row a times (x − first corner), plus one for a = 0.
    """
    last_three = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    return np.concatenate([-last_three.sum(axis=1, keepdims=True), last_three], axis=1)


def _search(
    query: np.ndarray, bins: _Bins, origin: np.ndarray, to_barycentric: np.ndarray, tolerance: float
) -> Location:
    """Test all points in their first candidates, then in their second ones, and so on."""
    cell, barycentric = np.full(len(query), -1), np.full((len(query), 4), np.nan)
    first, last = bins.candidates(query)
    left = np.flatnonzero(first < last)
    while left.size:
        trial = bins.cells[first[left]]
        coordinates = np.einsum("kai,ki->ka", to_barycentric[trial], query[left] - origin[trial])
        coordinates[:, 0] += 1
        inside = coordinates.min(axis=1) >= -tolerance
        cell[left[inside]], barycentric[left[inside]] = trial[inside], coordinates[inside]
        first[left] += 1
        left = left[~inside]
        left = left[first[left] < last[left]]
    return Location(cell, barycentric)


class _Bins:
    """A grid of cubes, with a list of the cells that reach into each cube, in ascending order."""

    def __init__(self, corners: np.ndarray, to_barycentric: np.ndarray, pairs: int) -> None:
        low, high = corners.min(axis=1), corners.max(axis=1)
        self.low = low.min(axis=0)
        self.size = _bin_size(low, high, pairs)
        self.shape = np.floor((high.max(axis=0) - self.low) / self.size).astype(int) + 1
        cell, index = _overlaps(*(np.floor((x - self.low) / self.size).astype(int) for x in (low, high)))
        # A cube on the far side of a face plane does not meet the cell: the largest value of that face's
        # barycentric coordinate over the cube is negative there.
        centre = self.low + (index + 0.5) * self.size - corners[cell, 0]
        largest = np.einsum("kai,ki->ka", to_barycentric[cell], centre)
        largest[:, 0] += 1
        largest += self.size / 2 * np.abs(to_barycentric).sum(axis=2)[cell]
        meets = largest.min(axis=1) >= -1e-6
        flat = np.ravel_multi_index(tuple(index[meets].T), tuple(self.shape))
        order = np.argsort(flat, kind="stable")
        self.cells = cell[meets][order]
        self.starts = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=int(self.shape.prod())))])

    def candidates(self, query: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find the first and last (exclusive) index in `cells` of the candidates of each point."""
        index = np.floor((query - self.low) / self.size)
        # On the bounding box of the mesh, rounding may give one bin too few or too many.
        inside = ((index >= -1) & (index <= self.shape)).all(axis=1)
        index = np.clip(np.where(inside[:, None], index, 0), 0, self.shape - 1).astype(int)
        flat = np.ravel_multi_index(tuple(index.T), tuple(self.shape))
        return self.starts[flat], np.where(inside, self.starts[flat + 1], self.starts[flat])


def _bin_size(low: np.ndarray, high: np.ndarray, pairs: int) -> float:
    """Compute the edge of the smallest cubes for which there are at most about `pairs` pairs of a cell and a cube."""
    extent = high - low
    size = float(extent.max())
    while np.prod(extent / (size / 1.3) + 1, axis=1).sum() < pairs and np.prod(np.ptp(low, axis=0) / size + 1) < pairs:
        size /= 1.3
    return size


def _overlaps(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List every pair of a cell and a cube (3 indices) in the cell's box of cubes first … last."""
    span = last - first + 1
    count = span.prod(axis=1)
    cell = np.repeat(np.arange(len(first)), count)
    within = np.arange(len(cell)) - np.repeat(np.cumsum(count) - count, count)
    span = span[cell]
    offset = np.stack([within // (span[:, 1] * span[:, 2]), within // span[:, 2] % span[:, 1], within % span[:, 2]], 1)
    return cell, first[cell] + offset


def nearest_on_surface(
    points: Float[np.ndarray, "nodes 3"],
    triangles: Int[np.ndarray, "triangles 3"],
    query: Float[np.ndarray, "queries 3"],
) -> Location:
    """Find the nearest point of a triangulated surface, as a triangle and barycentric coordinates.

    Parameters
    ----------
    points : (n, 3) array
        Nodes, mm.
    triangles : (t, 3) int array
        Node indices, for instance `TetMesh.boundary_faces`.
    query : (k, 3) array
        Points, mm.

    Notes
    -----
    The result is the exact nearest point of the triangles that contain one of the four nearest sample points of the
    surface (3 to 36 on each triangle). If another triangle is nearer, the error is less than the distance between
    samples.
    """
    corners = points[triangles]
    lattice = _lattice(int(np.clip(np.sqrt(120_000 / len(triangles)), 2, 8)))
    tree = cKDTree(np.einsum("sa,tai->tsi", lattice, corners).reshape(-1, 3))
    owner = np.repeat(np.arange(len(triangles)), len(lattice))

    def search(query: np.ndarray) -> Location:
        near = owner[tree.query(query, k=4)[1]]
        trial = closest_in_triangles(corners[near], query[:, None])
        gap = np.einsum("kca,kcai->kci", trial, corners[near]) - query[:, None]
        best, rows = (gap**2).sum(axis=2).argmin(axis=1), np.arange(len(query))
        return Location(near[rows, best], trial[rows, best])

    return _in_threads(search, query, 3)


def _in_threads(
    search: Callable[[np.ndarray], Location], query: Float[np.ndarray, "queries 3"], corners: int
) -> Location:
    """Search at groups of points in threads, because NumPy and SciPy release Python's lock."""
    cell, barycentric = np.empty(len(query), int), np.empty((len(query), corners))
    blocks = [slice(start, start + _CHUNK) for start in range(0, len(query), _CHUNK)]
    with ThreadPoolExecutor(max_workers=_THREADS) as pool:
        for block, location in zip(blocks, pool.map(search, (query[block] for block in blocks)), strict=True):
            cell[block], barycentric[block] = location
    return Location(cell, barycentric)


def _lattice(order: int) -> Float[np.ndarray, "samples 3"]:
    """List the centres of the upright parts of a triangle, its sides cut into `order` parts; none is on an edge."""
    return np.array([(i, j, order - 1 - i - j) for i in range(order) for j in range(order - i)]) / order + 1 / (
        3 * order
    )


def closest_in_triangles(
    corners: Float[np.ndarray, "*batch 3 3"], query: Float[np.ndarray, "*points 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Compute the barycentric coordinates of the point of each triangle that is closest to a query point."""
    a, b, c = (corners[..., i, :] for i in range(3))
    ab, ac, aq = b - a, c - a, query - a
    normal = np.cross(ab, ac)
    square = (normal**2).sum(-1)
    beta = (np.cross(aq, ac) * normal).sum(-1) / square
    gamma = (np.cross(ab, aq) * normal).sum(-1) / square
    plane = np.stack([1 - beta - gamma, beta, gamma], axis=-1)
    edges = [_on_edge(corners, query, i, (i + 1) % 3) for i in range(3)]
    options = np.stack(edges)
    distance = ((np.einsum("e...a,...ai->e...i", options, corners) - query) ** 2).sum(-1)
    best = np.take_along_axis(options, distance.argmin(0)[None, ..., None], axis=0)[0]
    return np.where((plane >= 0).all(-1, keepdims=True), plane, best)


def _on_edge(corners: np.ndarray, query: np.ndarray, i: int, j: int) -> np.ndarray:
    along = corners[..., j, :] - corners[..., i, :]
    t = ((query - corners[..., i, :]) * along).sum(-1) / (along**2).sum(-1)
    t = np.clip(t, 0, 1)
    result = np.zeros((*t.shape, 3))
    result[..., i], result[..., j] = 1 - t, t
    return result


def transfer(
    u: Float[np.ndarray, "nodes 3"], from_mesh: TetMesh, points: Float[np.ndarray, "queries 3"]
) -> Float[np.ndarray, "queries 3"]:
    """Evaluate a P1 function, given at the nodes of a mesh, at points.

    Parameters
    ----------
    u : (n, 3) array
        Values at the nodes of `from_mesh`, for instance displacements in mm.
    from_mesh : TetMesh
    points : (k, 3) array
        World coordinates, mm. A point outside the mesh takes the value at the nearest point of the surface.

    Returns
    -------
    (k, 3) array
    """
    cell, barycentric = locate(from_mesh.points, from_mesh.cells, points)
    inside = cell >= 0
    values = np.empty((len(points), 3))
    values[inside] = np.einsum("ka,kai->ki", barycentric[inside], u[from_mesh.cells[cell[inside]]])
    face, weight = nearest_on_surface(from_mesh.points, from_mesh.boundary_faces, points[~inside])
    values[~inside] = np.einsum("ka,kai->ki", weight, u[from_mesh.boundary_faces[face]])
    return values
