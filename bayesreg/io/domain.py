"""The region to mesh, Ω, and its tissues, computed from a tissue map and an intracranial mask."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import edt
import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.io.grids import check_same_grid
from bayesreg.tissues import BRAIN, BRAIN_CLOSING, BRAIN_VOLUME, is_fluid, label_of
from bayesreg.types import InputError

# The largest part of a mask is its only one if it has this share of it. What is filled is told beyond the second share.
MAIN, TOLD = 0.9, 0.002
_log = logging.getLogger(__name__)


class MeshError(InputError):
    """The error for labels that cannot be meshed, or for a mesh that does not represent its labels."""


def relative_size(mask: Bool[np.ndarray, "X Y Z"], voxel_volume: float) -> float:
    """Compute the size of a body relative to a human brain: the cube root of the ratio of the volumes.

    A mouse's brain gives 0.07.
    """
    volume = max(int(np.count_nonzero(mask)), 1) * voxel_volume
    return float(np.cbrt(volume / BRAIN_VOLUME))


def size_of_solid(tissue: Image, names: Sequence[str] = BRAIN) -> float:
    """Compute the `relative_size` of the solid tissues."""
    solid = [index for index, name in enumerate(names, start=1) if not is_fluid(name)]
    return relative_size(np.isin(np.asarray(tissue.voxels), solid), tissue.voxel_volume)


def mesh_domain(
    tissue: Image, intracranial: Image | None = None, closing: float = BRAIN_CLOSING, names: Sequence[str] = BRAIN
) -> Image:
    """Compute the region Ω: the hull of the solid tissues, inside the intracranial mask.

    If the tissues include a fluid (`bayesreg.tissues.is_fluid`), the hull is the solid tissues closed by a ball, so
    that it includes ventricles and sulci. Holes of the hull are filled.

    Parameters
    ----------
    tissue : Image
        0 outside, 1 + index into the names inside.
    intracranial : Image, optional
        Nonzero inside the skull, on the grid of the tissue map. Without it nothing bounds the hull.
    closing : float
        Radius of the ball, mm. Exact for affines whose axes are orthogonal.
    names : sequence of str
        Names of the tissues.

    Returns
    -------
    Image
        uint8, 1 inside.

    Raises
    ------
    MeshError
        If a solid tissue has no voxel, the intracranial mask is empty or excludes more than half of the solid tissues,
        or a mask has several large parts. If its largest part has 90 % of a mask, the others are left out. The log
        tells them in ml, and holes that are filled with a solid tissue.
    """
    voxels = np.asarray(tissue.voxels)
    solid_names = {index: name for index, name in enumerate(names, start=1) if not is_fluid(name)}
    for index, name in solid_names.items():
        if not (voxels == index).any():
            raise MeshError(f"the tissue map holds no {name} (value {index}); it holds {np.unique(voxels).tolist()}")
    solid = np.isin(voxels, list(solid_names))
    if not solid.any():
        raise MeshError(f"there is no solid tissue to mesh among {', '.join(names)}")
    has_fluid = len(solid_names) < len(names)
    hull = fill_holes(_close(solid, tissue.voxel_sizes, closing) if has_fluid else solid)
    if intracranial is not None:
        hull &= _intracranial_part(tissue, intracranial)
        if (hull & solid).sum() < 0.5 * solid.sum():
            raise MeshError(
                f"more than half of {' and '.join(map(label_of, solid_names.values()))} lies outside the intracranial "
                "mask; do the two belong together?"
            )
    # The intracranial mask may cut the hull and so leave separate parts and holes.
    region = fill_holes(main_part(tissue.with_voxels(hull), "region to mesh"))
    if not has_fluid and np.count_nonzero(holes := region & ~solid) > TOLD * np.count_nonzero(region):
        _log.warning("%s of holes in the region to mesh filled, %s", millilitres(tissue, holes), place(tissue, holes))
    return tissue.with_voxels(region.astype(np.uint8))


def domain_labels(tissue: Image, domain: Image, names: Sequence[str] = BRAIN) -> Image:
    """Label the tissue of every voxel of Ω, int8: 0 outside, 1 + index into the names inside.

    A voxel of Ω without a label becomes the first fluid or, if there is no fluid, the nearest tissue.

    Raises
    ------
    MeshError
        If a tissue has no voxel in Ω.
    """
    labels = np.where(np.asarray(domain.voxels) != 0, labels_everywhere(tissue, names).voxels, 0).astype(np.int8)
    for index, name in enumerate(names, start=1):
        if not (labels == index).any():
            outside = np.asarray(tissue.voxels) == index
            where = f" (its voxels lie {place(tissue, outside)})" if outside.any() else ""
            raise MeshError(f"the region to mesh holds no {name}{where}; choose a table of labels without it")
    return tissue.with_voxels(labels)


def labels_everywhere(tissue: Image, names: Sequence[str]) -> Image:
    """Replace the zeros of a tissue map by the first fluid or, if there is no fluid, by the nearest tissue."""
    voxels = np.asarray(tissue.voxels)
    fluid = next((index for index, name in enumerate(names, start=1) if is_fluid(name)), None)
    if fluid is not None:
        return tissue.with_voxels(np.where(voxels == 0, fluid, voxels))
    sizes = tuple(tissue.voxel_sizes)
    nearest = ndimage.distance_transform_edt(voxels == 0, sizes, return_distances=False, return_indices=True)
    return tissue.with_voxels(voxels[tuple(nearest)])


def main_part(mask: Image, name: str) -> Bool[np.ndarray, "X Y Z"]:
    """Return the largest connected part of a mask, nonzero inside; the log tells the others in ml.

    Raise MeshError if the mask is empty, or its largest part has less than 90 % of it.
    """
    inside = np.asarray(mask.voxels) != 0
    components, count = ndimage.label(inside)
    if count == 0:
        raise MeshError(f"the {name} is empty")
    if count == 1:
        return inside
    sizes = np.bincount(components.ravel())[1:]
    main = components == sizes.argmax() + 1
    others = inside & ~main
    if sizes.max() < MAIN * sizes.sum():
        shares = ", ".join(f"{share:.0%}" for share in np.sort(sizes)[::-1] / sizes.sum() if share >= 0.01)
        raise MeshError(
            f"the {name} has {count} separate parts ({shares} of its volume), the second {place(mask, others)}, and a "
            "mesh has one; give labels of one part, or join the parts"
        )
    _log.warning(
        "%d separate parts of the %s left out, %s together, %s",
        count - 1, name, millilitres(mask, others), place(mask, others),
    )  # fmt: skip
    return main


def largest_part(mask: Bool[np.ndarray, "X Y Z"]) -> Bool[np.ndarray, "X Y Z"]:
    """Return the largest connected part of a mask that is not empty."""
    components, _ = ndimage.label(mask)
    return components == np.bincount(components.ravel())[1:].argmax() + 1


def millilitres(image: Image, part: Bool[np.ndarray, "X Y Z"]) -> str:
    """Write the volume of a part of an image."""
    return f"{np.count_nonzero(part) * image.voxel_volume / 1e3:.3g} ml"


def place(image: Image, part: Bool[np.ndarray, "X Y Z"]) -> str:
    """Write where the centre of the largest piece of a part of an image lies, in world RAS, mm."""
    centre = image.voxel_to_world(np.argwhere(largest_part(part)).mean(axis=0))
    return f"about ({', '.join(f'{x:.0f}' for x in centre)}) mm"


def without_ridges(intracranial: Image) -> Image:
    """Smooth the intracranial mask by the majority around each voxel, and keep its largest part.

    A mask that was drawn or classified voxel by voxel has ridges and pits of one voxel that no skull has. The majority
    is weighted by a Gaussian of one voxel. Parts of the mask thinner than two voxels vanish, too.
    """
    inside = ndimage.gaussian_filter((np.asarray(intracranial.voxels) != 0).astype(float), 1.0) > 0.5
    return intracranial.with_voxels(main_part(intracranial.with_voxels(inside), "intracranial mask").astype(np.uint8))


def _intracranial_part(tissue: Image, intracranial: Image) -> Bool[np.ndarray, "X Y Z"]:
    check_same_grid(tissue, intracranial, ("tissue", "intracranial"))
    return main_part(intracranial, "intracranial mask")


def _close(mask: Bool[np.ndarray, "X Y Z"], voxel_sizes: np.ndarray, radius: float) -> Bool[np.ndarray, "X Y Z"]:
    """Dilate, then erode a mask by a ball (radius in mm); voxels beyond the grid count as empty."""
    box = ndimage.find_objects(mask.astype(np.int8))[0]
    margin = [(n, n) for n in np.ceil(radius / voxel_sizes).astype(int) + 1]
    near = np.pad(mask[box], margin)
    grown = edt.edt(~near, anisotropy=tuple(voxel_sizes)) <= radius
    closed = edt.edt(grown, anisotropy=tuple(voxel_sizes)) > radius
    result = np.zeros_like(mask)
    result[box] = closed[tuple(slice(a, -b) for a, b in margin)]
    return result


def fill_holes(mask: Bool[np.ndarray, "X Y Z"]) -> Bool[np.ndarray, "X Y Z"]:
    """Fill the holes of a mask, which are the empty voxels that have no connection to the outside of the grid."""
    components, _ = ndimage.label(~np.pad(mask, 1))
    return (components != components[0, 0, 0])[1:-1, 1:-1, 1:-1]
