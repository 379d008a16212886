"""Volumes in files: images, tissue labels and displacement fields, world RAS mm throughout."""

from __future__ import annotations

import logging
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import nibabel as nib
import numpy as np
from jaxtyping import Float
from nibabel.filebasedimages import ImageFileError
from nibabel.spatialimages import HeaderDataError, SpatialImage

from bayesreg.image import Image
from bayesreg.io.atomic import replacing
from bayesreg.types import AnyArray, InputError

LabelTable = Mapping[str, int | Sequence[int]]

VECTOR_INTENT = 1007

_log = logging.getLogger(__name__)


def load_image(path: str | Path) -> Image:
    """Read a 3D image (NIfTI, or whatever else nibabel reads).

    Parameters
    ----------
    path : path

    Returns
    -------
    Image
        Orientation and number type as in the file; trailing axes of length one are dropped.

    Raises
    ------
    InputError
        If there is no such file, it is not an image or damaged, has more or fewer than three axes, holds
        values that are not real and finite, or its affine is singular.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"image {path}: there is no such file")
    source = _open(path)
    try:
        return Image(_voxels(source, path), source.affine)
    except ValueError as error:
        raise InputError(f"image {path}: {error}") from error


def save_image(image: Image, path: str | Path) -> None:
    """Write an image as NIfTI, all of it or nothing.

    Parameters
    ----------
    image : Image
        Floating-point voxels are stored as float32, booleans as uint8, integers as they are.
    path : path
        Ends in .nii or .nii.gz.

    Raises
    ------
    InputError
        If the path ends otherwise, or its folder does not exist.
    """
    _write(_storable(np.asarray(image.voxels)), image.affine, Path(path))


def load_labels(path: str | Path, table: LabelTable) -> Image:
    """Read a label file as tissue indices.

    Parameters
    ----------
    path : path
    table : mapping
        Tissue name to the value, or values, that stand for it in the file; the order gives the indices.

    Returns
    -------
    Image
        int8: 0 outside, 1 + the position of the tissue in the table inside.

    Raises
    ------
    InputError
        As in `load_image`; also if the file holds values that are not integers, or a value of the table is
        absent from it or belongs to two tissues.
    """
    image = load_image(path)
    if not np.array_equal(image.voxels, np.rint(image.voxels)):
        raise InputError(f"label file {path} holds values that are not integers; is it an intensity image?")
    values = {name: np.atleast_1d(np.asarray(entry, int)).tolist() for name, entry in table.items()}
    _check_table(values, np.unique(image.voxels).astype(int).tolist(), path)
    tissue = np.zeros(image.shape, np.int8)
    for index, entry in enumerate(values.values(), start=1):
        tissue[np.isin(image.voxels, entry)] = index
    return image.with_voxels(tissue)


def save_displacement(path: str | Path, field: Float[AnyArray, "X Y Z 3"], affine: Float[AnyArray, "4 4"]) -> None:
    """Write a displacement field that ITK, ANTs and nitransforms read as a resampling transform.

    Parameters
    ----------
    path : path
        Ends in .nii or .nii.gz.
    field : (X, Y, Z, 3) array
        Displacement at every voxel centre, mm, world RAS. The file holds it as (X, Y, Z, 1, 3) with intent
        1007 (vector), its values in LPS.
    affine : (4, 4) array
        Voxel index to world RAS, mm.
    """
    lps = np.asarray(field, np.float32) * np.array([-1, -1, 1], np.float32)
    _write(lps[:, :, :, None], affine, Path(path), intent=VECTOR_INTENT)


def load_displacement(path: str | Path) -> tuple[Image, Image, Image]:
    """Read a displacement field as `save_displacement` and ITK write it; the inverse of `save_displacement`.

    Returns
    -------
    three Images
        Components along x, y and z, mm, world RAS.

    Raises
    ------
    InputError
        If there is no such file, it is no image or damaged, or has another shape than (X, Y, Z, 1, 3).
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"displacement field {path}: there is no such file")
    source = _open(path)
    if source.shape[3:] != (1, 3):
        raise InputError(
            f"{path} is no displacement field: expected the shape (X, Y, Z, 1, 3), vectors in mm, got {source.shape}"
        )
    try:
        x, y, z = np.moveaxis(np.asarray(source.dataobj, float)[:, :, :, 0], -1, 0)
        return Image(-x, source.affine), Image(-y, source.affine), Image(z, source.affine)
    except (OSError, EOFError, zlib.error, ValueError) as error:
        raise InputError(f"displacement field {path}: {error}") from error


def check_same_grid(a: Image, b: Image, names: tuple[str, str] = ("first", "second")) -> None:
    """Raise InputError unless two images share their grid (corners within a hundredth of a voxel)."""
    if a.shape != b.shape:
        raise InputError(
            f"the {names[0]} and the {names[1]} image must share one grid, but have shapes {a.shape} and {b.shape}; "
            "resample one onto the other"
        )
    corners = np.stack(np.meshgrid(*((0.0, n - 1.0) for n in a.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    apart = np.linalg.norm(a.voxel_to_world(corners) - b.voxel_to_world(corners), axis=1).max()
    if apart > 0.01 * a.voxel_sizes.min():
        raise InputError(
            f"the {names[0]} and the {names[1]} image must share one grid, but their affines place corners up to "
            f"{apart:.3g} mm apart; resample one onto the other"
        )


def check_same_space(a: Image, b: Image, names: tuple[str, str] = ("first", "second"), least: float = 0.1) -> None:
    """Raise InputError unless two images overlap in world space.

    Parameters
    ----------
    a, b : Image
        On grids of their own.
    names : pair of str
        What to call them in the message.
    least : float
        Least fraction of the first image's extent that the second must cover.
    """
    samples = np.stack(np.meshgrid(*(np.linspace(0, n - 1, 16) for n in a.shape), indexing="ij"), axis=-1)
    covered = float(np.mean(b.contains(a.voxel_to_world(samples))))
    if covered < least:
        raise InputError(
            f"the {names[1]} image covers {covered:.0%} of the {names[0]} one, expected at least {least:.0%}: "
            f"their centres lie at {_centre(a)} and {_centre(b)} mm; check the affines, or align the images"
        )


def _open(path: Path) -> SpatialImage:
    try:
        source = nib.load(path)
    except (ImageFileError, HeaderDataError, OSError, EOFError, zlib.error) as error:
        raise InputError(f"image {path} cannot be read: {error}") from error
    if not isinstance(source, SpatialImage) or source.affine is None:
        raise InputError(f"{path} holds no image on a grid, but {type(source).__name__}")
    if isinstance(source, nib.Nifti1Image) and not (source.header["sform_code"] or source.header["qform_code"]):
        _log.warning("%s says nothing of its orientation (sform and qform code 0); taken to be centred", path)
    return source


def _voxels(source: SpatialImage, path: Path) -> np.ndarray:
    shape = source.shape
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if len(shape) != 3:
        raise InputError(f"expected a 3D image, got shape {source.shape}; take out one volume beforehand")
    try:
        voxels = np.array(np.asarray(source.dataobj)).reshape(shape)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"the file is cut short or damaged ({error})") from error
    if voxels.dtype.kind not in "iufb":
        raise InputError(f"expected one real number per voxel, got {voxels.dtype}")
    return voxels.astype(voxels.dtype.newbyteorder("="), copy=False)


def _storable(voxels: np.ndarray) -> np.ndarray:
    if voxels.dtype == bool:
        return voxels.astype(np.uint8)
    if voxels.dtype.kind == "f":
        return voxels.astype(np.float32)
    # 64-bit integers, NumPy's default, are read by few programs.
    if voxels.dtype.itemsize == 8 and voxels.min() >= -(2**31) and voxels.max() < 2**31:
        return voxels.astype(np.int32)
    return voxels


def _write(voxels: np.ndarray, affine: AnyArray, path: Path, intent: int | None = None) -> None:
    if not path.name.endswith((".nii", ".nii.gz")):
        raise InputError(f"{path} must end in .nii or .nii.gz")
    if not path.parent.is_dir():
        raise InputError(f"{path} cannot be written: there is no folder {path.parent}")
    image = nib.Nifti1Image(voxels, np.asarray(affine, float), dtype=voxels.dtype)
    image.header.set_xyzt_units("mm")
    if intent is not None:
        image.header.set_intent(intent)
    with replacing(path) as temporary:
        nib.save(image, temporary)


def _check_table(values: dict[str, list[int]], present: list[int], path: str | Path) -> None:
    owner: dict[int, str] = {}
    for name, entry in values.items():
        if not entry:
            raise InputError(f"the label table has no value for {name}")
        for value in entry:
            if value in owner:
                raise InputError(f"label {value} stands for both {owner[value]} and {name} in the label table")
            owner[value] = name
    absent = {value: name for value, name in owner.items() if value not in present}
    if absent:
        listed = ", ".join(f"{value} ({name})" for value, name in absent.items())
        shown = ", ".join(map(str, present[:30])) + (", …" if len(present) > 30 else "")
        raise InputError(f"label file {path} holds no label {listed}; it holds {shown}")


def _centre(image: Image) -> list[float]:
    return image.voxel_to_world((np.array(image.shape) - 1) / 2).round(1).tolist()
