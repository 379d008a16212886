"""How the moving image is brought beside the fixed one before the model sees it: pose, contrast and scale."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayesreg.config.data import FilesData
from bayesreg.image import Image, IntensityScale, robust_scale
from bayesreg.io.alignment import find_pose
from bayesreg.io.records import Channel, Matching
from bayesreg.io.volumes import check_same_space
from bayesreg.pose import Pose
from bayesreg.types import InputError
from bayesreg.workflow.appraisal import Likeness, compare_images

# A pose is taken where the images share so many times as much information as where the headers place them.
GAIN = 1.05


class Matched(NamedTuple):
    """Two images side by side.

    Attributes
    ----------
    matching : Matching
    fixed, moving : Image
        In one world and scaled.
    moving_ignore : Image or None
        In that world.
    likeness : Likeness
        How alike they are.
    notes : tuple of str
        What was found, a sentence each.
    """

    matching: Matching
    fixed: Image
    moving: Image
    moving_ignore: Image | None
    likeness: Likeness
    notes: tuple[str, ...]


def match_images(
    data: FilesData, domain: Image, fixed: Image, moving: Image, moving_ignore: Image | None = None
) -> Matched:
    """Find what `data` leaves to be found: the pose, whether both are of one contrast, and their scales.

    Parameters
    ----------
    data : FilesData
    domain : Image
        Not zero in Ω, on the grid of the fixed image.
    fixed, moving : Image
    moving_ignore : Image, optional
        Not zero where the moving image says nothing.

    Raises
    ------
    InputError
        If the images do not overlap, or one is constant in Ω.
    """
    for name, image in (("fixed", fixed), ("moving", moving)):
        if np.ptp(image.voxels) == 0:
            raise InputError(f"the {name} image has the same intensity everywhere: it shows nothing to register")
    pose, of_pose = _find_pose(data, domain, fixed, moving, moving_ignore)
    moving = pose.aligned(moving)
    moving_ignore = None if moving_ignore is None else pose.aligned(moving_ignore)
    # A constant image is told by its name, before it is compared.
    scales = _scale_of("fixed", fixed, domain.voxels != 0), _scale_of("moving", moving, within(domain, moving))
    likeness = compare_images(fixed, moving, domain)
    alike = likeness.is_one_contrast if data.same_contrast is None else data.same_contrast
    one_scale = alike and (data.same_contrast is True or likeness.is_one_scale)
    scale = scales[0] if one_scale else scales[1]
    notes = (of_pose, _describe_contrast(alike, one_scale, likeness, data.same_contrast is None))
    matching = Matching(pose, alike, scale)
    return Matched(matching, scales[0](fixed), scale(moving), moving_ignore, likeness, notes)


def match_channel(
    data: FilesData, domain: Image, matching: Matching, name: str, fixed: Image, moving: Image
) -> Channel:
    """A further pair of images in the pose of the first, each image on a scale of its own.

    Raises
    ------
    InputError
        If an image does not overlap the organ, or is constant there.
    """
    moving = matching.pose.aligned(moving)
    alike = data.same_contrast
    if alike is None:
        alike = compare_images(fixed, moving, domain).is_one_contrast
    return Channel(_scaled(f"{name} fixed", fixed, domain), _scaled(f"{name} moving", moving, domain), alike)


def _scaled(name: str, image: Image, domain: Image) -> Image:
    check_same_space(domain, image, ("fixed", name))
    return _scale_of(name, image, within(domain, image))(image)


def _find_pose(
    data: FilesData, domain: Image, fixed: Image, moving: Image, moving_ignore: Image | None
) -> tuple[Pose, str]:
    """The pose, and what is said of it."""
    if data.pose == "fixed":
        check_same_space(fixed, moving, ("fixed", "moving"))
        return Pose.identity(), "Pose: as the headers say (data.pose: fixed)."
    found = find_pose(fixed, moving, domain, moving_ignore)
    told = f"mutual information {found.as_given:.2f} as the headers say"
    if found.information <= GAIN * found.as_given:
        return Pose.identity(), f"Pose: as the headers say, since no other brings much: {told}."
    centre = domain.voxel_to_world(np.argwhere(np.asarray(domain.voxels) != 0).mean(axis=0))
    motion = found.pose.about(centre)
    return found.pose, (
        f"Pose: {motion.millimetres:.1f} mm and {motion.degrees:.1f}° off the headers: {told}, "
        f"{found.information:.2f} so (data.pose: fixed keeps the headers')."
    )


def _describe_contrast(alike: bool, one_scale: bool, likeness: Likeness, found: bool) -> str:
    how = "found" if found else "as data.same_contrast says"
    shares = f"a straight line explains {likeness.line_share:.0%} of the moving image, any map {likeness.map_share:.0%}"
    if not alike:
        return f"Contrast: unlike ({how}; {shares}); compared through a map of the fixed image's intensities."
    scale = "on one scale" if one_scale else "each on a scale of its own"
    return f"Contrast: the same ({how}; {shares}); intensities {scale}."


def _scale_of(name: str, image: Image, mask: np.ndarray) -> IntensityScale:
    try:
        return robust_scale(image, mask)
    except InputError as error:
        raise InputError(f"the {name} image within the organ: {error}") from error


def within(domain: Image, image: Image) -> np.ndarray:
    """Tell which voxels of an image on another grid lie in the domain."""
    return np.asarray(domain.interpolate(image.grid_points())) > 0.5
