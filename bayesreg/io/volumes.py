"""Readers and writers of images, masks and tissue labels; world RAS, mm."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import nibabel as nib
import numpy as np
from nibabel.openers import Opener

from bayesreg.image import Image
from bayesreg.io.atomic import replacing
from bayesreg.io.grids import Volume
from bayesreg.io.readers import read_volume
from bayesreg.tissues import BACKGROUND, tissue_names
from bayesreg.types import AnyArray, InputError

LabelTable = Mapping[str, int | Sequence[int]]

# The largest distance from an integer of a label that is stored as a floating-point number.
ROUNDING = 0.05
# The largest overshoot of probabilities that were interpolated by splines.
OVERSHOOT = 0.5

# Level of gzip, from 1 to 9. At 4, fields are a fifth smaller than at 1 and take as long to write; from 6 on they take
# three times as long.
COMPRESSION = 4

_log = logging.getLogger(__name__)


def load_image(path: str | Path) -> Image:
    """Read a 3D image: NIfTI, MGZ, NRRD, MetaImage, a folder with one DICOM series, or another format of nibabel.

    Parameters
    ----------
    path : path

    Returns
    -------
    Image
        The image, with orientation and number type as in the file. Trailing axes of length one are removed.

    Raises
    ------
    InputError
        If the file does not exist, is not an image, is damaged, has more or fewer than three axes, holds values that
        are not real and finite, or has a singular affine.
    """
    return _as_image(read_volume(path), path)


def load_mask(path: str | Path) -> Image:
    """Read a mask.

    If the file has two values, the greater is inside. If it has probabilities, those of at least 0.5 are inside, and
    the log reports it.

    Returns
    -------
    Image
        The mask, uint8, 1 inside.

    Raises
    ------
    InputError
        As in `load_image`; also if the file holds a single value, or neither two values nor probabilities.
    """
    image = load_image(path)
    voxels = np.asarray(image.voxels)
    low, high = voxels.min(), voxels.max()
    if low == high:
        raise InputError(f"mask {path} has the value {low:g} everywhere; expected two values")
    if ((voxels == low) | (voxels == high)).all():
        if high <= 0:
            raise InputError(f"mask {path} has the values {low:g} and {high:g}; expected the greater above zero")
        return image.with_voxels((voxels == high).astype(np.uint8))
    if low < -OVERSHOOT or not 0.5 < high <= 1 + OVERSHOOT:
        raise InputError(
            f"mask {path} has more than two values, from {low:g} to {high:g}; expected two values, or probabilities"
        )
    _log.warning("mask %s has values from %.3g to %.3g; what is at least 0.5 is inside", path, low, high)
    return image.with_voxels((voxels >= 0.5).astype(np.uint8))


def load_ignored(path: str | Path) -> Image:
    """Read a mask of ignored voxels: uint8, 1 where the file is not zero, or where a probability is at least 0.5.

    If the mask is zero everywhere, nothing is ignored, and the log reports it.

    Raises
    ------
    InputError
        As in `load_image`; also if the file holds neither whole numbers nor probabilities.
    """
    image = load_image(path)
    voxels = np.asarray(image.voxels)
    if np.abs(np.rint(voxels) - voxels).max() <= ROUNDING:
        ignored = np.rint(voxels) != 0
    elif voxels.min() >= -OVERSHOOT and voxels.max() <= 1 + OVERSHOOT:
        ignored = voxels >= 0.5
        _log.warning("mask %s has values between 0 and 1; what is at least 0.5 is ignored", path)
    else:
        raise InputError(
            f"mask {path} has values from {voxels.min():g} to {voxels.max():g}; expected whole numbers, of which zero "
            "is looked at, or probabilities"
        )
    if not ignored.any():
        _log.warning("mask %s ignores nothing", path)
    return image.with_voxels(ignored.astype(np.uint8))


def save_image(image: Image, path: str | Path) -> None:
    """Write an image as NIfTI in one step.

    Parameters
    ----------
    image : Image
        Floating-point voxels are stored as float32, booleans as uint8, integers as they are.
    path : path
        Ends in .nii or .nii.gz.

    Raises
    ------
    InputError
        If the path has another suffix, or its folder does not exist.
    """
    write_nifti(_storable(np.asarray(image.voxels)), image.affine, Path(path))


def load_labels(path: str | Path, table: LabelTable, unlisted: Literal["outside", "refused"] = "outside") -> Image:
    """Read a label file as tissue indices, by `load_whole_numbers` and `tissues_of`, and raise their errors."""
    return tissues_of(load_whole_numbers(path), table, path, unlisted)


def tissues_of(
    image: Image, table: LabelTable, path: str | Path, unlisted: Literal["outside", "refused"] = "outside"
) -> Image:
    """Convert labels to tissue indices.

    Parameters
    ----------
    image : Image
        Labels, which are whole numbers.
    table : mapping
        Label value or values of each tissue by its name; the order gives the indices. Values of `BACKGROUND` belong to
        no tissue.
    path : path
        The path of the labels, for a message.
    unlisted : {"outside", "refused"}
        Whether labels that are neither zero nor in the table belong to no tissue, or raise InputError.

    Returns
    -------
    Image
        int8: 0 outside, 1 + the index of the tissue in the table inside.

    Raises
    ------
    InputError
        If no tissue has a label (with "outside", if any tissue has none), a label is refused because it is not listed,
        or a value belongs to two tissues.
    """
    values = {name: np.atleast_1d(np.asarray(entry, int)).tolist() for name, entry in table.items()}
    present, counts = np.unique(image.voxels, return_counts=True)
    _check_table(values, present.tolist(), path, require_all=unlisted == "outside")
    listed = {0, *(value for entry in values.values() for value in entry)}
    millilitres = {
        int(value): count * image.voxel_volume / 1e3
        for value, count in zip(present, counts, strict=True)
        if value not in listed
    }
    if millilitres and unlisted == "refused":
        shown = shorten(f"{value} ({volume:.3g} ml)" for value, volume in millilitres.items())
        raise InputError(
            f"label file {path} holds labels that the table does not list: {shown}. Add each to a tissue of the table, "
            f"give it one of its own, or list it under {BACKGROUND} if it does not belong to the organ"
        )
    tissue = np.zeros(image.shape, np.int8)
    for index, name in enumerate(tissue_names(table), start=1):
        tissue[np.isin(image.voxels, values[name])] = index
    return image.with_voxels(tissue)


def load_whole_numbers(path: str | Path) -> Image:
    """Read a label file as int32; values up to `ROUNDING` from an integer are rounded, and the log reports it.

    If the file has several volumes, each must hold the probabilities of one tissue. Then the label is the number of the
    most probable tissue, counted from 1, or 0 where the probabilities sum to less than 0.5.

    Raises
    ------
    InputError
        As in `load_image`; also if the file holds values further from integers or beyond 32 bits, or several volumes
        that are not probabilities.
    """
    volume = read_volume(path)
    if volume.voxels.ndim == 4 and volume.voxels.shape[3] > 1:
        return _most_probable(volume, path)
    image = _as_image(volume, path)
    voxels = np.asarray(image.voxels)
    if voxels.dtype.kind == "f":
        rounded = np.rint(voxels)
        away = float(np.abs(rounded - voxels).max())
        if away > ROUNDING:
            raise InputError(f"label file {path} holds values that are not integers; is it an intensity image?")
        if away:
            _log.warning("label file %s holds values up to %.2g from an integer; they are rounded", path, away)
        voxels = rounded
    if voxels.max() > np.iinfo(np.int32).max or voxels.min() < np.iinfo(np.int32).min:
        raise InputError(f"label file {path} holds values up to {voxels.max()}; expected labels of at most 32 bits")
    return image.with_voxels(voxels.astype(np.int32))


def _as_image(volume: Volume, path: str | Path) -> Image:
    try:
        return Image(_one_real(volume.voxels), volume.affine)
    except ValueError as error:
        raise InputError(f"image {path}: {error}") from error


def _most_probable(volume: Volume, path: str | Path) -> Image:
    shares = np.asarray(volume.voxels, float)
    if not (np.isfinite(shares).all() and shares.min() >= -ROUNDING and shares.sum(axis=3).max() <= 1 + OVERSHOOT):
        raise InputError(
            f"label file {path} has {shares.shape[3]} volumes, which are no probabilities of one tissue each; "
            "expected one volume of labels"
        )
    _log.warning(
        "label file %s holds probabilities of %d tissues; the most probable is taken, counted from 1", path,
        shares.shape[3],
    )  # fmt: skip
    likely = np.where(shares.sum(axis=3) < 0.5, 0, 1 + shares.argmax(axis=3))
    return Image(likely.astype(np.int32), volume.affine)


def shorten(values: Iterable[object], most: int = 30) -> str:
    """Join the first `most` values to a text, with an ellipsis if there are more."""
    listed = [str(value) for value in values]
    return ", ".join(listed[:most]) + (", …" if len(listed) > most else "")


def write_nifti(
    voxels: np.ndarray,
    affine: AnyArray,
    path: Path,
    intent: int | None = None,
    scaling: tuple[float, float] | None = None,
) -> None:
    """Write voxels as NIfTI, mm, in one step; raise InputError as in `save_image`.

    If a scaling (a, b) is given, a stored value v represents a v + b.
    """
    if not path.name.endswith((".nii", ".nii.gz")):
        raise InputError(f"{path} must end in .nii or .nii.gz")
    if not path.parent.is_dir():
        raise InputError(f"{path} cannot be written: there is no folder {path.parent}")
    image = nib.Nifti1Image(voxels, np.asarray(affine, float), dtype=voxels.dtype)
    image.header.set_xyzt_units("mm")
    if intent is not None:
        image.header.set_intent(intent)
    if scaling is not None:
        image.header.set_slope_inter(*scaling)
    compression = {"compresslevel": COMPRESSION} if path.name.endswith(".gz") else {}
    with replacing(path) as temporary, Opener(str(temporary), "wb", **compression) as file:
        image.to_stream(file)  # type: ignore[arg-type]


def _one_real(voxels: np.ndarray) -> np.ndarray:
    """Remove trailing axes of length one and convert to native byte order.

    Raise InputError unless three axes of real numbers result.
    """
    shape = voxels.shape
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if len(shape) != 3:
        raise InputError(f"expected a 3D image, got shape {voxels.shape}; take out one volume beforehand")
    if voxels.dtype.kind not in "iufb":
        raise InputError(f"expected one real number per voxel, got {voxels.dtype}")
    return voxels.reshape(shape).astype(voxels.dtype.newbyteorder("="), copy=False)


def _storable(voxels: np.ndarray) -> np.ndarray:
    if voxels.dtype == bool:
        return voxels.astype(np.uint8)
    if voxels.dtype.kind == "f":
        return voxels.astype(np.float32)
    # Few programs read 64-bit integers, which are NumPy's default.
    if voxels.dtype.itemsize == 8 and voxels.min() >= -(2**31) and voxels.max() < 2**31:
        return voxels.astype(np.int32)
    return voxels


def _check_table(values: dict[str, list[int]], present: list[int], path: str | Path, require_all: bool) -> None:
    owner: dict[int, str] = {}
    for name, entry in values.items():
        if not entry:
            raise InputError(f"the label table has no value for {name}")
        for value in entry:
            if value in owner:
                raise InputError(f"label {value} stands for both {owner[value]} and {name} in the label table")
            owner[value] = name
    absent = [value for value in owner if value not in present]
    empty = [name for name in tissue_names(values) if not set(values[name]) & set(present)]
    shown = ", ".join(map(str, present[:30])) + (", …" if len(present) > 30 else "")
    if empty and (require_all or len(empty) == len(tissue_names(values))):
        listed = ", ".join(f"{name} ({', '.join(map(str, values[name]))})" for name in empty)
        raise InputError(f"label file {path} holds no label of {listed}; it holds {shown}")
    if absent:
        _log.info(
            "label file %s lacks %s of the table, which its tissues do without", path, ", ".join(map(str, absent))
        )
