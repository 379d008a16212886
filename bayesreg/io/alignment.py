"""Starting points of a search, from SimpleITK: the pose of an organ between two images, and a field from Demons."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
import SimpleITK
from jaxtyping import Float
from scipy import ndimage

from bayesreg.ignored import fill_ignored, ignored_voxels
from bayesreg.image import Image
from bayesreg.io.domain import relative_size
from bayesreg.io.itk import from_itk, to_itk
from bayesreg.io.spaces import LPS, convert_motion
from bayesreg.pose import Motion, Pose
from bayesreg.types import InputError

# Lengths hold for a human brain, in mm; for other organs they are scaled in proportion.
# The comparison includes the organ's surroundings, such as skull and scalp, up to this distance.
SURROUNDINGS = 15.0
# For each level: edge of the voxels, share of the voxels that are sampled, and number of candidates at its start.
LEVELS: tuple[tuple[float, float, int | None], ...] = ((8.0, 1.0, None), (4.0, 1.0, 3), (2.0, 0.5, 1))
# Rotations about each axis, in degrees, of a head in a scanner or on a table that are tried besides no rotation.
TURNS = (-25.0, 25.0)
# For each level of Demons: factor by which each axis is coarsened, and number of iterations.
DEMONS = ((4, 200), (2, 100), (1, 50))
BINS = 32
ITERATIONS = 200


class Alignment(NamedTuple):
    """A pose and the mutual information that supports it.

    Attributes
    ----------
    pose : Pose
    information : float
        Mutual information of both images around the organ by this pose, nats.
    as_given : float
        Mutual information if the images lie where their headers place them, nats.
    """

    pose: Pose
    information: float
    as_given: float


def find_pose(
    fixed: Image,
    moving: Image,
    organ: Image,
    fixed_ignore: Image | None = None,
    moving_ignore: Image | None = None,
) -> Alignment:
    """Find the pose by Mattes' mutual information, coarse to fine, from several starts.

    The first start places the images by their headers, two more match the centres of the grids and the centres of mass
    of the intensities. Each is tried without rotation and rotated about each axis. The coarsest level compares all
    starts; the finer levels compare the best ones and the one from the headers.

    Parameters
    ----------
    fixed, moving : Image
    organ : Image
        Nonzero in the organ, on the grid of the fixed image. The comparison includes some millimetres around it.
    fixed_ignore, moving_ignore : Image, optional
        Nonzero where the image of that name is ignored, on any grid in its world.

    Raises
    ------
    InputError
        If no start makes the images overlap.

    Notes
    -----
    The same images give the same pose, since a fixed seed chooses the points that are sampled.
    """
    size = relative_size(np.asarray(organ.voxels) != 0, organ.voxel_volume)
    region = _around(organ, size * SURROUNDINGS)
    moving_mask = None if moving_ignore is None else moving.with_voxels(~ignored_voxels(moving, moving_ignore))
    if fixed_ignore is not None:
        region = region.with_voxels(np.asarray(region.voxels) * ~ignored_voxels(region, fixed_ignore))
    # Smoothing and the centre of mass must not use ignored voxels, either.
    fixed, moving = fill_ignored(fixed, fixed_ignore), fill_ignored(moving, moving_ignore)
    headers = _euler(Pose.identity(), _centre_of(organ))
    starts, near_headers, best = list(_starts(fixed, moving, organ)), headers, headers
    for edge, share, most in LEVELS:
        level = _Level.of(fixed, moving, region, moving_mask, size * edge, share)
        # The start from the headers stays at every level: if the headers are right, no other start is nearer.
        near_headers, *others = (level.improve(start) for start in (near_headers, *starts[:most]))
        # A step of the optimiser can also make a pose worse, so that the headers stay among the candidates.
        starts = sorted((headers, near_headers, *others), key=level.value, reverse=True)
        best = starts[0]
    information, as_given = level.value(best), level.value(headers)
    if information <= 0:
        raise InputError(
            "no pose makes the two images overlap by more than chance; check that they show the same organ"
        )
    return Alignment(_pose(best), information, as_given)


def find_demons(fixed: Image, moving: Image) -> tuple[Image, Image, Image]:
    """Find the displacement between two aligned images of one contrast by diffeomorphic Demons.

    The search has three levels and smooths the field by 1.5 voxels after each iteration. The histogram of the moving
    image is first matched to that of the fixed image, since Demons compare intensities. (Vercauteren et al. 2009,
    "Diffeomorphic demons: efficient non-parametric image registration".)

    Returns
    -------
    tuple of Image
        The x, y and z components of the displacement, mm, world RAS.
    """
    fixed_image, moving_image = (
        to_itk(image, "float32") for image in (fixed.on_orthogonal_grid(), moving.on_orthogonal_grid())
    )
    moving_image = SimpleITK.Resample(moving_image, fixed_image, SimpleITK.Transform(), SimpleITK.sitkLinear, 0.0)
    moving_image = SimpleITK.HistogramMatching(moving_image, fixed_image, 256, 15, True)
    field = None
    for factor, iterations in DEMONS:
        level = [_thinned(image, factor) for image in (fixed_image, moving_image)]
        method = SimpleITK.DiffeomorphicDemonsRegistrationFilter()
        method.SetNumberOfIterations(iterations)
        method.SetSmoothDisplacementField(True)
        method.SetStandardDeviations(1.5)
        field = method.Execute(*level) if field is None else method.Execute(*level, SimpleITK.Resample(field, level[0]))
    assert field is not None
    volume = from_itk(field)
    x, y, z = (Image(values, volume.affine) for values in np.moveaxis(volume.voxels * LPS, -1, 0))
    return x, y, z


def _thinned(image: SimpleITK.Image, factor: int) -> SimpleITK.Image:
    """Smooth an image and keep every n-th voxel along each axis, with n the factor."""
    if factor == 1:
        return image
    sd = [factor / 2 * size for size in image.GetSpacing()]
    return SimpleITK.Shrink(SimpleITK.SmoothingRecursiveGaussian(image, sd), [factor] * 3)


def _starts(fixed: Image, moving: Image, organ: Image) -> Iterator[SimpleITK.Euler3DTransform]:
    centre = _centre_of(organ)
    shifts = [np.zeros(3)]
    for of in (_grid_centre, _mass_centre):
        shifts.append(of(moving) - of(fixed))
    turns = [np.zeros(3)] + [angle * np.eye(3)[axis] for axis, angle in product(range(3), TURNS)]
    for shift, turn in list(product(shifts, turns))[1:]:
        yield _euler(Motion(shift, turn).pose(centre), centre)


class _Level(NamedTuple):
    """Both images on grids of one resolution, and the options of their comparison."""

    fixed: SimpleITK.Image
    moving: SimpleITK.Image
    edge: float
    share: float
    fixed_mask: SimpleITK.Image
    moving_mask: SimpleITK.Image | None

    @classmethod
    def of(
        cls, fixed: Image, moving: Image, fixed_mask: Image, moving_mask: Image | None, edge: float, share: float
    ) -> _Level:
        masks = [
            None if mask is None else to_itk(_coarser(mask, edge, 0), "uint8") for mask in (fixed_mask, moving_mask)
        ]
        fixed_image, moving_image = (to_itk(_coarser(image, edge, 1), "float32") for image in (fixed, moving))
        assert masks[0] is not None
        return cls(fixed_image, moving_image, edge, share, masks[0], masks[1])

    def method(self) -> SimpleITK.ImageRegistrationMethod:
        method = SimpleITK.ImageRegistrationMethod()
        method.SetMetricAsMattesMutualInformation(BINS)
        method.SetMetricFixedMask(self.fixed_mask)
        if self.moving_mask is not None:
            method.SetMetricMovingMask(self.moving_mask)
        if self.share < 1:
            method.SetMetricSamplingStrategy(method.RANDOM)
            method.SetMetricSamplingPercentage(self.share, 1)
        method.SetInterpolator(SimpleITK.sitkLinear)
        # One thread sums in a fixed order, so that the same images give the same pose exactly.
        method.SetNumberOfThreads(1)
        method.SetNumberOfWorkUnits(1)
        return method

    def improve(self, start: SimpleITK.Euler3DTransform) -> SimpleITK.Euler3DTransform:
        """Find the best pose near a start; return the start if the images do not overlap."""
        method, transform = self.method(), SimpleITK.Euler3DTransform(start)
        method.SetOptimizerAsRegularStepGradientDescent(self.edge / 2, 1e-3 * self.edge, ITERATIONS, 0.6)
        method.SetOptimizerScalesFromPhysicalShift()
        method.SetInitialTransform(transform, inPlace=True)
        try:
            method.Execute(self.fixed, self.moving)
        except RuntimeError:
            return start
        return transform

    def value(self, transform: SimpleITK.Euler3DTransform) -> float:
        """Compute the mutual information, nats; 0 if the images do not overlap."""
        method = self.method()
        method.SetInitialTransform(SimpleITK.Euler3DTransform(transform), inPlace=True)
        try:
            return -float(method.MetricEvaluate(self.fixed, self.moving))
        except RuntimeError:
            return 0.0


def _around(organ: Image, distance: float) -> Image:
    """Mark the organ and its surroundings up to a distance, mm."""
    away = ndimage.distance_transform_edt(np.asarray(organ.voxels) == 0, organ.voxel_sizes)
    return organ.with_voxels((away <= distance).astype(np.uint8))


def _coarser(image: Image, edge: float, order: int) -> Image:
    """Resample an image on orthogonal axes with voxels of about this edge, mm.

    The image is smoothed first, unless the order is 0 (nearest voxels).
    """
    sizes, wanted = image.voxel_sizes, np.maximum(image.voxel_sizes, edge)
    if order:
        blur = np.where(wanted > sizes, wanted / sizes / 2, 0.0)
        image = image.with_voxels(ndimage.gaussian_filter(np.asarray(image.voxels, float), blur, mode="nearest"))
    return image.on_orthogonal_grid(wanted, order)


def _centre_of(mask: Image) -> Float[np.ndarray, "3"]:
    return mask.voxel_to_world(np.argwhere(np.asarray(mask.voxels) != 0).mean(0))


def _grid_centre(image: Image) -> Float[np.ndarray, "3"]:
    return image.voxel_to_world((np.array(image.shape) - 1) / 2)


def _mass_centre(image: Image) -> Float[np.ndarray, "3"]:
    voxels = np.asarray(image.voxels, float)
    return image.voxel_to_world(np.array(ndimage.center_of_mass(voxels - voxels.min() + 1e-12)))


def _euler(pose: Pose, centre: Float[np.ndarray, "3"]) -> SimpleITK.Euler3DTransform:
    """Convert a motion in RAS to ITK's transform in LPS with a given centre of rotation."""
    lps, about = convert_motion(pose.matrix), centre * LPS
    transform = SimpleITK.Euler3DTransform()
    transform.SetCenter(about.tolist())
    transform.SetMatrix(lps[:3, :3].ravel().tolist())
    transform.SetTranslation((lps[:3, :3] @ about + lps[:3, 3] - about).tolist())
    return transform


def _pose(transform: SimpleITK.Euler3DTransform) -> Pose:
    """Convert ITK's transform in LPS to a motion in RAS."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(transform.GetMatrix()).reshape(3, 3)
    centre = np.array(transform.GetCenter())
    matrix[:3, 3] = np.array(transform.GetTranslation()) + centre - matrix[:3, :3] @ centre
    return Pose(convert_motion(matrix))
