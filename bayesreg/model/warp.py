"""From nodal displacements to displaced points, warped images and volume change."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayesreg.fem.elements import displacement_gradient, elements_of
from bayesreg.fem.location import locate
from bayesreg.image import Image, Interpolation
from bayesreg.mesh import TetMesh
from bayesreg.types import AnyArray


def volume_ratio(mesh: TetMesh, u: Float[AnyArray, "nodes 3"]) -> Float[AnyArray, "cells"]:
    """det F = det(I + ∇u) of every cell: its volume after the deformation over that before."""
    gradient = displacement_gradient(elements_of(mesh).derivative, jnp.asarray(u))
    return jnp.linalg.det(jnp.moveaxis(jnp.array(gradient), -1, 0) + jnp.eye(3))


def nodal_field_on_grid(
    mesh: TetMesh, values: Float[np.ndarray, "nodes channels"], grid: Image
) -> Float[np.ndarray, "X Y Z channels"]:
    """Linear interpolation of nodal values at the voxel centres of an image; zero outside the mesh."""
    points = grid.grid_points().reshape(-1, 3)
    lower, upper = mesh.points.min(axis=0), mesh.points.max(axis=0)
    near = np.flatnonzero(((points >= lower) & (points <= upper)).all(axis=1))
    cells, barycentric = locate(mesh.points, mesh.cells, points[near])
    inside = cells >= 0
    field = np.zeros((len(points), values.shape[1]))
    nodal = np.asarray(values)[mesh.cells[cells[inside]]]
    field[near[inside]] = np.einsum("qa,qac->qc", barycentric[inside], nodal)
    return field.reshape(*grid.shape, values.shape[1])


def warp_image(
    moving: Image, displacement: Float[np.ndarray, "X Y Z 3"], grid: Image, method: Interpolation = "linear"
) -> Image:
    """m(x + u(x)) at the voxel centres of `grid`, u in mm on that grid."""
    return grid.with_voxels(np.asarray(moving.interpolate(grid.grid_points() + displacement, method)))
