"""Measure a pair of images and its labels before any search: overlap, likeness, scale, volumes of the tissues."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from bayesreg.model.observations.images.contrast import explained_shares, map_residual
from bayesreg.model.observations.images.linear_combination import regression_at
from bayesreg.model.observations.images.pointwise import Intensities
from bayesreg.tissues import is_fluid, label_of

# The largest number of voxels that are compared, and the number of bins of each image in the joint histogram.
VOXELS, BINS = 200_000, 32
# Aligned images of one contrast have a greater correlation: 0.53 if tissue moved by 4 mm in the mean, at most 10 mm.
ALIKE = 0.5
# Two images have different scales if the ranges of their intensities differ by a greater factor.
SCALES = 2.0
# They also have different scales if their medians differ by a greater share of the range.
OFFSET = 0.5
# Images have one contrast if a straight line explains this share of the variance that any map of intensities explains.
STRAIGHT = 0.8
# A map that explains a smaller share of the variance does not show whether the contrasts are the same.
UNLIKE = 0.02
# Patches have maps of their own if one map explains a smaller share of the variance within them than the first, and
# their own explain more than so many times as much.
LITTLE, MUCH = 0.2, 1.5
# The longest side of a patch within which the contrast may be one of its own, mm.
PATCH = 10.0
# Images are smoothed by this sd, mm, before their patches are compared: a displacement of some mm makes fine structures
# of one contrast look unrelated within a patch, and leaves coarser ones alike.
COARSE = 4.0
# Greater shares are reported: the share of Ω beyond the grid of the moving image, and of a solid tissue outside Ω.
BEYOND, LEFT_OUT = 0.01, 0.05
# So are greater differences of the volumes of a solid tissue in the mesh and in the labels, as a share of the latter.
MESHED = 0.1
# Labels that fill a smaller share of the mask seem to show only a part of the organ.
FILLED = 0.4


class Appraisal(NamedTuple):
    """Measurements of a pair of images and its labels before any search.

    Attributes
    ----------
    millilitres : mapping
        The volumes inside and outside Ω of each tissue, ml.
    likeness : Likeness or None
        None if there is no pair of images from files.
    warnings : tuple of str
        Warnings for the user, one sentence each.
    notes : tuple of str
        Findings and choices, one sentence each.
    """

    millilitres: Mapping[str, tuple[float, float]]
    likeness: Likeness | None
    warnings: tuple[str, ...]
    notes: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Convert the appraisal to mappings and lists, for files."""
        likeness = None if self.likeness is None else self.likeness._asdict()
        remarks = {"warnings": list(self.warnings), "notes": list(self.notes)}
        return {"millilitres": dict(self.millilitres), "likeness": likeness, **remarks}


class Likeness(NamedTuple):
    """Measures of the likeness of two images in Ω before the registration.

    Attributes
    ----------
    correlation : float
        Pearson's correlation.
    mutual_information : float
        2 I / (H_fixed + H_moving), from 0 to 1.
    scale_ratio : float
        The range of the moving image divided by the range of the fixed image. A range is the difference of the 0.5 and
        99.5 % quantiles.
    offset : float
        The median of the moving image minus the median of the fixed image, divided by the range of the fixed image.
    on_grid : float
        The share of Ω that lies on the grid of the moving image.
    line_share, map_share : float
        The shares of the variance of the moving image that functions of the fixed image's intensities explain: a
        straight line (a negative share if the line falls), and the best map.
    map_share_within, patch_share_within : float
        The shares of the variance within patches of the moving image that the best map explains, and that the linear
        combination of f and |∇f| of each patch explains; both images are smoothed by `COARSE`.
    """

    correlation: float
    mutual_information: float
    scale_ratio: float
    offset: float
    on_grid: float
    line_share: float = 0.0
    map_share: float = 0.0
    map_share_within: float = 0.0
    patch_share_within: float = 0.0

    @property
    def is_one_contrast(self) -> bool:
        """Whether a rising line explains nearly as much as any map does, or no map explains anything."""
        return self.map_share < UNLIKE or self.line_share >= STRAIGHT * self.map_share

    @property
    def is_related_in_patches(self) -> bool:
        """Whether one map explains little of the variance within patches, and maps of their own explain more."""
        return self.map_share_within < LITTLE and self.patch_share_within > MUCH * self.map_share_within

    @property
    def is_one_scale(self) -> bool:
        """Whether the intensities of both images have nearly the same range."""
        return 1 / SCALES < self.scale_ratio < SCALES and abs(self.offset) <= OFFSET

    def sentences(self, one_contrast: bool, one_scale: bool) -> list[str]:
        """Write the warnings for a user; the list is empty if the images are alike.

        Parameters
        ----------
        one_contrast : bool
            Whether the similarity assumes that both images have one contrast.
        one_scale : bool
            Whether both images share one scale of intensities.
        """
        warnings = []
        if self.on_grid < 1 - BEYOND:
            warnings.append(
                f"{1 - self.on_grid:.0%} of the organ lies beyond the grid of the moving image, where nothing is seen."
            )
        if one_contrast and self.correlation < -ALIKE / 2:
            warnings.append(
                f"Bright and dark change places between the images (correlation {self.correlation:.2f}): they are not "
                "of one contrast; data.same_contrast: null or false compares them through a map of intensities."
            )
        elif one_contrast and not self.correlation >= ALIKE:
            warnings.append(
                f"The images are hardly alike as they lie: correlation {self.correlation:.2f}, normalised mutual "
                f"information {self.mutual_information:.2f}. If they are of one contrast, they are not aligned, or the "
                "axes of one are mistaken; if they are not, data.same_contrast: false compares them through a map of "
                "intensities, and similarity: lncc window by window."
            )
        if one_scale and not self.is_one_scale:
            warnings.append(
                f"The intensities of the moving image range {self.scale_ratio:.2g} times as far as those of the fixed "
                f"one, and lie {self.offset:+.2g} ranges from them; data.same_contrast: false scales each on its own."
            )
        return warnings


def appraise(
    tissue: Image,
    domain: Image,
    names: tuple[str, ...],
    likeness: Likeness | None = None,
    one_contrast: bool = True,
    one_scale: bool = True,
    intracranial: Image | None = None,
) -> Appraisal:
    """Appraise the labels and, if there is a pair of images, their likeness; see `Likeness.sentences`."""
    millilitres = measure_tissues(tissue, domain, names)
    warnings = [] if likeness is None else likeness.sentences(one_contrast, one_scale)
    return Appraisal(
        millilitres, likeness, (*explain_left_out(millilitres), *explain_mask(tissue, intracranial), *warnings)
    )


def explain_mask(tissue: Image, intracranial: Image | None) -> list[str]:
    """Warn if the labels fill a small share of the mask of where the organ may go; both lie on one grid."""
    if intracranial is None:
        return []
    labelled, inside = np.asarray(tissue.voxels) != 0, np.asarray(intracranial.voxels) != 0
    filled, all_of_it = (np.count_nonzero(mask) * tissue.voxel_volume / 1e3 for mask in (labelled & inside, inside))
    if filled >= FILLED * all_of_it:
        return []
    return [
        f"The labels fill {filled:.3g} of the {all_of_it:.4g} ml of the mask: are they of a part of the organ, such as "
        "a tumour, or does the table not fit? A label 0 in the table makes the rest of the mask a tissue."
    ]


def compare_images(fixed: Image, moving: Image, domain: Image) -> Likeness:
    """Compare two images in Ω, at up to `VOXELS` evenly spread voxels of Ω.

    Parameters
    ----------
    fixed, moving : Image
        Images in one world space; each may have its own grid.
    domain : Image
        Not zero in Ω, on any grid.
    """
    inside = np.argwhere(np.asarray(domain.voxels) != 0)
    inside = inside[:: max(1, len(inside) // VOXELS)]
    places = domain.voxel_to_world(inside)
    on_grid = np.asarray(moving.contains(places))
    if on_grid.sum() < 2:
        return Likeness(0.0, 0.0, 1.0, 0.0, float(on_grid.mean()))
    fixed_values = np.asarray(fixed.interpolate(places[on_grid]))
    moving_values = np.asarray(moving.interpolate(places[on_grid]))
    ranges = [np.subtract(*np.quantile(values, (0.995, 0.005))) for values in (fixed_values, moving_values)]
    if min(ranges) <= 0:
        return Likeness(0.0, 0.0, 1.0, 0.0, float(on_grid.mean()))
    correlation = float(np.corrcoef(fixed_values, moving_values)[0, 1])
    offset = (np.median(moving_values) - np.median(fixed_values)) / ranges[0]
    return Likeness(
        correlation,
        _mutual_information(fixed_values, moving_values),
        float(ranges[1] / ranges[0]),
        float(offset),
        float(on_grid.mean()),
        *explained_shares(fixed_values, moving_values),
        *_shares_within_patches(_smoothed_within(domain, fixed), _smoothed_within(domain, moving), places[on_grid]),
    )


def within(domain: Image, image: Image) -> Bool[np.ndarray, "X Y Z"]:
    """Mark the voxels of an image that lie in the domain; the two grids may differ."""
    return np.asarray(domain.interpolate(image.grid_points())) > 0.5


def _smoothed_within(domain: Image, image: Image) -> Image:
    """Smooth an image by `COARSE` from its voxels in the domain alone: what is ignored, such as metal, stays out."""
    inside = within(domain, image).astype(float)
    of_values, of_mask = (image.with_voxels(x).smoothed(COARSE).voxels for x in (inside * image.voxels, inside))
    return image.with_voxels(of_values / np.maximum(of_mask, 1e-6))


def _shares_within_patches(fixed: Image, moving: Image, places: Float[np.ndarray, "points 3"]) -> tuple[float, float]:
    """Return the shares of the variance of m within patches that one map explains, and that f and |∇f| explain there.

    A patch has its own coefficients, whose number is taken into account.
    """
    fixed_values, moving_values = (np.asarray(image.interpolate(places)) for image in (fixed, moving))
    left, variance = map_residual(fixed_values, moving_values), moving_values.var()
    regression = regression_at(places, fixed.interpolator("linear"), PATCH, variance)
    weights = np.ones(len(places))
    of_m, of_left = (regression.fit(Intensities(weights, jnp.asarray(m), weights)) for m in (moving_values, left))
    spare = np.maximum(np.asarray(of_m.count) - 3, 1) / np.asarray(of_m.count)
    whole, after_map = float(of_m.whole @ (1 / of_m.count)), float(of_left.whole @ (1 / of_left.count))
    after_patches = float((of_m.left / of_m.count / spare) @ np.ones(len(places)))
    return max(1 - after_map / whole, 0.0), max(1 - after_patches / whole, 0.0)


def measure_tissues(tissue: Image, domain: Image, names: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Measure the volume of every tissue inside and outside Ω, ml; `tissue` and `domain` share one grid."""
    voxels, inside = np.asarray(tissue.voxels), np.asarray(domain.voxels) != 0
    millilitre = tissue.voxel_volume / 1e3
    counted = ((voxels == index) for index in range(1, len(names) + 1))
    return {
        name: (float((of_tissue & inside).sum() * millilitre), float((of_tissue & ~inside).sum() * millilitre))
        for name, of_tissue in zip(names, counted, strict=True)
    }


def explain_left_out(millilitres: Mapping[str, tuple[float, float]]) -> list[str]:
    """Warn of every solid tissue of which Ω leaves out a greater share than `LEFT_OUT`."""
    return [
        f"{outside:.3g} of {inside + outside:.3g} ml of {label_of(name)} lie outside the region to mesh, which leaves "
        "them out."
        for name, (inside, outside) in millilitres.items()
        if not is_fluid(name) and outside > LEFT_OUT * (inside + outside)
    ]


def explain_mesh(mesh: TetMesh, tissue: Image) -> list[str]:
    """Warn of every solid tissue whose volume in the mesh differs by more than `MESHED` from that of its labels.

    A mesh gives to solid tissues the fluid in their folds, which is allowed for.
    """
    meshed = np.bincount(mesh.tissue, mesh.volumes, len(mesh.names)) / 1e3
    voxels = np.bincount(np.asarray(tissue.voxels).ravel(), minlength=len(mesh.names) + 1)[1:]
    labelled, fluid = voxels * tissue.voxel_volume / 1e3, np.array([is_fluid(name) for name in mesh.names])
    in_folds = max(float((labelled - meshed)[fluid].sum()), 0.0)
    return [
        f"The mesh holds {in_mesh:.4g} ml of {label_of(name)}, and the labels {in_labels:.4g} ml: it fills holes and "
        "narrow gaps, and does not show what is thinner than a third of its edges (mesh.edge_length)."
        for name, in_mesh, in_labels in zip(mesh.names, meshed, labelled, strict=True)
        if not is_fluid(name) and abs(in_mesh - in_labels) > MESHED * in_labels + in_folds
    ]


def _mutual_information(fixed_values: Float[np.ndarray, "points"], moving_values: Float[np.ndarray, "points"]) -> float:
    bounds = [np.quantile(values, (0.005, 0.995)) for values in (fixed_values, moving_values)]
    joint, _, _ = np.histogram2d(np.clip(fixed_values, *bounds[0]), np.clip(moving_values, *bounds[1]), bins=BINS)
    entropies = [_entropy(joint.sum(axis=1)), _entropy(joint.sum(axis=0)), _entropy(joint.ravel())]
    return float(2 * (entropies[0] + entropies[1] - entropies[2]) / (entropies[0] + entropies[1]))


def _entropy(counts: Float[np.ndarray, "bins"]) -> float:
    shares = counts[counts > 0] / counts.sum()
    return float(-(shares * np.log(shares)).sum())
