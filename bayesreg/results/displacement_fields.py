"""Displacement fields on grids, forward and inverse, and the transform files of a run for other programs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayesreg.fem.deformation import Displaced
from bayesreg.fem.location import Location
from bayesreg.image import Image, slices
from bayesreg.io.fields import save_displacement
from bayesreg.io.run_folder import Place
from bayesreg.io.transforms import save_transform
from bayesreg.mesh import TetMesh
from bayesreg.model.warp import covered_voxels
from bayesreg.pose import Pose
from bayesreg.results.transform import Transform

MEAN, MEAN_INVERSE, ENSEMBLE = "transform_mean.h5", "transform_mean_inverse.h5", "transforms"
# Voxel size of the draws' fields, in mean edges of the mesh. The error of linear interpolation then has a median of
# 0.02 mm, and is at most 0.2 mm where the displacement of a draw varies by some mm between nodes.
ENSEMBLE_SPACING = 0.2
# Voxel size of the mean's transforms, in mean edges of the mesh, rounded down to whole voxels of the image.
MEAN_SPACING = 0.15
# Written values are multiples of these, mm: the mean in the mesh, the mean around it, where nothing is observed, and
# the standard deviation. Rounding moves the mean by at most 0.004 mm in the mesh.
MEAN_STEP, STEP_AROUND, SD_STEP = 2.0**-7, 2.0**-3, 2.0**-8
# The number of voxels whose variances are computed at a time.
VOXELS = 300_000
# The grid of an inverse extends this far beyond the displaced mesh, mm.
MARGIN = 10.0


class Moments(NamedTuple):
    """Mean and standard deviation of the displacement at the voxel centres of an image, world RAS, float32.

    Attributes
    ----------
    mean : (X, Y, Z, 3) array
        Posterior mean in the mesh and around it, mm, including the pose.
    sd : (X, Y, Z, 3) array
        Standard deviation, mm, along the axes of the moving image's world. Its square is the sum of two variances:
        that of the nodes, interpolated as a standard deviation, and that of the displacement which the mesh cannot
        resolve (`bayesreg.model.submesh`). Zero
        around the mesh.
    rms_sd : dict
        Root mean squares of the two parts over the axes and the voxels in the mesh, mm: "nodes", "mesh".
    """

    mean: Float[np.ndarray, "X Y Z 3"]
    sd: Float[np.ndarray, "X Y Z 3"]
    rms_sd: dict[str, float]

    @property
    def rounded(self) -> tuple[Float[np.ndarray, "X Y Z 3"], Float[np.ndarray, "X Y Z 3"]]:
        """The mean and the standard deviation, rounded so that compressed files are small."""
        inside = (self.sd > 0).any(axis=-1, keepdims=True)
        step = np.where(inside, np.float32(MEAN_STEP), np.float32(STEP_AROUND))
        sd = np.maximum(np.rint(self.sd / np.float32(SD_STEP)), inside) * np.float32(SD_STEP)
        return np.rint(self.mean / step) * step, sd


def moments_on(transform: Transform, grid: Image) -> Moments:
    """Compute the posterior mean and standard deviation of the displacement at the voxel centres of an image.

    Parameters
    ----------
    transform : Transform
        The transform from the fixed image's world.
    grid : Image
    """
    mesh, pose = transform.mesh, transform.pose
    step = _step(mesh, grid)
    # Around the mesh the displacement is smooth and nothing is observed, so that every n-th voxel is enough.
    mean = _between(displacement_on(transform.mean, _every(grid, step)).field, step, grid.shape)
    covered = covered_voxels(grid, mesh)
    covered_index = np.ravel_multi_index(tuple(covered.voxel.T), grid.shape)
    corners = mesh.cells[covered.cell]
    mean[covered_index] = np.einsum("ka,kai->ki", covered.barycentric, transform.u_mean[corners])
    for block, points in grid.blocks():
        mean[block] = pose.displacement(points, mean[block])
    blocks = slices(len(covered.cell), VOXELS)
    parts = [transform.variances(covered.cell[block], covered.barycentric[block]) for block in blocks]
    nodal, unresolved = np.concatenate(parts, axis=1)
    sd = np.zeros_like(mean)
    sd[covered_index] = np.sqrt(nodal + unresolved)
    shape, variances = (*grid.shape, 3), {"nodes": nodal, "mesh": unresolved}
    rms = {name: float(np.sqrt(variance.mean())) for name, variance in variances.items()}
    return Moments(mean.reshape(shape), sd.reshape(shape), rms)


def _between(
    field: Float[np.ndarray, "x y z 3"], step: Int[np.ndarray, "3"], shape: tuple[int, ...]
) -> Float[np.ndarray, "voxels 3"]:
    """Interpolate a field of every n-th voxel linearly at all voxels, in the order of memory."""
    for axis, (stride, length) in enumerate(zip(step, shape, strict=True)):
        before, share = np.divmod(np.arange(length), stride)
        after = np.minimum(before + 1, field.shape[axis] - 1)
        weight = np.expand_dims((share / stride).astype(np.float32), tuple({0, 1, 2, 3} - {axis}))
        first = field.take(before, axis)
        field = first + weight * (field.take(after, axis) - first) if stride > 1 else first
    return field.reshape(-1, 3)


class OnGrid(NamedTuple):
    """A displacement at the voxel centres of a grid, and the locations of these points in the mesh or around it.

    Attributes
    ----------
    field : (X, Y, Z, 3) array
        Displacement, mm, in the fixed image's world RAS, float32.
    locations : list of Location
        Locations of blocks of voxels, in the order of memory.
    """

    field: Float[np.ndarray, "X Y Z 3"]
    locations: list[Location]


def displacement_on(displaced: Displaced, grid: Image, known_locations: list[Location] | None = None) -> OnGrid:
    """Compute u at the voxel centres of a grid; known locations of these, from another u, save time."""
    field, locations = np.empty((int(np.prod(grid.shape)), 3), np.float32), []
    for index, (block, points) in enumerate(grid.blocks()):
        location = displaced.deformer.locate(points) if known_locations is None else known_locations[index]
        field[block] = displaced.displacement(points, location)
        locations.append(location)
    return OnGrid(field.reshape(*grid.shape, 3), locations)


def return_on(displaced: Displaced, grid: Image, near: list[Location] | None = None) -> OnGrid:
    """Compute x − z at the voxel centres z = x + u(x) of a grid; locations near the sources x save time."""
    field, locations = np.empty((int(np.prod(grid.shape)), 3), np.float32), []
    for index, (block, places) in enumerate(grid.blocks()):
        sources, location = displaced.sources(places, None if near is None else near[index])
        field[block] = sources - places
        locations.append(location)
    return OnGrid(field.reshape(*grid.shape, 3), locations)


def write_transforms(place: Place, transform: Transform, grid: Image) -> None:
    """Write the transforms of the posterior mean and of the draws, each with its inverse.

    Parameters
    ----------
    place : callable
        The callable from `bayesreg.io.run_folder.RunFolder.writing`. Each draw gets three files in transforms/:
        draw-01.h5 and draw-01_inverse.h5 from `bayesreg.io.transforms.save_transform`, and draw-01.nii.gz, the
        displacement including the pose.
    transform : Transform
        The transform from the fixed image's world.
    grid : Image
        The grid of the fixed image. The mean's field has a value at every voxel centre. If voxels are much smaller than
        the tetrahedra, in which the field is linear, it has values only at every second, third, … voxel centre.
    """
    pose, upright = transform.pose, grid.on_orthogonal_grid(order=0)
    forward_grid = _every(upright, _step(transform.mesh, upright))
    save_transform(place(MEAN), displacement_on(transform.mean, forward_grid).field, forward_grid, pose)
    inverse_grid = around_displaced(forward_grid, transform.mesh.points + transform.u_mean)
    save_transform(
        place(MEAN_INVERSE), return_on(transform.mean, inverse_grid).field, inverse_grid, pose.inverse, pose_first=True
    )
    if len(transform.draws):
        _write_ensemble(place, transform, upright)


def _step(mesh: TetMesh, grid: Image) -> Int[np.ndarray, "3"]:
    """Compute the step n of each axis if the mean is written at every n-th voxel."""
    return np.maximum(np.floor(MEAN_SPACING * mesh.boundary_edge / grid.voxel_sizes), 1).astype(int)


def _every(grid: Image, step: Int[np.ndarray, "3"]) -> Image:
    """Build the grid of every n-th voxel centre along each axis that extends at least as far as the full grid."""
    shape = -(-(np.array(grid.shape) - 1) // step) + 1
    return Image(np.zeros(shape, np.int8), np.array(grid.affine) * np.append(step, 1))


def _write_ensemble(place: Place, transform: Transform, grid: Image) -> None:
    sizes = np.maximum(grid.voxel_sizes, ENSEMBLE_SPACING * transform.mesh.boundary_edge)
    forward_grid = grid.with_voxels(np.zeros(grid.shape, np.int8)).on_orthogonal_grid(sizes, order=0)
    inverse_grid = around_displaced(forward_grid, transform.mesh.points + transform.u_mean)
    located, near = (
        displacement_on(transform.mean, forward_grid).locations,
        return_on(transform.mean, inverse_grid).locations,
    )
    points, digits = forward_grid.grid_points(), len(str(len(transform.draws)))
    for number, u in enumerate(transform.draws, start=1):
        displaced, name = transform.deformer.displaced(u), f"{ENSEMBLE}/draw-{number:0{digits}d}"
        field = displacement_on(displaced, forward_grid, located).field
        save_transform(place(f"{name}.h5"), field, forward_grid, transform.pose)
        save_displacement(
            place(f"{name}.nii.gz"), total_displacement(transform.pose, points, field), forward_grid.affine
        )
        returns = return_on(displaced, inverse_grid, near).field
        save_transform(place(f"{name}_inverse.h5"), returns, inverse_grid, transform.pose.inverse, pose_first=True)


def total_displacement(
    pose: Pose, points: Float[np.ndarray, "X Y Z 3"], field: Float[np.ndarray, "X Y Z 3"]
) -> Float[np.ndarray, "X Y Z 3"]:
    """Compute the displacement of points to the moving image's world, including the pose, mm, float32."""
    return np.asarray(pose.displacement(points, field), np.float32)


def around_displaced(grid: Image, points: Float[np.ndarray, "k 3"]) -> Image:
    """Enlarge a grid by whole voxels so that it holds points and a margin of `MARGIN` around them."""
    index, margin = grid.world_to_voxel(points), MARGIN / grid.voxel_sizes
    low = np.minimum(np.floor(index.min(axis=0) - margin), 0).astype(int)
    high = np.maximum(np.ceil(index.max(axis=0) + margin), np.array(grid.shape) - 1).astype(int)
    affine = np.array(grid.affine)
    affine[:3, 3] = grid.voxel_to_world(low.astype(float))
    return Image(np.zeros(high - low + 1, np.int8), affine)
