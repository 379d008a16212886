"""Files that hold volumes, read by nibabel or SimpleITK, and where their voxels lie: world RAS, mm."""

from __future__ import annotations

import logging
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import nibabel as nib
import numpy as np
from jaxtyping import Float
from nibabel.arrayproxy import ArrayProxy
from nibabel.spatialimages import SpatialImage

from bayesreg.types import InputError

# What SimpleITK reads and nibabel does not.
ITK_SUFFIXES = (".nrrd", ".nhdr", ".mha", ".mhd", ".dcm", ".gipl", ".gipl.gz")
# Millimetres per unit of a NIfTI header; files that name none hold millimetres.
MILLIMETRES = {"unknown": 1.0, "mm": 1.0, "micron": 1e-3, "meter": 1e3}
# World RAS and ITK's LPS differ in the signs of x and y.
LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
# Two forms of a header say the same where they place no corner further apart than this share of a voxel.
SAME_FORM = 0.1

_log = logging.getLogger(__name__)


class Volume(NamedTuple):
    """What a file holds.

    Attributes
    ----------
    voxels : (X, Y, Z, ...) array
        The file's scale of intensities applied. Components of vectors are the last axis.
    affine : (4, 4) array
        Voxel index to world RAS, mm.
    other_affine : (4, 4) array or None
        What the q-form of the header says, where it says something else than the s-form, which is the affine.
    header : object
        That of nibabel; None where SimpleITK has read the file.
    """

    voxels: np.ndarray
    affine: Float[np.ndarray, "4 4"]
    other_affine: Float[np.ndarray, "4 4"] | None = None
    header: Any = None


def read_volume(path: str | Path) -> Volume:
    """Read a volume: NIfTI, MGZ and what else nibabel knows, NRRD, MetaImage and DICOM by SimpleITK.

    A NIfTI file whose header nibabel refuses is read by SimpleITK, and the log says so.

    Parameters
    ----------
    path : path
        A file, or a folder with one DICOM series.

    Raises
    ------
    InputError
        If there is no such file, or neither library can read it.
    """
    path = Path(path)
    if path.is_dir():
        return _read_dicom(path)
    if not path.is_file():
        raise InputError(f"image {path}: there is no such file")
    if path.name.lower().endswith(ITK_SUFFIXES):
        return _read_by_itk(path)
    try:
        source = _open(path)
    except InputError as refused:
        if not path.name.endswith((".nii", ".nii.gz")):
            raise
        try:
            found = _read_by_itk(path)
        except InputError:
            raise refused from None
        _log.warning("%s: nibabel refuses its header, so that SimpleITK has read it (%s)", path, refused)
        return found
    affine, other = _affine(source, path)
    return Volume(_voxels(source, path), affine, other, source.header)


def other_form(path: str | Path) -> Float[np.ndarray, "4 4"] | None:
    """The q-form of a NIfTI header, where it says something else than the s-form, which is taken; without voxels."""
    path = Path(path)
    return _affine(_open(path), path)[1] if path.name.endswith((".nii", ".nii.gz")) else None


def corners_apart(one: Float[np.ndarray, "4 4"], other: Float[np.ndarray, "4 4"], shape: tuple[int, ...]) -> float:
    """How far apart two affines place a corner of a grid, at most, mm."""
    corners = np.stack(np.meshgrid(*((0.0, n - 1.0) for n in shape[:3]), indexing="ij"), axis=-1).reshape(-1, 3)
    return float(np.linalg.norm(corners @ (one - other)[:3, :3].T + (one - other)[:3, 3], axis=1).max())


def _open(path: Path) -> SpatialImage:
    try:
        source = nib.load(path)
    except Exception as error:  # Its readers have no common class of errors.
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"image {path} cannot be read: {reason}") from error
    if not isinstance(source, SpatialImage) or source.affine is None:
        raise InputError(f"{path} holds no image on a grid, but {type(source).__name__}")
    if 0 in source.shape:
        raise InputError(f"image {path} cannot be read: its header gives the shape {source.shape}")
    return source


def _affine(source: SpatialImage, path: Path) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"] | None]:
    """Voxel index to world, mm, and the other form of a NIfTI header where it says something else."""
    affine, other = np.asarray(source.affine, float), None
    if not isinstance(source, nib.Nifti1Pair):
        if isinstance(source, nib.AnalyzeImage):
            _log.warning("%s is an Analyze file, which does not tell left from right; %s", path, _x_runs(affine))
        return affine, None
    header = source.header
    if not (header["sform_code"] or header["qform_code"]):
        _log.warning("%s says nothing of its orientation (sform and qform code 0); taken to be centred, and %s",
                     path, _x_runs(affine))  # fmt: skip
    elif header["sform_code"] and header["qform_code"]:
        affine, other = _choose_form(affine, np.asarray(header.get_qform(), float), source.shape, path)
    unit = header.get_xyzt_units()[0]
    if MILLIMETRES[unit] != 1:
        _log.warning("%s: its header is in units of a %s, converted to mm", path, unit)
    scale = np.diag([*[MILLIMETRES[unit]] * 3, 1.0])
    return scale @ affine, None if other is None else scale @ other


def _choose_form(
    sform: Float[np.ndarray, "4 4"], qform: Float[np.ndarray, "4 4"], shape: tuple[int, ...], path: Path
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"] | None]:
    """The s-form and, where it differs, the q-form; the q-form alone where the s-form has no inverse."""
    if np.linalg.matrix_rank(sform[:3, :3]) < 3:
        _log.warning("%s: its s-form is singular, and its q-form is taken", path)
        return qform, None
    apart = corners_apart(sform, qform, shape)
    if apart <= SAME_FORM * np.linalg.norm(sform[:3, :3], axis=0).min():
        return sform, None
    _log.warning(
        "%s: its s-form and its q-form place corners up to %.3g mm apart; the s-form is taken. If the q-form is right, "
        "write it into both", path, apart,
    )  # fmt: skip
    return sform, qform


def _x_runs(affine: Float[np.ndarray, "4 4"]) -> str:
    return f"its first axis is taken to run to the {'right' if affine[0, 0] > 0 else 'left'}"


def _voxels(source: SpatialImage, path: Path) -> np.ndarray:
    data: Any = source.dataobj
    least = getattr(source.header, "single_vox_offset", 0)
    if isinstance(source, nib.Nifti1Image) and data.offset < least:
        # A single file begins with its header, whatever an offset of 0 says.
        data = ArrayProxy(str(path), (data.shape, data.dtype, least, data.slope, data.inter))
        _log.warning("%s: its voxels are said to begin inside the header; read from byte %d on", path, least)
    try:
        return np.array(np.asarray(data))
    except (OSError, EOFError, zlib.error, ValueError) as error:
        raise InputError(f"image {path}: the file is cut short or damaged ({error})") from error


def _read_by_itk(path: Path) -> Volume:
    import SimpleITK

    try:
        return from_itk(SimpleITK.ReadImage(str(path)))
    except RuntimeError as error:
        raise InputError(f"image {path} cannot be read: {_reason(error)}") from error


def _read_dicom(folder: Path) -> Volume:
    import SimpleITK

    series = SimpleITK.ImageSeriesReader.GetGDCMSeriesIDs(str(folder))
    if len(series) != 1:
        listed = f": {', '.join(series)}" if series else ""
        raise InputError(f"the folder {folder} holds {len(series)} DICOM series{listed}; expected one")
    reader = SimpleITK.ImageSeriesReader()
    reader.SetFileNames(SimpleITK.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), series[0]))
    try:
        return from_itk(reader.Execute())
    except RuntimeError as error:
        raise InputError(f"the DICOM series in {folder} cannot be read: {_reason(error)}") from error


def from_itk(image: Any) -> Volume:
    """What an image of SimpleITK holds."""
    import SimpleITK

    dimension = image.GetDimension()
    direction = np.reshape(image.GetDirection(), (dimension, dimension))[:3, :3]
    affine = np.eye(4)
    size = min(dimension, 3)
    affine[:size, :size] = direction * np.array(image.GetSpacing()[:3])
    affine[:size, 3] = image.GetOrigin()[:3]
    array = SimpleITK.GetArrayFromImage(image)
    axes = (*range(dimension - 1, -1, -1), *range(dimension, array.ndim))
    return Volume(np.ascontiguousarray(array.transpose(axes)), LPS @ affine)


def _reason(error: RuntimeError) -> str:
    """The last line of ITK's message, which says what was wrong."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
