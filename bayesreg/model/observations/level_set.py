"""The surface of an organ at rest as the zero level of its signed distance, and the cells of the mesh around it."""

from __future__ import annotations

import edt
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from bayesreg.distance import forbidden, signed_distance
from bayesreg.fem.location import locate, nearest_on_surface
from bayesreg.image import Image
from bayesreg.interpolation import Interpolator
from bayesreg.mesh import TetMesh, boundary_faces_of
from bayesreg.model.observations.measured_surface import CellTable

# The distance of a mask goes on for so far beyond its grid, mm.
MARGIN = 20.0
# Folds narrower than twice this are bridged, mm: those of a cortex are, and light and pointers do not enter them.
FOLD = 4.0
# The number of voxels along an edge of the mesh, in the grid of cells and that of the distance from a mesh.
VOXELS_PER_EDGE = 8
# The grid reaches beyond the points by this multiple of the length of an edge: a point may have moved so far.
REACH = 1.5


def grid_around(mesh: TetMesh, points: Float[np.ndarray, "k 3"]) -> Image:
    """Make a grid around the part of a mesh in which measured points have their places, as an image of zeros."""
    size, reach = mesh.boundary_edge / VOXELS_PER_EDGE, REACH * mesh.boundary_edge
    # Points that lie far from the mesh are wrong, and take part at its border.
    low = np.maximum(points.min(axis=0), mesh.points.min(axis=0)) - reach
    high = np.minimum(points.max(axis=0), mesh.points.max(axis=0)) + reach
    affine = np.diag([size, size, size, 1.0])
    affine[:3, 3] = low
    return Image(np.zeros(np.maximum(np.ceil((high - low) / size).astype(int), 1) + 1), affine)


def cell_table(mesh: TetMesh, grid: Image) -> CellTable:
    """Find the cell that holds the centre of each voxel; outside the mesh, the cell behind the nearest place of it."""
    centres = grid.grid_points().reshape(-1, 3)
    cells, _ = locate(mesh.points, mesh.cells, centres)
    outside = cells < 0
    if outside.any():
        faces, _ = nearest_on_surface(mesh.points, mesh.boundary_faces, centres[outside])
        cells[outside] = _cells_behind(mesh)[faces]
    return CellTable(jnp.asarray(cells.reshape(grid.shape)), jnp.asarray(grid.to_voxel))


def depth_in_mask(mask: Image, margin: float = MARGIN) -> Image:
    """Compute the depth below the surface of a mask, mm, negative outside, without the steps of its voxels.

    The surface bridges folds, as what a camera or a pointer sees does. The grid reaches beyond the mask by the margin.
    """
    return signed_distance(forbidden(_bridge_folds(mask)), margin)


def distance_from_mask(mask: Image) -> Interpolator:
    """Compute the signed distance from the surface of a mask, mm, positive outside."""
    depth = depth_in_mask(mask)
    return depth.with_voxels(-np.asarray(depth.voxels)).interpolator("cubic")


def distance_from_mesh(mesh: TetMesh, chosen: Bool[np.ndarray, "cells"], grid: Image) -> Interpolator:
    """Compute the signed distance from the common surface of some cells, mm, positive outside."""
    centres, faces = grid.grid_points().reshape(-1, 3), boundary_faces_of(mesh.cells[chosen])
    face, weights = nearest_on_surface(mesh.points, faces, centres)
    places = np.einsum("ka,kai->ki", weights, mesh.points[faces[face]])
    inside = locate(mesh.points, mesh.cells[chosen], centres)[0] >= 0
    distance = np.where(inside, -1, 1) * np.linalg.norm(centres - places, axis=1)
    return grid.with_voxels(distance.reshape(grid.shape)).interpolator("cubic")


def _bridge_folds(mask: Image) -> Image:
    """Fill what no ball of the radius `FOLD` outside the mask can reach: a closing by this ball, and holes."""
    width = [(int(np.ceil(FOLD / size)) + 1,) * 2 for size in mask.voxel_sizes]
    outside, sizes = np.pad(np.asarray(mask.voxels) == 0, width, constant_values=True), tuple(mask.voxel_sizes)
    within_reach = edt.edt(outside, anisotropy=sizes) <= FOLD
    closed = edt.edt(within_reach, anisotropy=sizes) > FOLD
    inner = tuple(slice(low, -high) for low, high in width)
    filled = ndimage.binary_fill_holes(closed[inner] | ~outside[inner])
    return mask.with_voxels(np.asarray(filled, np.uint8))


def _cells_behind(mesh: TetMesh) -> Int[np.ndarray, "faces"]:
    """Return the cell to which each face of the boundary belongs."""
    opposite = ([1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2])
    owner = {
        tuple(sorted(face)): cell for corners in opposite for cell, face in enumerate(mesh.cells[:, corners].tolist())
    }
    return np.array([owner[tuple(sorted(face))] for face in mesh.boundary_faces.tolist()])
