"""Displacement fields on grids, there and back, and the transforms that a run leaves for other programs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayesreg.fem.deformation import Displaced
from bayesreg.fem.location import Location
from bayesreg.image import Image
from bayesreg.io.fields import save_displacement
from bayesreg.io.store import Place
from bayesreg.io.transforms import save_transform
from bayesreg.mesh import TetMesh
from bayesreg.model.submesh import submesh_variance
from bayesreg.model.warp import covered_voxels
from bayesreg.pose import Pose
from bayesreg.results.transform import Transform

MEAN, MEAN_INVERSE, ENSEMBLE = "transform_mean.h5", "transform_mean_inverse.h5", "transforms"
# Between the voxels of an ensemble's fields, in mean edges of the mesh: linear interpolation then errs by 0.02 mm in
# the median, and by 0.2 mm at most where a draw bends by some mm from node to node.
ENSEMBLE_SPACING = 0.2
# Between the voxels of the mean's transforms, in mean edges of the mesh, rounded down to whole voxels of the image.
MEAN_SPACING = 0.15
# What is written is a multiple of this, mm: the mean in the mesh, around it, where nothing is observed, and the sd.
MEAN_STEP, STEP_AROUND, SD_STEP = 2.0**-8, 2.0**-4, 2.0**-9
# What the grid of an inverse reaches beyond the displaced mesh, mm.
MARGIN = 10.0


class Moments(NamedTuple):
    """The displacement from one world to the other at the voxel centres of an image, world RAS, single precision.

    Attributes
    ----------
    mean : (X, Y, Z, 3) array
        mm, the pose included, in the mesh and around it.
    sd : (X, Y, Z, 3) array
        mm. Its variance is that of the nodes, interpolated as a standard deviation, and what the mesh cannot follow of
        a smooth displacement (`bayesreg.model.submesh`). Zero around the mesh.
    rms_sd : dict
        Root mean square over the voxels in the mesh and the axes of both parts of it: "nodes", "mesh".
    """

    mean: Float[np.ndarray, "X Y Z 3"]
    sd: Float[np.ndarray, "X Y Z 3"]
    rms_sd: dict[str, float]

    @property
    def rounded(self) -> tuple[Float[np.ndarray, "X Y Z 3"], Float[np.ndarray, "X Y Z 3"]]:
        """Mean and standard deviation as they are written: rounded, so that files are small."""
        inside = (self.sd > 0).any(axis=-1, keepdims=True)
        step = np.where(inside, np.float32(MEAN_STEP), np.float32(STEP_AROUND))
        sd = np.maximum(np.rint(self.sd / np.float32(SD_STEP)), inside) * np.float32(SD_STEP)
        return np.rint(self.mean / step) * step, sd


def moments_on(transform: Transform, nodal_sd: Float[np.ndarray, "nodes 3"], grid: Image) -> Moments:
    """The displacement by the posterior mean, and its standard deviation, at the voxel centres of an image.

    Parameters
    ----------
    transform : Transform
        From the fixed image's world.
    nodal_sd : (n, 3) array
        Posterior standard deviation at the nodes, mm, along the axes of the moving image's world.
    grid : Image
    """
    mesh, pose = transform.mesh, transform.pose
    step = _step(mesh, grid)
    # Around the mesh, where the displacement is smooth and nothing is observed, that of every n-th voxel will do.
    mean = _between(displacement_on(transform.mean, _every(grid, step)).field, step, grid.shape)
    covered = covered_voxels(grid, mesh)
    at = np.ravel_multi_index(tuple(covered.voxel.T), grid.shape)
    corners = mesh.cells[covered.cell]
    mean[at] = np.einsum("ka,kai->ki", covered.barycentric, transform.u_mean[corners])
    for some, points in grid.blocks():
        mean[some] = pose.displacement(points, mean[some])
    nodal = np.einsum("ka,kai->ki", covered.barycentric, nodal_sd[corners]) ** 2
    beyond = submesh_variance(mesh, pose.displacement(mesh.points, transform.u_mean))[covered.cell]
    sd = np.zeros_like(mean)
    sd[at] = np.sqrt(nodal + beyond)
    shape, parts = (*grid.shape, 3), {"nodes": nodal, "mesh": beyond}
    rms = {name: float(np.sqrt(part.mean())) for name, part in parts.items()}
    return Moments(mean.reshape(shape), sd.reshape(shape), rms)


def _between(
    field: Float[np.ndarray, "x y z 3"], step: Int[np.ndarray, "3"], shape: tuple[int, ...]
) -> Float[np.ndarray, "voxels 3"]:
    """A field of every n-th voxel, linearly interpolated at all of them, in the order of memory."""
    for axis, (every, length) in enumerate(zip(step, shape, strict=True)):
        before, share = np.divmod(np.arange(length), every)
        after = np.minimum(before + 1, field.shape[axis] - 1)
        weight = np.expand_dims((share / every).astype(np.float32), tuple({0, 1, 2, 3} - {axis}))
        first = field.take(before, axis)
        field = first + weight * (field.take(after, axis) - first) if every > 1 else first
    return field.reshape(-1, 3)


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


def write_transforms(place: Place, transform: Transform, grid: Image) -> None:
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
        Of the fixed image. The mean's field stands at every voxel centre, or where voxels are much smaller than
        tetrahedra, in which the field is linear, at every second, third, …
    """
    pose, upright = transform.pose, grid.on_orthogonal_grid(order=0)
    there = _every(upright, _step(transform.mesh, upright))
    save_transform(place(MEAN), displacement_on(transform.mean, there).field, there, pose)
    back = around_displaced(there, transform.mesh.points + transform.u_mean)
    save_transform(place(MEAN_INVERSE), return_on(transform.mean, back).field, back, pose.inverse, pose_first=True)
    if len(transform.draws):
        _write_ensemble(place, transform, upright)


def _step(mesh: TetMesh, grid: Image) -> Int[np.ndarray, "3"]:
    """How many voxels lie between those at which the mean is written, by axis."""
    return np.maximum(np.floor(MEAN_SPACING * mesh.boundary_edge / grid.voxel_sizes), 1).astype(int)


def _every(grid: Image, step: Int[np.ndarray, "3"]) -> Image:
    """A grid of every n-th voxel centre along each axis, which reaches as far as the whole does."""
    shape = -(-(np.array(grid.shape) - 1) // step) + 1
    return Image(np.zeros(shape, np.int8), np.array(grid.affine) * np.append(step, 1))


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
