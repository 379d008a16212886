"""Displacement of boundary nodes, to the surface of a region and away from the skull, without inverting tetrahedra."""

from __future__ import annotations

import edt
import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from bayesreg.distance import distance_at, slope_at
from bayesreg.image import Image
from bayesreg.io.domain import MeshError
from bayesreg.io.quality import mean_ratio
from bayesreg.mesh import TetMesh

LEAST_MEAN_RATIO = 0.1
# Nodes move this much further than the gap, mm, so that rounding does not undo it.
MARGIN = 0.01
# The number of steps of Gauss–Newton to the surface of a region, the damping of their matrix over its mean diagonal,
# and the greatest displacement of a node by one of them, in edges of the boundary.
FITS, DAMPING, GREATEST_STEP = 2, 0.05, 0.25
# The grid of depths: cubes per edge of the mesh at least, and the greatest number of them.
CUBES_PER_EDGE, MOST_CUBES = 8, 3e7
# The greatest number of rounds in which nodes and what lies around them move in turn: to the surface of a region, as
# far as they come; and away from the skull, where they must.
FITTING_ROUNDS, PULLING_ROUNDS = 5, 10
# The greatest number of times that nodes which are stopped drag their neighbours along.
PULLS = 3
# The barycentric coordinates of the points of a triangle at which its distance from the surface is taken.
_POINTS_OF_FACE = np.array([(i + 1 / 3, j + 1 / 3, 3 - i - j + 1 / 3) for i in range(4) for j in range(4 - i)]) / 4


def depth_of_region(region: Image, edge_length: float) -> Image:
    """Compute the signed distance to the surface of the voxels of a region, mm, positive inside.

    Parameters
    ----------
    region : Image
        Nonzero in the region.
    edge_length : float
        That of the mesh, mm.

    Returns
    -------
    Image
        On a grid of cubes around the region, at least as fine as its voxels if these are not too many, so that the
        distance to a voxel is that to its surface up to half a cube. It is not smoothed, which would shrink what is
        thin or curved.
    """
    inside = (np.asarray(region.voxels) != 0).astype(np.uint8)
    box = ndimage.find_objects(inside)[0]
    before = np.ceil(edge_length / region.voxel_sizes).astype(int)
    around = np.pad(inside[box], np.stack([before, before], axis=1))
    affine = region.affine.copy()
    affine[:3, 3] = region.voxel_to_world(np.array([span.start for span in box]) - before.astype(float))
    size = max(
        min(region.voxel_sizes.min(), edge_length / CUBES_PER_EDGE),
        np.cbrt(around.size * region.voxel_volume / MOST_CUBES),
    )
    cubes = Image(around, affine).on_orthogonal_grid(np.full(3, size), order=0)
    distance = edt.sdf(np.asarray(cubes.voxels) != 0, anisotropy=tuple(cubes.voxel_sizes))
    return cubes.with_voxels(distance - np.copysign(size / 2, distance, dtype=distance.dtype))


def fit_to_surface(mesh: TetMesh, depth: Image) -> TetMesh:
    """Move the boundary nodes of a mesh so that its faces lie on the surface of a region, in least squares.

    Smoothing, and chords in the place of arcs, leave a mesh within the region that it is made for: convex parts lose
    their rims. A step that leads away from the surface is not taken.

    Parameters
    ----------
    mesh : TetMesh
        Its faces lie near the surface.
    depth : Image
        Of the region, from `depth_of_region`.

    Notes
    -----
    With the depth φ, points x_q of the faces, and the nodes k displaced along their normals n_k by a_k, a step of
    Gauss–Newton minimises Σ_q w_q (φ(x_q) + Σ_k N_k(x_q) a_k n_k · ∇φ(x_q))² with the area w_q of each point. Nodes
    whose tetrahedra would become flat stay behind.
    """
    boundary, greatest = mesh.boundary, GREATEST_STEP * mesh.boundary_edge
    faces = np.searchsorted(boundary, mesh.boundary_faces)
    for _ in range(FITS):
        points, before = mesh.points.copy(), _misfit(mesh.points[boundary], faces, depth)
        goal = points[boundary] + _step_to_surface(points[boundary], faces, depth, greatest)
        _move(points, mesh, boundary, goal, FITTING_ROUNDS)
        if _misfit(points[boundary], faces, depth) > before:
            break
        mesh = TetMesh.from_arrays(points, mesh.cells, mesh.tissue, mesh.names)
    return mesh


def _misfit(points: Float[np.ndarray, "nodes 3"], faces: Int[np.ndarray, "faces 3"], depth: Image) -> float:
    """Compute the mean square depth of faces, mm²."""
    places, areas = _places_of_faces(points, faces)
    return float(np.average(distance_at(depth, places) ** 2, weights=areas))


def _places_of_faces(
    points: Float[np.ndarray, "nodes 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[Float[np.ndarray, "q 3"], Float[np.ndarray, "q"]]:
    """Return points of all faces, and the area for which each stands, up to a factor."""
    corners = points[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    places = np.einsum("qk,fki->fqi", _POINTS_OF_FACE, corners).reshape(-1, 3)
    return places, np.repeat(areas, len(_POINTS_OF_FACE))


def _step_to_surface(
    points: Float[np.ndarray, "nodes 3"], faces: Int[np.ndarray, "faces 3"], depth: Image, greatest: float
) -> Float[np.ndarray, "nodes 3"]:
    """Compute a_k n_k, mm, for one step of Gauss–Newton; each no longer than `greatest`."""
    normals = _normals(points, faces)
    places, areas = _places_of_faces(points, faces)
    weights, root = np.tile(_POINTS_OF_FACE, (len(faces), 1)), np.sqrt(areas)
    node = np.repeat(faces, len(_POINTS_OF_FACE), axis=0)
    slope = np.einsum("qki,qi->qk", normals[node], slope_at(depth, places))
    place = np.repeat(np.arange(len(places)), 3)
    entries = (root[:, None] * weights * slope).ravel()
    jacobian = scipy.sparse.csr_array((entries, (place, node.ravel())), (len(places), len(points)))
    matrix = jacobian.T @ jacobian
    matrix += DAMPING * matrix.diagonal().mean() * scipy.sparse.eye_array(len(points))
    a = spsolve(matrix.tocsc(), -(jacobian.T @ (root * distance_at(depth, places))))
    return np.clip(a, -greatest, greatest)[:, None] * normals


def _normals(points: Float[np.ndarray, "nodes 3"], faces: Int[np.ndarray, "faces 3"]) -> Float[np.ndarray, "nodes 3"]:
    """Compute the unit normals of nodes, the means of their faces' weighted by area."""
    corners, normals = points[faces], np.zeros_like(points)
    for corner in faces.T:
        np.add.at(normals, corner, np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def pull_inside(mesh: TetMesh, distance: Image, gap: float) -> TetMesh:
    """Move the boundary nodes of a mesh to a distance of at least `gap` from the forbidden region, where they can.

    Nodes that are too near move along the gradient of the distance. If a full step would give a tetrahedron a mean
    ratio below 0.1, or below its present one, the node moves part of the way. Then the interior nodes around it are
    smoothed, and the node moves on. One that is stopped may stay nearer than `gap`, outside the forbidden region. A
    node that is stopped within the forbidden region drags its neighbours on the boundary along.

    Parameters
    ----------
    mesh : TetMesh
    distance : Image
        Signed distance to the forbidden region, mm, positive outside it, from `signed_distance`.
    gap : float
        Least distance, mm.

    Raises
    ------
    MeshError
        If there is no allowed point, or a node cannot leave the forbidden region.
    """
    points = mesh.points.copy()
    for _ in range(PULLS):
        moving = mesh.boundary[distance_at(distance, points[mesh.boundary]) < gap]
        goal = _allowed_places(distance, points[moving], gap)
        _move(points, mesh, moving, goal, PULLING_ROUNDS)
        stopped = distance_at(distance, points[moving]) <= 0
        if not stopped.any():
            break
        _drag(points, mesh, moving[stopped], (goal - points[moving])[stopped])
    room = distance_at(distance, points[mesh.boundary])
    if (room <= 0).any():
        raise MeshError(
            f"{np.count_nonzero(room <= 0)} boundary nodes cannot be moved into the intracranial mask without "
            f"inverting tetrahedra (up to {-room.min():.2f} mm are missing); choose a smaller envelope or edge_length"
        )
    if np.array_equal(points, mesh.points):
        return mesh
    return TetMesh.from_arrays(points, mesh.cells, mesh.tissue, mesh.names)


def _drag(
    points: Float[np.ndarray, "nodes 3"],
    mesh: TetMesh,
    moving: Int[np.ndarray, "n"],
    rest: Float[np.ndarray, "n 3"],
) -> None:
    """Move the boundary nodes around each node by the rest of its way, in place.

    A tetrahedron with four boundary nodes stops one of them that moves through the plane of the others.
    """
    for node, way in zip(moving, rest, strict=True):
        around = np.setdiff1d(np.intersect1d(_neighbours(mesh.cells, np.array([node])), mesh.boundary), moving)
        _advance(points, mesh.cells, around, points[around] + way)


def _allowed_places(distance: Image, points: Float[np.ndarray, "n 3"], gap: float) -> Float[np.ndarray, "n 3"]:
    """Move points along the gradient of the distance until they are far enough from the skull."""
    start, points = points, points.copy()
    for _ in range(20):
        value = distance_at(distance, points)
        near = value < gap
        if not near.any():
            return points
        slope = slope_at(distance, points[near])
        steep = np.maximum((slope**2).sum(axis=1), 0.25)
        points[near] += slope * ((gap + MARGIN - value[near]) / steep)[:, None]
    # In a narrow gap of the skull the gradient leads from one side to the other and back.
    points[near] = _nearest_allowed(distance, start[near], gap)
    return points


def _nearest_allowed(distance: Image, points: Float[np.ndarray, "n 3"], gap: float) -> Float[np.ndarray, "n 3"]:
    """Find the nearest voxel centres that are far enough from the skull."""
    shell = (distance.voxels >= gap + MARGIN) & (distance.voxels < gap + 3 * distance.voxel_sizes.max())
    if not shell.any():
        raise MeshError(f"the intracranial mask is nowhere thick enough for a gap of {gap:g} mm to the skull")
    centres = distance.voxel_to_world(np.argwhere(shell))
    return centres[cKDTree(centres).query(points)[1]]


def _move(
    points: Float[np.ndarray, "nodes 3"],
    mesh: TetMesh,
    moving: Int[np.ndarray, "n"],
    goal: Float[np.ndarray, "n 3"],
    rounds: int,
) -> None:
    """Move nodes towards their goals, in place, and smooth the interior around them."""
    for _ in range(rounds):
        _advance(points, mesh.cells, moving, goal)
        if np.array_equal(points[moving], goal):
            return
        _smooth(points, mesh.cells, _interior_near(mesh, moving))


def _advance(
    points: Float[np.ndarray, "nodes 3"],
    cells: Int[np.ndarray, "cells 4"],
    moving: Int[np.ndarray, "n"],
    goal: Float[np.ndarray, "n 3"],
) -> None:
    """Move nodes towards their goals, in place, each as far as its tetrahedra keep their quality."""
    touched = cells[np.isin(cells, moving).any(axis=1)]
    least = np.minimum(mean_ratio(points, touched), LEAST_MEAN_RATIO)
    start = points[moving]
    share = np.ones(len(moving))
    while True:
        points[moving] = np.where(share[:, None] == 1, goal, start + share[:, None] * (goal - start))
        spoilt = touched[mean_ratio(points, touched) < least]
        if len(spoilt) == 0:
            return
        held_back = np.isin(moving, spoilt)
        share[held_back] = np.where(share[held_back] > 0.02, share[held_back] / 2, 0)


def _interior_near(mesh: TetMesh, moving: Int[np.ndarray, "n"]) -> Int[np.ndarray, "k"]:
    """Find the interior nodes within two rings of tetrahedra around the moving nodes."""
    near = _neighbours(mesh.cells, _neighbours(mesh.cells, moving))
    return np.setdiff1d(near, mesh.boundary)


def _neighbours(cells: Int[np.ndarray, "cells 4"], nodes: Int[np.ndarray, "n"]) -> Int[np.ndarray, "k"]:
    return np.unique(cells[np.isin(cells, nodes).any(axis=1)])


def _smooth(
    points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"], nodes: Int[np.ndarray, "n"]
) -> None:
    """Move nodes to the centre of their neighbours, in place, if that improves their worst tetrahedron."""
    for node in nodes:
        star = cells[(cells == node).any(axis=1)]
        before, old = mean_ratio(points, star).min(), points[node].copy()
        points[node] = (points[star].sum(axis=(0, 1)) - len(star) * old) / (3 * len(star))
        if mean_ratio(points, star).min() <= before:
            points[node] = old
