"""Displacement of boundary nodes to a distance from the skull without inverting a tetrahedron."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from bayesreg.image import Image
from bayesreg.io.domain import MeshError
from bayesreg.io.quality import mean_ratio
from bayesreg.mesh import TetMesh

LEAST_MEAN_RATIO = 0.1
# Nodes move this much further than the gap, mm, so that rounding does not undo it.
MARGIN = 0.01


def pull_inside(mesh: TetMesh, distance: Image, gap: float) -> TetMesh:
    """Move the boundary nodes of a mesh to a distance of at least `gap` from the forbidden region.

    Nodes that are too near move along the gradient of the distance. If a full step would give a tetrahedron a mean
    ratio below 0.1, or below its present one, the node moves part of the way. Then the interior nodes around it are
    smoothed, and the node moves on.

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
        If there is no allowed point, or a node cannot reach one.
    """
    points = mesh.points.copy()
    moving = mesh.boundary[_sample(distance, points[mesh.boundary]) < gap]
    if len(moving) == 0:
        return mesh
    goal = _allowed_places(distance, points[moving], gap)
    for _ in range(30):
        _advance(points, mesh.cells, moving, goal)
        if np.array_equal(points[moving], goal):
            return TetMesh.from_arrays(points, mesh.cells, mesh.tissue, mesh.names)
        _smooth(points, mesh.cells, _interior_near(mesh, moving))
    left = np.linalg.norm(points[moving] - goal, axis=1)
    raise MeshError(
        f"{np.count_nonzero(left)} boundary nodes cannot be moved to {gap:g} mm inside the intracranial mask without "
        f"inverting tetrahedra (up to {left.max():.2f} mm are missing); choose a smaller envelope or edge_length"
    )


def _allowed_places(distance: Image, points: Float[np.ndarray, "n 3"], gap: float) -> Float[np.ndarray, "n 3"]:
    """Move points along the gradient of the distance until they are far enough from the skull."""
    start, points = points, points.copy()
    for _ in range(20):
        value = _sample(distance, points)
        near = value < gap
        if not near.any():
            return points
        slope = _gradient(distance, points[near])
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


def _sample(distance: Image, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    return ndimage.map_coordinates(distance.voxels, distance.world_to_voxel(points).T, order=1, mode="nearest")


def _gradient(distance: Image, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Compute the gradient by central differences over two voxels, which smooths the kinks of a voxelwise distance."""
    step = distance.voxel_sizes.max() * np.eye(3)
    ahead, behind = (np.stack([_sample(distance, points + sign * e) for e in step], axis=1) for sign in (1, -1))
    return (ahead - behind) / (2 * step[0, 0])


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
