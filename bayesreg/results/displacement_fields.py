"""Displacement fields on grids, there and back, and the transforms that a run leaves for other programs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayesreg.fem.deformation import Displaced
from bayesreg.fem.location import Location
from bayesreg.image import Image
from bayesreg.io.fields import save_displacement
from bayesreg.io.store import Place
from bayesreg.io.transforms import save_transform
from bayesreg.pose import Pose
from bayesreg.results.transform import Transform

MEAN, MEAN_INVERSE, ENSEMBLE = "transform_mean.h5", "transform_mean_inverse.h5", "transforms"
# Between the voxels of an ensemble's fields, in mean edges of the mesh: linear interpolation then errs by 0.02 mm in
# the median, and by 0.2 mm at most where a draw bends by some mm from node to node.
ENSEMBLE_SPACING = 0.2
# What the grid of an inverse reaches beyond the displaced mesh, mm.
MARGIN = 10.0


class OnGrid(NamedTuple):
    """A displacement at the voxel centres of a grid, and where in the mesh or around it these lie.

    Attributes
    ----------
    field : (X, Y, Z, 3) array
        mm, world RAS of the fixed image, single precision.
    locations : list of Location
        Of some voxels at a time, in the order of memory.
    """

    field: Float[np.ndarray, "X Y Z 3"]
    locations: list[Location]


def displacement_on(displaced: Displaced, grid: Image, known: list[Location] | None = None) -> OnGrid:
    """u at the voxel centres of a grid; with their locations, if these are known from another u, it is faster."""
    field, found = np.empty((int(np.prod(grid.shape)), 3), np.float32), []
    for index, (some, points) in enumerate(grid.blocks()):
        location = displaced.deformer.locate(points) if known is None else known[index]
        field[some] = displaced.displacement(points, location)
        found.append(location)
    return OnGrid(field.reshape(*grid.shape, 3), found)


def return_on(displaced: Displaced, grid: Image, near: list[Location] | None = None) -> OnGrid:
    """x − z at the voxel centres z = x + u(x) of a grid; with locations of sources near by it is faster."""
    field, found = np.empty((int(np.prod(grid.shape)), 3), np.float32), []
    for index, (some, places) in enumerate(grid.blocks()):
        sources, location = displaced.sources(places, None if near is None else near[index])
        field[some] = sources - places
        found.append(location)
    return OnGrid(field.reshape(*grid.shape, 3), found)


def write_transforms(
    place: Place, transform: Transform, grid: Image, mean: Float[np.ndarray, "X Y Z 3"] | None = None
) -> None:
    """Write the transforms of the posterior mean, there and back, and those of the draws of a transform.

    Parameters
    ----------
    place : callable
        As of `bayesreg.io.ledger.writing`. Each draw gets three files in transforms/: draw-01.h5 and
        draw-01_inverse.h5 as `bayesreg.io.transforms.save_transform` writes them, and draw-01.nii.gz, the whole
        displacement.
    transform : Transform
        From the fixed image's world.
    grid : Image
        Of the fixed image.
    mean : (X, Y, Z, 3) array, optional
        The mean displacement on it, the pose not included, if it is known already.
    """
    pose, upright = transform.pose, grid.on_orthogonal_grid(order=0)
    field = mean if mean is not None and upright is grid else displacement_on(transform.mean, upright).field
    save_transform(place(MEAN), field, upright, pose)
    back = around_displaced(upright, transform.mesh.points + transform.u_mean)
    returns = return_on(transform.mean, back).field
    save_transform(place(MEAN_INVERSE), returns, back, pose.inverse, pose_first=True)
    if len(transform.draws):
        _write_ensemble(place, transform, upright)


def _write_ensemble(place: Place, transform: Transform, grid: Image) -> None:
    sizes = np.maximum(grid.voxel_sizes, ENSEMBLE_SPACING * transform.mesh.boundary_edge)
    there = grid.with_voxels(np.zeros(grid.shape, np.int8)).on_orthogonal_grid(sizes, order=0)
    back = around_displaced(there, transform.mesh.points + transform.u_mean)
    located, near = displacement_on(transform.mean, there).locations, return_on(transform.mean, back).locations
    points, digits = there.grid_points(), len(str(len(transform.draws)))
    for number, u in enumerate(transform.draws, start=1):
        displaced, name = transform.deformer.displaced(u), f"{ENSEMBLE}/draw-{number:0{digits}d}"
        field = displacement_on(displaced, there, located).field
        save_transform(place(f"{name}.h5"), field, there, transform.pose)
        save_displacement(place(f"{name}.nii.gz"), total_displacement(transform.pose, points, field), there.affine)
        returns = return_on(displaced, back, near).field
        save_transform(place(f"{name}_inverse.h5"), returns, back, transform.pose.inverse, pose_first=True)


def total_displacement(
    pose: Pose, points: Float[np.ndarray, "X Y Z 3"], field: Float[np.ndarray, "X Y Z 3"]
) -> Float[np.ndarray, "X Y Z 3"]:
    """From points to where they lie in the moving image's world, mm, single precision."""
    return np.asarray(pose.displacement(points, field), np.float32)


def around_displaced(grid: Image, points: Float[np.ndarray, "k 3"]) -> Image:
    """A grid, enlarged by whole voxels so that it holds points and a margin about them."""
    index, margin = grid.world_to_voxel(points), MARGIN / grid.voxel_sizes
    low = np.minimum(np.floor(index.min(axis=0) - margin), 0).astype(int)
    high = np.maximum(np.ceil(index.max(axis=0) + margin), np.array(grid.shape) - 1).astype(int)
    affine = np.array(grid.affine)
    affine[:3, 3] = grid.voxel_to_world(low.astype(float))
    return Image(np.zeros(high - low + 1, np.int8), affine)
