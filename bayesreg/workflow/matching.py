"""Match the moving image, or measured points, to the fixed image before the registration: pose and intensities."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayesreg.config.data import FilesData
from bayesreg.ignored import ignored_voxels
from bayesreg.image import Image, IntensityScale, robust_scale
from bayesreg.io.alignment import find_pose
from bayesreg.io.grids import check_same_space
from bayesreg.io.records import Channel, Matching
from bayesreg.model.observations.images.similarity import AnySimilarity
from bayesreg.model.observations.surface import Surface, SurfaceSection
from bayesreg.model.observations.surface_pose import find_pose as find_surface_pose
from bayesreg.pose import Pose
from bayesreg.types import InputError
from bayesreg.workflow.appraisal import Likeness, compare_images

# The found pose replaces the headers' pose if its mutual information is more than this many times as great.
GAIN = 1.05
# The user is warned if a mask ignores a greater share of the organ: zero and nonzero may be interchanged in it.
MOST_IGNORED = 0.5
# The user is warned if the pose of a surface has no greater lead than this, in log evidence.
CLEAR = 5.0


class MatchedImages(NamedTuple):
    """The fixed and the moving image in one world, with scaled intensities.

    Attributes
    ----------
    matching : Matching
        The pose, whether both images have one contrast, and the intensity scale of the moving image.
    fixed, moving : Image
        The scaled images in the world of the fixed image.
    moving_ignore : Image or None
        The mask of ignored voxels of the moving image, in the world of the fixed image.
    likeness : Likeness
        Measures of the likeness of the two images.
    notes : tuple of str
        Findings about pose, contrast and masks, one sentence each.
    warnings : tuple of str
        Warnings about the masks, one sentence each.
    """

    matching: Matching
    fixed: Image
    moving: Image
    moving_ignore: Image | None
    likeness: Likeness
    notes: tuple[str, ...]
    warnings: tuple[str, ...] = ()


class MatchedPoints(NamedTuple):
    """The pose of pairs of points or of a measured surface.

    Attributes
    ----------
    matching : Matching
    notes, warnings : tuple of str
        One sentence each.
    """

    matching: Matching
    notes: tuple[str, ...]
    warnings: tuple[str, ...] = ()


def match_images(
    data: FilesData,
    similarity: AnySimilarity,
    domain: Image,
    fixed: Image,
    moving: Image,
    fixed_ignore: Image | None = None,
    moving_ignore: Image | None = None,
) -> MatchedImages:
    """Find the pose, decide whether both images have one contrast, and scale the intensities of both images.

    Parameters
    ----------
    data : FilesData
        The settings; they can prescribe the pose of the headers and whether both images have one contrast.
    similarity : settings of a similarity
        The similarity by which the model compares the images.
    domain : Image
        Nonzero in Ω, on the grid of the fixed image.
    fixed, moving : Image
        Each image lies in its own world.
    fixed_ignore, moving_ignore : Image, optional
        Masks that are nonzero where the fixed or the moving image is ignored. Each mask lies in the world of its image,
        and may have another grid.

    Raises
    ------
    InputError
        If the images do not overlap, an image is constant in Ω, or the masks ignore all of Ω.
    """
    for name, image in (("fixed", fixed), ("moving", moving)):
        if np.ptp(image.voxels) == 0:
            raise InputError(f"the {name} image has the same intensity everywhere: it shows nothing to register")
    pose, of_pose = _find_pose(data, domain, fixed, moving, fixed_ignore, moving_ignore)
    moving = pose.aligned(moving)
    moving_ignore = None if moving_ignore is None else pose.aligned(moving_ignore)
    ignored = {"fixed": fixed_ignore, "moving": moving_ignore}
    region = _seen(domain, ignored.values())
    # The scales are computed before the comparison: if an image is constant in Ω, they raise an error that names it.
    scales = _scale_of("fixed", fixed, region.voxels != 0), _scale_of("moving", moving, within(region, moving))
    likeness = compare_images(fixed, moving, region)
    alike = likeness.is_one_contrast if data.same_contrast is None else data.same_contrast
    one_scale = alike and (data.same_contrast is True or likeness.is_one_scale)
    scale = scales[0] if one_scale else scales[1]
    of_contrast = _describe_contrast(alike, one_scale, likeness, data.same_contrast is None, similarity)
    of_masks, warnings = _describe_ignored(domain, ignored)
    matching = Matching(pose, alike, scale)
    images = scales[0](fixed), scale(moving)
    return MatchedImages(matching, *images, moving_ignore, likeness, (of_pose, of_contrast, *of_masks), tuple(warnings))


def match_channel(
    data: FilesData,
    domain: Image,
    matched: MatchedImages,
    name: str,
    fixed: Image,
    moving: Image,
    fixed_ignore: Image | None = None,
) -> Channel:
    """Match a further pair of images with the pose of the first pair; each image gets its own intensity scale.

    Parameters
    ----------
    data : FilesData
    domain : Image
        Nonzero in Ω, on the grid of the first fixed image.
    matched : MatchedImages
        The first pair. The mask of its moving image is applied to the further pair, too.
    name : str
        The name of the further pair in error messages.
    fixed, moving : Image
        The images of the further pair, in the worlds of the first fixed and the first moving image.
    fixed_ignore : Image, optional
        The mask of the first fixed image.

    Raises
    ------
    InputError
        If an image does not overlap Ω or is constant in Ω, or the masks ignore all of Ω.
    """
    moving = matched.matching.pose.aligned(moving)
    region = _seen(domain, (fixed_ignore, matched.moving_ignore))
    alike = data.same_contrast
    if alike is None:
        alike = compare_images(fixed, moving, region).is_one_contrast
    return Channel(_scaled(f"{name} fixed", fixed, region), _scaled(f"{name} moving", moving, region), alike)


def _seen(domain: Image, masks: Iterable[Image | None]) -> Image:
    """Return an image on the grid of `domain` that is 1 in the part of Ω that no mask ignores, and 0 elsewhere.

    Raises
    ------
    InputError
        If the masks ignore all of Ω.
    """
    region = np.asarray(domain.voxels) != 0
    for mask in masks:
        if mask is not None:
            region &= ~ignored_voxels(domain, mask)
    if not region.any():
        raise InputError("all of the organ is ignored; check fixed_ignore and moving_ignore")
    return domain.with_voxels(region.astype(np.uint8))


def _describe_ignored(domain: Image, masks: Mapping[str, Image | None]) -> tuple[list[str], list[str]]:
    """Return notes on how much of Ω each mask ignores, and warnings about masks that ignore nothing or most of Ω."""
    notes, warnings = [], []
    inside = np.asarray(domain.voxels) != 0
    for name, mask in masks.items():
        if mask is None:
            continue
        ignored = np.count_nonzero(inside & ignored_voxels(domain, mask))
        millilitres, share = ignored * domain.voxel_volume / 1e3, ignored / np.count_nonzero(inside)
        notes.append(f"Ignored: {millilitres:.3g} ml of the organ in the {name} image.")
        if not ignored:
            warnings.append(
                f"data.{name}_ignore ignores nothing of the organ: the mask lies elsewhere in the world, or is empty."
            )
        elif share > MOST_IGNORED:
            warnings.append(
                f"data.{name}_ignore ignores {share:.0%} of the organ; what is not zero in the mask is ignored."
            )
    return notes, warnings


def _scaled(name: str, image: Image, domain: Image) -> Image:
    check_same_space(domain, image, ("fixed", name))
    return _scale_of(name, image, within(domain, image))(image)


def match_surface(
    section: SurfaceSection, points: Float[np.ndarray, "k 3"], tissue: Image, names: Sequence[str]
) -> MatchedPoints:
    """Find the pose of a measured surface from starts in all directions; its points are world RAS, mm.

    Parameters
    ----------
    section : SurfaceSection
    points : (k, 3) array
    tissue : Image
        0 outside the organ, 1 + index into the names inside.
    names : sequence of str
    """
    found = find_surface_pose(Surface(points, section.of, name=section.name), tissue, names)
    note = _describe_pose(found.pose, tissue, section.name, f"the best of {found.starts} starts of a rigid alignment")
    doubt = (
        f"{section.name}: another pose explains the points nearly as well (its log evidence is lower by "
        f"{found.lead:.1f}): a part of a surface hardly tells the pose. Pairs of points would (--landmarks), or "
        "navigated coordinates (data.pose: fixed)."
    )
    return MatchedPoints(Matching(found.pose), (note,), (doubt,) if found.lead < CLEAR else ())


def match_pairs(
    name: str, fixed: Float[np.ndarray, "k 3"], moving: Float[np.ndarray, "k 3"], tissue: Image
) -> MatchedPoints:
    """Find the pose of pairs of points by least squares, without start; they are world RAS, mm.

    Raises
    ------
    InputError
        If there are fewer than three.
    """
    if len(fixed) < 3:
        raise InputError(f"{name}: data.pose: unknown needs three pairs of points or more, got {len(fixed)}")
    centres = fixed.mean(axis=0), moving.mean(axis=0)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.align_vectors(moving - centres[1], fixed - centres[0])[0].as_matrix()
    matrix[:3, 3] = centres[1] - matrix[:3, :3] @ centres[0]
    pose = Pose(matrix)
    return MatchedPoints(Matching(pose), (_describe_pose(pose, tissue, name, "least squares"),))


def _describe_pose(pose: Pose, tissue: Image, name: str, source: str) -> str:
    motion = pose.about(tissue.voxel_to_world(np.argwhere(np.asarray(tissue.voxels) != 0)).mean(axis=0))
    return (
        f"Pose: the coordinates of {name} are {motion.millimetres:.1f} mm and {motion.degrees:.1f}° from those of the "
        f"organ, by {source} (data.pose: fixed takes them as they are)."
    )


def _find_pose(
    data: FilesData,
    domain: Image,
    fixed: Image,
    moving: Image,
    fixed_ignore: Image | None,
    moving_ignore: Image | None,
) -> tuple[Pose, str]:
    """Return the pose and a sentence that describes the pose."""
    if data.pose == "fixed":
        check_same_space(fixed, moving, ("fixed", "moving"))
        return Pose.identity(), "Pose: as the headers say (because of data.pose: fixed)."
    alignment = find_pose(fixed, moving, domain, fixed_ignore, moving_ignore)
    header_information = f"mutual information {alignment.as_given:.2f} with the headers' pose"
    if alignment.information <= GAIN * alignment.as_given:
        return Pose.identity(), f"Pose: as the headers say, since no other pose is much better: {header_information}."
    centre = domain.voxel_to_world(np.argwhere(np.asarray(domain.voxels) != 0).mean(axis=0))
    motion = alignment.pose.about(centre)
    return alignment.pose, (
        f"Pose: {motion.millimetres:.1f} mm and {motion.degrees:.1f}° off the headers: {header_information}, "
        f"{alignment.information:.2f} with this pose (data.pose: fixed keeps the headers' pose)."
    )


def _describe_contrast(
    alike: bool, one_scale: bool, likeness: Likeness, was_measured: bool, similarity: AnySimilarity
) -> str:
    how = "found" if was_measured else "as data.same_contrast says"
    shares = (
        f"a straight line explains {likeness.line_share:.0%} of the variance of the moving image, the best map "
        f"{likeness.map_share:.0%}"
    )
    if similarity.serves_any_contrast:
        contrast = "the same" if alike else "unlike"
        return f"Contrast: {contrast} ({how}; {shares}); compared by {similarity.kind}, which serves any contrast."
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
    """Mark the voxels of an image that lie in the domain; the two grids may differ."""
    return np.asarray(domain.interpolate(image.grid_points())) > 0.5
