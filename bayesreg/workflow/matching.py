"""Match the moving image, or measured points, to the fixed image before the registration: pose and intensities."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayesreg.config.data import FilesData
from bayesreg.ignored import find_filling, ignored_voxels
from bayesreg.image import Image, IntensityScale, robust_scale
from bayesreg.io.domain import relative_size
from bayesreg.io.grids import check_same_space
from bayesreg.io.records import Channel, Matching
from bayesreg.model.observations.images.image_pose import WIDE, Candidate, PosePrior, find_poses
from bayesreg.model.observations.images.similarity import AnySimilarity
from bayesreg.model.observations.surface import Surface, SurfaceSection
from bayesreg.model.observations.surface_pose import find_pose as find_surface_pose
from bayesreg.pose import Pose
from bayesreg.types import InputError
from bayesreg.workflow.appraisal import Likeness, compare_images, within

# A pose turned by more degrees than this is not taken by itself: an axis may be mistaken.
MOST_DEGREES = 45.0
# The filling around what an image shows is ignored if it holds a greater share of the organ. Where it holds less, as
# around a brain without its skull, it shows the outline of the organ.
FILLING = 0.05
# The user is warned if a mask ignores a greater share of the organ: zero and nonzero may be interchanged in it.
MOST_IGNORED = 0.5
# A pose is taken instead of that of the headers if its lead in log evidence is greater than this, and its log
# likelihood more than so many times as great: a brain that has sunk in its skull is no head that has moved. The user is
# warned if the pose of a surface has no greater lead.
CLEAR, GAIN = 5.0, 1.05


class FoundPose(NamedTuple):
    """The pose of a pair of images, with a sentence that describes it, and warnings."""

    pose: Pose
    note: str
    warnings: tuple[str, ...] = ()


class MatchedImages(NamedTuple):
    """The fixed and the moving image in one world, with scaled intensities.

    Attributes
    ----------
    matching : Matching
        The pose, whether both images have one contrast, and the intensity scale of the moving image.
    fixed, moving : Image
        The scaled images in the world of the fixed image.
    fixed_ignore, moving_ignore : Image or None
        The masks of ignored voxels of the fixed and the moving image, in the world of the fixed image.
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
    fixed_ignore: Image | None
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
    found: FoundPose | None = None,
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
    found : FoundPose, optional
        The pose, if it has been found already.

    Raises
    ------
    InputError
        If the images do not overlap, an image is constant in Ω, or the masks ignore all of Ω.
    """
    found = found or find_image_pose(data, domain, fixed, moving, fixed_ignore, moving_ignore)
    pose, moving = found.pose, found.pose.aligned(moving)
    moving_ignore = None if moving_ignore is None else pose.aligned(moving_ignore)
    of_masks, warnings = _describe_ignored(domain, {"fixed": fixed_ignore, "moving": moving_ignore})
    fixed_ignore, of_fixed_view = _with_filling("fixed", fixed, fixed_ignore, domain)
    moving_ignore, of_moving_view = _with_filling("moving", moving, moving_ignore, domain)
    ignored = {"fixed": fixed_ignore, "moving": moving_ignore}
    region = _seen(domain, ignored.values())
    # The scales are computed before the comparison: if an image is constant in Ω, they raise an error that names it.
    scales = _scale_of("fixed", fixed, region.voxels != 0), _scale_of("moving", moving, within(region, moving))
    likeness = compare_images(fixed, moving, region)
    alike = likeness.is_one_contrast if data.same_contrast is None else data.same_contrast
    in_patches = data.same_contrast is None and not similarity.serves_any_contrast and likeness.is_related_in_patches
    alike &= not in_patches
    one_scale = alike and (data.same_contrast is True or likeness.is_one_scale)
    scale = scales[0] if one_scale else scales[1]
    of_contrast = (
        _describe_patches(likeness)
        if in_patches
        else _describe_contrast(alike, one_scale, likeness, data.same_contrast is None, similarity)
    )
    matching = Matching(pose, alike, scale, in_patches)
    images = scales[0](fixed), scale(moving)
    notes = found.note, of_contrast, *of_fixed_view, *of_moving_view, *of_masks
    return MatchedImages(matching, *images, fixed_ignore, moving_ignore, likeness, notes, (*found.warnings, *warnings))


def match_channel(
    data: FilesData,
    domain: Image,
    matched: MatchedImages,
    name: str,
    fixed: Image,
    moving: Image,
) -> Channel:
    """Match a further pair of images with the pose of the first pair; each image gets its own intensity scale.

    Parameters
    ----------
    data : FilesData
    domain : Image
        Nonzero in Ω, on the grid of the first fixed image.
    matched : MatchedImages
        The first pair. Its masks are applied to the further pair, too.
    name : str
        The name of the further pair in error messages.
    fixed, moving : Image
        The images of the further pair, in the worlds of the first fixed and the first moving image.

    Raises
    ------
    InputError
        If an image does not overlap Ω or is constant in Ω, or the masks ignore all of Ω.
    """
    moving = matched.matching.pose.aligned(moving)
    region = _seen(domain, (matched.fixed_ignore, matched.moving_ignore))
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


def _with_filling(name: str, image: Image, ignore: Image | None, domain: Image) -> tuple[Image | None, list[str]]:
    """Add the filling around what an image shows to its mask of ignored voxels, and describe it."""
    filling = find_filling(image)
    inside = np.asarray(domain.voxels) != 0
    filled = inside & ignored_voxels(domain, image.with_voxels(filling.astype(np.uint8)))
    share = np.count_nonzero(filled) / np.count_nonzero(inside)
    if share <= FILLING:
        return ignore, []
    millilitres = np.count_nonzero(filled) * domain.voxel_volume / 1e3
    note = (
        f"View: in the {name} image, {millilitres:.3g} ml of the organ ({share:.0%}) lie in the constant filling "
        "around what was seen; nothing is compared there."
    )
    given = np.zeros(image.shape, bool) if ignore is None else ignored_voxels(image, ignore)
    return image.with_voxels((filling | given).astype(np.uint8)), [note]


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


def find_image_pose(
    data: FilesData,
    organ: Image,
    fixed: Image,
    moving: Image,
    fixed_ignore: Image | None = None,
    moving_ignore: Image | None = None,
) -> FoundPose:
    """Find the pose of a pair of images, if the settings do not prescribe that of the headers.

    The pose that the likelihood and the prior of the motion (`data.pose_sd`) support best is taken. A pose beyond
    `MOST_DEGREES`, or by which the moving image shows less than half as much of the organ, is not taken unless the
    settings say that the pose is unknown.

    Parameters
    ----------
    data : FilesData
    organ : Image
        Nonzero in the organ, on the grid of the fixed image.
    fixed, moving : Image
        Each lies in its own world.
    fixed_ignore, moving_ignore : Image, optional
        Nonzero where the image of that name is ignored, each in the world of its image.

    Raises
    ------
    InputError
        If an image has the same intensity everywhere, or no pose makes the images overlap.
    """
    for name, image in (("fixed", fixed), ("moving", moving)):
        if np.ptp(image.voxels) == 0:
            raise InputError(f"the {name} image has the same intensity everywhere: it shows nothing to register")
    if data.pose == "fixed":
        check_same_space(fixed, moving, ("fixed", "moving"))
        return FoundPose(Pose.identity(), "Pose: as the headers say (because of data.pose: fixed).")
    is_unknown = data.pose == "unknown"
    prior = WIDE if is_unknown else PosePrior(*data.pose_sd)
    size = relative_size(np.asarray(organ.voxels) != 0, organ.voxel_volume)
    headers, near, best = find_poses(fixed, moving, organ, size, fixed_ignore, moving_ignore, prior, is_unknown)
    if best.likelihood <= 0:
        raise InputError(
            "no pose makes the two images overlap by more than chance; check that they show the same organ"
        )
    doubt = None if is_unknown else _doubt_pose(best, headers)
    other = best if doubt is None else near
    takes_other = other.evidence > headers.evidence + CLEAR and other.likelihood > GAIN * headers.likelihood
    pose = other.pose if takes_other else Pose.identity()
    return FoundPose(pose, _describe_image_pose(headers, other, takes_other), () if doubt is None else (doubt,))


def _doubt_pose(pose: Candidate, headers: Candidate) -> str | None:
    """Return why a pose is not taken by itself, as a warning; None if it may be taken."""
    if pose.motion.degrees > MOST_DEGREES:
        reason = f"turns the organ by {pose.motion.degrees:.0f}°"
    elif pose.seen < headers.seen / 2:
        reason = (
            f"leaves {pose.seen:.0%} of the organ in the view of the moving image, where there were {headers.seen:.0%}"
        )
    else:
        return None
    return (
        f"Another pose would explain the images better, and {reason}: it was not taken. If the headers say nothing "
        "about the pose, data.pose: unknown takes it."
    )


def _describe_image_pose(headers: Candidate, other: Candidate, takes_other: bool) -> str:
    motion = f"{other.motion.millimetres:.1f} mm and {other.motion.degrees:.1f}° off"
    if takes_other:
        return (
            f"Pose: {motion} the headers (log evidence {other.evidence:.0f}, and {headers.evidence:.0f} of the "
            "headers' pose; data.pose: fixed keeps the headers' pose)."
        )
    return (
        f"Pose: as the headers say (log evidence {headers.evidence:.0f}; the best other pose, {motion} them, has "
        f"{other.evidence:.0f})."
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


def _describe_patches(likeness: Likeness) -> str:
    return (
        "Contrast: unlike, and another one from place to place, as of MRI and ultrasound (one map explains "
        f"{likeness.map_share_within:.0%} of the variance within patches of the moving image, maps of their own "
        f"{likeness.patch_share_within:.0%}); compared by lc2, patch by patch (data.same_contrast: false takes one "
        "map)."
    )


def _scale_of(name: str, image: Image, mask: np.ndarray) -> IntensityScale:
    try:
        return robust_scale(image, mask)
    except InputError as error:
        raise InputError(f"the {name} image within the organ: {error}") from error
