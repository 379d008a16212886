"""Anatomies to register: MNI152 from nilearn's package, BrainWeb with Colin27, and anatomies from a user's files."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import edt
import nibabel as nib
import numpy as np
import SimpleITK

from bayesreg.image import Image
from bayesreg.io.domain import main_part
from bayesreg.io.grids import check_same_grid, check_same_space, is_same_grid, on_grid_of
from bayesreg.io.readers import read_grid
from bayesreg.io.volumes import LabelTable, load_image, load_labels, load_mask, load_whole_numbers, tissues_of
from bayesreg.label_tables import REST, TABLES
from bayesreg.tissues import BRAIN, ORGAN, is_fluid, tissue_names
from bayesreg.types import DATA_FOLDER, InputError

__all__ = ["Anatomy", "brainweb", "check_same_grid", "check_same_space", "from_files", "mni152", "without_labels"]

_log = logging.getLogger(__name__)

BRAINWEB_INTRACRANIAL = (1, 2, 3, 8)
# Radius, mm, of the ball that closes gaps in an organ that was segmented by its brightness.
CLOSING = 3.0
# Distance of the skull from the brain mask of the skull-stripped MNI152, mm.
MNI152_SKULL = 3.0
# The grid of MNI152 ends this number of voxels beyond the skull.
MNI152_MARGIN = 8


class Anatomy(NamedTuple):
    """One organ: an image, its tissues, and the region in which the organ must stay.

    Attributes
    ----------
    image : Image or None
        None if the anatomy has no image.
    tissue : Image
        int8 on the grid of the image: 0 outside, 1 + index into the names inside.
    intracranial : Image or None
        uint8 on the grid of the image, 1 inside the skull; None if the skull is not known.
    names : tuple of str
        Names of the tissues.
    """

    image: Image | None
    tissue: Image
    intracranial: Image | None
    names: tuple[str, ...] = BRAIN


def mni152() -> Anatomy:
    """Load the MNI152 (ICBM 2009a, symmetric, 1 mm) that ships with nilearn; needs no network.

    The T1, in [0, 1], is stripped of its skull. The tissue is the likeliest of GM, WM and the rest (CSF) inside
    the brain mask; the intracranial mask is the brain mask dilated by 3 mm.
    Fonov et al., "Unbiased average age-appropriate atlases for pediatric studies", 2011.
    """
    # nilearn takes seconds to import, and only this anatomy needs it.
    from nilearn import datasets

    t1, gm, wm = (
        _from_nibabel(load(resolution=1))
        for load in (datasets.load_mni152_template, datasets.load_mni152_gm_template, datasets.load_mni152_wm_template)
    )
    brain = _from_nibabel(datasets.load_mni152_brain_mask(resolution=1)).voxels != 0
    likelihood = np.stack([1 - gm.voxels - wm.voxels, gm.voxels, wm.voxels])
    tissue = np.where(brain, likelihood.argmax(axis=0) + 1, 0)
    inside = edt.edt(~brain, anisotropy=tuple(t1.voxel_sizes)) <= MNI152_SKULL
    # Beyond the margin the image is zero.
    box = _box_about(inside, MNI152_MARGIN)
    return Anatomy(
        t1.cropped(box),
        t1.with_voxels(tissue.astype(np.int8)).cropped(box),
        t1.with_voxels(inside.astype(np.uint8)).cropped(box),
    )


def _box_about(mask: np.ndarray, margin: int) -> list[slice]:
    """Compute the box of voxels that holds a mask and a margin around it, as slices."""
    box = []
    for axis in range(3):
        filled = np.flatnonzero(mask.any(axis=tuple({0, 1, 2} - {axis})))
        box.append(slice(max(filled[0] - margin, 0), min(filled[-1] + margin + 1, mask.shape[axis])))
    return box


def brainweb(
    labels_path: str | Path | None = None,
    t1_path: str | Path | None = None,
    intracranial_labels: Sequence[int] = BRAINWEB_INTRACRANIAL,
) -> Anatomy:
    """Load BrainWeb's label phantom with Colin27, the scan from which it was made.

    Parameters
    ----------
    labels_path : path, optional
        Discrete BrainWeb labels: 1 CSF, 2 GM, 3 WM, 8 glial (counted as GM). The default is
        brainweb_crisp_1mm.nii.gz in the folder that the environment variable BAYESREG_DATA names.
    t1_path : path, optional
        T1 on the same grid; the default is colin27_t1_1mm_unedited.nii.gz in the same folder.
    intracranial_labels : sequence of int
        Labels inside the skull; the largest connected part of their union is the intracranial mask.

    Raises
    ------
    InputError
        If a file is missing, unreadable or lacks a label, if the grids differ, or if the mask has several large parts.

    References
    ----------
    Collins et al., IEEE Trans. Med. Imaging 17(3), 1998; Cocosco et al., NeuroImage 5(4), 1997; Kwan et al.,
    IEEE Trans. Med. Imaging 18(11), 1999; Holmes et al., J. Comput. Assist. Tomogr. 22(2), 1998.
    """
    labels_path = _data_file(labels_path, "brainweb_crisp_1mm.nii.gz")
    t1 = load_image(_data_file(t1_path, "colin27_t1_1mm_unedited.nii.gz"))
    labels = load_whole_numbers(labels_path)
    tissue = tissues_of(labels, TABLES["brainweb"], labels_path)
    check_same_grid(t1, tissue, ("T1", "label"))
    inside = tissues_of(labels, {"intracranial": tuple(intracranial_labels)}, labels_path)
    mask = main_part(inside, "intracranial mask")
    return Anatomy(t1, tissue.with_voxels(tissue.voxels * mask), tissue.with_voxels(mask.astype(np.uint8)))


def from_files(
    image_path: str | Path | None,
    labels_path: str | Path,
    label_table: LabelTable,
    intracranial_path: str | Path | None = None,
) -> Anatomy:
    """Load an anatomy from a user's files.

    Parameters
    ----------
    image_path : path, optional
        The fixed image.
    labels_path : path
        Tissue labels. If their grid differs from that of the image, the nearest voxel is used.
    label_table : mapping
        Label values of every tissue by its name, in the order of the mesh's tissues. Zero, if it is listed, stands for
        the rest of the intracranial mask.
    intracranial_path : path, optional
        Mask of the region in which the organ must stay (`load_mask`), on any grid likewise.

    Raises
    ------
    InputError
        If a file is missing or unreadable, the file holds no tissue of the table, a tissue lies outside the image's
        grid, a label is not listed, zero is listed without a mask, the grids hardly overlap, or the grids agree only by
        the form of a header (q-form) that is not used.
    """
    tissue, names = _tissues_there(load_labels(labels_path, label_table, unlisted="refused"), label_table, labels_path)
    image = None
    rest = next((name for name in names if REST in np.atleast_1d(label_table[name])), None)
    if rest is not None:
        # Until the mask is read, the rest equals the voxels beyond the labels' grid (0), and the background is −1.
        index = names.index(rest) + 1
        tissue = tissue.with_voxels(np.select([tissue.voxels == index, tissue.voxels == 0], [0, -1], tissue.voxels))
    if image_path is not None:
        image = _load_fixed(image_path)
        tissue = _on_grid(image, image_path, tissue, labels_path, ("fixed", "label"), anywhere=rest is not None)
    mask = None
    if intracranial_path is not None:
        intracranial, grid_path = load_mask(intracranial_path), labels_path if image_path is None else image_path
        mask = _on_grid(tissue, grid_path, intracranial, intracranial_path, ("label", "intracranial"))
    if rest is not None and mask is None:
        raise InputError(
            f"{rest} is what has no label in {labels_path}, and nothing says where it ends; give a mask of the organ "
            "as intracranial"
        )
    if rest is not None and mask is not None:
        voxels = np.where((np.asarray(tissue.voxels) == 0) & (np.asarray(mask.voxels) != 0), index, tissue.voxels)
        tissue = tissue.with_voxels(np.maximum(voxels, 0).astype(np.int8))
    present = np.unique(tissue.voxels)
    if lost := [name for number, name in enumerate(names, start=1) if number not in present]:
        if lost == [rest]:
            raise InputError(f"no voxel is {rest}: all that {intracranial_path} holds has a label in {labels_path}")
        raise InputError(f"no voxel of {' and '.join(lost)} in {labels_path} lies on the grid of {image_path}")
    return Anatomy(image, tissue, mask, names)


def _tissues_there(tissue: Image, table: LabelTable, path: str | Path) -> tuple[Image, tuple[str, ...]]:
    """Remove the tissues of a table that have no voxel; a table that serves many people can list such tissues.

    The tissue that stands for the rest of the mask stays, since it may lie beyond cropped labels.
    """
    names, present = tissue_names(table), set(np.unique(tissue.voxels).tolist())
    remaining = [k for k, name in enumerate(names, start=1) if k in present or REST in np.atleast_1d(table[name])]
    if len(remaining) == len(names):
        return tissue, names
    absent = [name for index, name in enumerate(names, start=1) if index not in remaining]
    if all(is_fluid(names[index - 1]) for index in remaining):
        raise InputError(f"label file {path} holds no label of {' and '.join(absent)}, and so nothing solid")
    _log.warning("label file %s holds no label of %s, and the organ goes without", path, " and ".join(absent))
    number = np.zeros(len(names) + 1, np.int8)
    number[remaining] = np.arange(1, len(remaining) + 1)
    return tissue.with_voxels(number[np.asarray(tissue.voxels)]), tuple(names[index - 1] for index in remaining)


def without_labels(image_path: str | Path, mask_path: str | Path | None = None) -> Anatomy:
    """Load an anatomy of one tissue: the inside of a mask, which also bounds its motion, or an image's bright part.

    Parameters
    ----------
    image_path : path
        The fixed image.
    mask_path : path, optional
        Without a mask the organ is the largest part above Otsu's threshold (1979, "A threshold selection method from
        gray-level histograms"), closed by 3 mm and filled. The log reports its volume.

    Raises
    ------
    InputError
        If a file is missing or unreadable, the grids hardly overlap, or no voxel is above the threshold.
    """
    image = _load_fixed(image_path)
    if mask_path is not None:
        mask = _on_grid(image, image_path, load_mask(mask_path), mask_path, ("fixed", "intracranial"))
        return Anatomy(image, mask.with_voxels(np.asarray(mask.voxels, np.int8)), mask, (ORGAN,))
    inside = _outstanding(image)
    _log.warning(
        "there is neither a label file nor a mask: the organ is what is brighter than Otsu's threshold in %s, %.4g ml",
        image_path, inside.sum() * image.voxel_volume / 1e3,
    )  # fmt: skip
    return Anatomy(image, image.with_voxels(inside.astype(np.int8)), None, (ORGAN,))


def _load_fixed(path: str | Path) -> Image:
    """Load the fixed image, whose grid the results have; resample it on orthogonal axes if its grid is sheared."""
    image = load_image(path)
    if image.is_orthogonal:
        return image
    _log.warning("the axes of %s are not at right angles; it is interpolated on a grid whose axes are", path)
    return image.on_orthogonal_grid(order=3)


def _outstanding(image: Image) -> np.ndarray:
    """Find the largest bright part of an image; close its gaps and fill its holes."""
    voxels = SimpleITK.GetImageFromArray(np.asarray(image.voxels, np.float32).transpose(2, 1, 0))
    radius = [max(round(CLOSING / size), 1) for size in image.voxel_sizes]
    bright = SimpleITK.OtsuThreshold(SimpleITK.Median(voxels, [1] * 3), 0, 1)
    components = SimpleITK.RelabelComponent(SimpleITK.ConnectedComponent(bright))
    closed = SimpleITK.BinaryMorphologicalClosing(components == 1, radius, SimpleITK.sitkBall, 1.0, True)
    mask = SimpleITK.GetArrayFromImage(SimpleITK.BinaryFillhole(closed)).transpose(2, 1, 0) != 0
    if not mask.any():
        raise InputError("nothing stands out in the fixed image; give labels of it, or a mask of the organ as labels")
    return mask


def _on_grid(
    grid: Image, grid_path: str | Path, image: Image, path: str | Path, names: tuple[str, str], anywhere: bool = False
) -> Image:
    """Resample an image by `on_grid_of`, after a check by `require_forms_taken`."""
    require_forms_taken(grid, grid_path, image, path, names)
    return on_grid_of(grid, image, names, anywhere)


def require_forms_taken(
    grid: Image, grid_path: str | Path, image: Image, path: str | Path, names: tuple[str, str]
) -> None:
    """Raise InputError if two images share a grid only by the form of a header (q-form) that is not used."""
    for candidate, source, taken in ((grid, grid_path, image), (image, path, grid)):
        qform = read_grid(source).qform
        if qform is not None and is_same_grid(Image(candidate.voxels, qform), taken):
            raise InputError(
                f"the {names[0]} and the {names[1]} image share one grid by the q-form of {source}, but not by its "
                "s-form, which is taken; write the right one of the two forms into both"
            )


def _from_nibabel(source: nib.Nifti1Image) -> Image:
    return Image(np.asarray(source.dataobj), source.affine)


def _data_file(path: str | Path | None, name: str) -> Path:
    if path is not None:
        return Path(path)
    folder = os.environ.get(DATA_FOLDER)
    if not folder:
        raise InputError(f"give the path of {name}, or let the environment variable {DATA_FOLDER} name its folder")
    return Path(folder) / name
