"""Displaced points, warped images and volume change from nodal displacements."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayesreg.fem.elements import displacement_gradient, elements_of
from bayesreg.fem.location import locate
from bayesreg.image import Image
from bayesreg.interpolation import Interpolation
from bayesreg.mesh import TetMesh
from bayesreg.types import AnyArray


def volume_ratio(mesh: TetMesh, u: Float[AnyArray, "nodes 3"]) -> Float[AnyArray, "cells"]:
    """Compute det F = det(I + ∇u) of every cell: its volume after the deformation over its volume before."""
    gradient = displacement_gradient(elements_of(mesh).derivative, jnp.asarray(u))
    return jnp.linalg.det(jnp.moveaxis(jnp.array(gradient), -1, 0) + jnp.eye(3))


class Covered(NamedTuple):
    """The voxels whose centres lie in a mesh.

    Attributes
    ----------
    voxel : (k, 3) int array
    cell : (k,) int array
        The tetrahedron that holds each voxel centre.
    barycentric : (k, 4) array
        Barycentric coordinates of the centre in its tetrahedron.
    """

    voxel: Int[np.ndarray, "k 3"]
    cell: Int[np.ndarray, "k"]
    barycentric: Float[np.ndarray, "k 4"]


def covered_voxels(grid: Image, mesh: TetMesh) -> Covered:
    """Find the voxels of an image whose centres lie in a mesh."""
    corners = grid.world_to_voxel(mesh.points)
    # Voxels on the bounding box of the mesh, up to rounding, must reach `locate`, which decides.
    low = np.maximum(np.ceil(corners.min(axis=0) - 1e-6), 0).astype(int)
    high = np.minimum(np.floor(corners.max(axis=0) + 1e-6), np.array(grid.shape) - 1).astype(int)
    index = low + np.argwhere(np.ones(np.maximum(high - low + 1, 0), bool))
    cell, barycentric = locate(mesh.points, mesh.cells, grid.voxel_to_world(index.astype(float)))
    inside = cell >= 0
    return Covered(index[inside], cell[inside], barycentric[inside])


def tissue_on_grid(mesh: TetMesh, voxels: int = 100) -> Image:
    """Make the tissue map of a mesh: 0 outside, 1 + tissue inside, int8; `voxels` cubic voxels on the longest side."""
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    size = float((high - low).max()) / voxels
    affine = np.diag([size, size, size, 1.0])
    affine[:3, 3] = low - size
    grid = Image(np.zeros(np.ceil((high - low) / size).astype(int) + 3, np.int8), affine)
    labels = np.zeros(grid.shape, np.int8)
    index, cells, _ = covered_voxels(grid, mesh)
    labels[tuple(index.T)] = 1 + mesh.tissue[cells]
    return grid.with_voxels(labels)


def warp_image(
    moving: Image, displacement: Float[np.ndarray, "X Y Z 3"], grid: Image, method: Interpolation = "linear"
) -> Image:
    """Compute m(x + u(x)) at the voxel centres of `grid`, u in mm on that grid; zero beyond the grid of m."""
    places = grid.grid_points() + displacement
    return grid.with_voxels(np.where(moving.contains(places), np.asarray(moving.interpolate(places, method)), 0.0))
