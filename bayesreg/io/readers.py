"""Files that hold volumes, read by nibabel or SimpleITK, and where their voxels lie: world RAS, mm."""

from __future__ import annotations

import gzip
import logging
import os
from collections.abc import Sequence
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import nibabel as nib
import numpy as np
import SimpleITK
from jaxtyping import Float
from nibabel.arrayproxy import ArrayProxy
from nibabel.spatialimages import SpatialImage

from bayesreg.io.spaces import LPS, convert_affine
from bayesreg.memory import memory_of_machine
from bayesreg.types import InputError

# What SimpleITK reads and nibabel does not.
ITK_SUFFIXES = (".nrrd", ".nhdr", ".mha", ".mhd", ".dcm")
# Millimetres per unit of a NIfTI header; files that name none hold millimetres.
MILLIMETRES = {"unknown": 1.0, "mm": 1.0, "micron": 1e-3, "meter": 1e3}
# Two forms of a header say the same where they place no corner further apart than this share of a voxel, and slices of
# a series are evenly spaced where none lies further than this share of their distance from its place.
SAME_FORM, EVEN = 0.1, 0.02
# How far rounding may take a unit quaternion's square above one.
ROUNDED = 1e-5

_log = logging.getLogger(__name__)


class _LaxHeader(nib.Nifti1Header):
    quaternion_threshold = np.float64(-ROUNDED)


class _LaxNifti(nib.Nifti1Image):
    """NIfTI whose quaternion may be rounded up, which nibabel's own refuses."""

    header_class = _LaxHeader


class Volume(NamedTuple):
    """What a file holds.

    Attributes
    ----------
    voxels : (X, Y, Z, ...) array
        The file's scale of intensities applied. Components of vectors are the last axis.
    affine : (4, 4) array
        Voxel index to world RAS, mm.
    header : object
        That of nibabel; None where SimpleITK has read the file.
    """

    voxels: np.ndarray
    affine: Float[np.ndarray, "4 4"]
    header: Any = None


class Grid(NamedTuple):
    """Where the voxels of a file lie, by its header alone.

    Attributes
    ----------
    shape : tuple of int
    affine : (4, 4) array
        Voxel index to world RAS, mm.
    other : (4, 4) array or None
        The q-form of a NIfTI header, where it says something else than the s-form, which is taken.
    remarks : tuple of str
        What a user should know.
    """

    shape: tuple[int, ...]
    affine: Float[np.ndarray, "4 4"]
    other: Float[np.ndarray, "4 4"] | None = None
    remarks: tuple[str, ...] = ()


def read_volume(path: str | Path) -> Volume:
    """Read a volume: NIfTI, MGZ and what else nibabel knows; NRRD, MetaImage and DICOM by SimpleITK.

    Parameters
    ----------
    path : path
        A file, or a folder with one DICOM series.

    Raises
    ------
    InputError
        If there is no such file, it cannot be read, is damaged or cut short, or a series has gaps.
    """
    path = Path(path)
    if _is_folder(path):
        return _read_dicom(path)
    if is_itk(path):
        return _read_by_itk(path)
    source = _open(path)
    grid = _grid_of(source)
    for remark in grid.remarks:
        _log.warning("%s: %s", path, remark)
    return Volume(_voxels(source, path), grid.affine, source.header)


def read_grid(path: str | Path) -> Grid:
    """Read where the voxels of a volume lie, and no voxel; InputError as in `read_volume`."""
    path = Path(path)
    if _is_folder(path):
        return _grid_of_series(_names_of_series(path), path)
    if is_itk(path):
        header = _itk_header(path)
        return Grid(tuple(header.GetSize()), _affine_of_itk(header))
    return _grid_of(_open(path))


def is_itk(path: Path) -> bool:
    """Tell whether SimpleITK reads a file, by its name."""
    return path.name.lower().endswith(ITK_SUFFIXES)


def corners_apart(one: Float[np.ndarray, "4 4"], other: Float[np.ndarray, "4 4"], shape: tuple[int, ...]) -> float:
    """How far apart two affines place a corner of a grid, at most, mm."""
    corners = np.stack(np.meshgrid(*((0.0, n - 1.0) for n in shape[:3]), indexing="ij"), axis=-1).reshape(-1, 3)
    return float(np.linalg.norm(corners @ (one - other)[:3, :3].T + (one - other)[:3, 3], axis=1).max())


def _is_folder(path: Path) -> bool:
    """Tell a folder from a file; InputError where there is neither, or it may not be read."""
    try:
        folder, there = path.is_dir(), path.exists()
    except OSError as error:
        raise InputError(f"image {path}: {error.strerror}") from error
    if not there:
        raise InputError(f"image {path}: there is no such file")
    if not os.access(path, os.R_OK):
        raise InputError(f"image {path} may not be read; see its permissions")
    return folder


def _open(path: Path) -> SpatialImage:
    try:
        try:
            source = nib.load(path)
        except ValueError as error:
            if "w2 should be positive" not in str(error):
                raise
            source = _LaxNifti.from_filename(path)
    except Exception as error:  # Its readers have no common class of errors.
        raise InputError(f"image {path} cannot be read: {_first_line(error)}") from error
    if not isinstance(source, SpatialImage) or source.affine is None:
        raise InputError(f"{path} holds no image on a grid, but {type(source).__name__}")
    if min(_shape(source)) < 1:
        raise InputError(f"image {path} cannot be read: its header gives the shape {source.shape}")
    _require_memory(_shape(source), path)
    return source


def _require_memory(shape: Sequence[int], path: Path) -> None:
    """Raise InputError where a header speaks of more voxels than the machine could hold."""
    needed = 8 * prod(map(int, shape))
    held = memory_of_machine()
    if needed > held:
        grid = " × ".join(map(str, shape))
        raise InputError(
            f"image {path} has a grid of {grid} voxels by its header, which need {needed / 1e9:,.0f} GB; this machine "
            f"has {held / 1e9:,.0f} GB"
        )


def _shape(source: SpatialImage) -> tuple[int, ...]:
    """The shape that a header gives; trailing zeros, which some programs write, are no axes."""
    shape = tuple(map(int, source.shape))
    while len(shape) > 3 and shape[-1] == 0:
        shape = shape[:-1]
    return shape


def _grid_of(source: SpatialImage) -> Grid:
    shape, affine = _shape(source), np.asarray(source.affine, float)
    if not isinstance(source, nib.Nifti1Pair):
        analyze = f"an Analyze file does not tell left from right; {_x_runs(affine)}"
        return Grid(shape, affine, None, (analyze,) if isinstance(source, nib.AnalyzeImage) else ())
    header, remarks, other = source.header, [], None
    if not (header["sform_code"] or header["qform_code"]):
        remarks.append(f"it says nothing of its orientation (sform and qform code 0); centred, and {_x_runs(affine)}")
    elif header["sform_code"] and header["qform_code"]:
        affine, other, told = _choose_form(affine, _qform(header), shape)
        remarks += told
    unit, known = _unit(header)
    if not known:
        remarks.append("its header has an unknown unit; taken to be mm")
    if MILLIMETRES[unit] != 1:
        remarks.append(f"its header is in units of a {unit}, converted to mm")
    scale = np.diag([*[MILLIMETRES[unit]] * 3, 1.0])
    return Grid(shape, scale @ affine, None if other is None else scale @ other, tuple(remarks))


def _unit(header: Any) -> tuple[str, bool]:
    """The unit of lengths, and whether its code is known."""
    try:
        return str(header.get_xyzt_units()[0]), True
    except KeyError:
        return "unknown", False


def _qform(header: Any) -> Float[np.ndarray, "4 4"] | None:
    """The q-form; None where it has no inverse."""
    try:
        found = np.asarray(header.get_qform(), float)
    except ValueError:
        return None
    return found if _is_regular(found) else None


def _is_regular(affine: Float[np.ndarray, "4 4"]) -> bool:
    return bool(np.isfinite(affine).all() and np.linalg.matrix_rank(affine[:3, :3]) == 3)


def _choose_form(
    sform: Float[np.ndarray, "4 4"], qform: Float[np.ndarray, "4 4"] | None, shape: tuple[int, ...]
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"] | None, list[str]]:
    """The s-form and, where it differs, the q-form; the q-form alone where the s-form has no inverse."""
    if qform is None:
        return sform, None, []
    if not _is_regular(sform):
        return qform, None, ["its s-form has no inverse, and its q-form is taken"]
    apart = corners_apart(sform, qform, shape)
    if apart <= SAME_FORM * np.linalg.norm(sform[:3, :3], axis=0).min():
        return sform, None, []
    told = f"its s-form and its q-form place corners up to {apart:.3g} mm apart; the s-form is taken"
    return sform, qform, [f"{told}. If the q-form is right, write it into both"]


def _x_runs(affine: Float[np.ndarray, "4 4"]) -> str:
    return f"its first axis is taken to run to the {'right' if affine[0, 0] > 0 else 'left'}"


def _voxels(source: SpatialImage, path: Path) -> np.ndarray:
    data: Any = source.dataobj
    shape = _shape(source)
    if isinstance(source, nib.Nifti1Image):
        least = source.header.single_vox_offset
        if data.offset < least:
            # A single file begins with its header, whatever an offset of 0 says.
            _log.warning("%s: its voxels are said to begin inside the header; read from byte %d on", path, least)
        if data.offset < least or shape != source.shape:
            data = ArrayProxy(str(path), (shape, data.dtype, max(data.offset, least), data.slope, data.inter))
    try:
        if path.name.lower().endswith(".gz"):
            _require_whole(path, int(data.offset) + prod(shape) * data.dtype.itemsize)
        return np.array(np.asarray(data))
    except Exception as error:  # As above.
        raise InputError(f"image {path}: the file is cut short or damaged ({_first_line(error)})") from error


def _require_whole(path: Path, expected: int) -> None:
    """Read a compressed file to its end, where its checksum stands.

    An error of gzip or zlib tells of damage; a ValueError that the file holds much more bytes than expected.
    """
    count = 0
    with gzip.open(path) as file:
        while part := file.read(2**22):
            count += len(part)
            if count > 1.1 * expected + 2**20:
                raise ValueError("it holds far more than its header says")


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error).strip() else type(error).__name__


def _itk_header(path: Path) -> Any:
    """A reader of SimpleITK that has read the header of a file."""
    header = SimpleITK.ImageFileReader()
    header.SetFileName(str(path))
    try:
        header.ReadImageInformation()
    except RuntimeError as error:
        raise InputError(
            f"image {path} cannot be read: SimpleITK finds it damaged, cut short or of another kind"
        ) from error
    _require_memory(header.GetSize(), path)
    return header


def _read_by_itk(path: Path) -> Volume:
    header = _itk_header(path)
    try:
        image = header.Execute()
    except RuntimeError as error:
        raise InputError(f"image {path} cannot be read: SimpleITK finds it damaged or cut short") from error
    if path.name.lower().endswith(".dcm") and image.GetSize()[-1] == 1:
        raise InputError(f"image {path} is one slice; give the folder that holds its series, and nothing else")
    if path.name.lower().endswith((".nrrd", ".nhdr")) and "NRRD_space" not in image.GetMetaDataKeys():
        _log.warning("%s: it says nothing of its space; taken to be LPS, mm", path)
    return from_itk(image)


def _names_of_series(folder: Path) -> tuple[str, ...]:
    """The files of the one DICOM series in a folder, in their order."""
    series = SimpleITK.ImageSeriesReader.GetGDCMSeriesIDs(str(folder))
    if len(series) != 1:
        listed = f": {', '.join(series)}" if series else ""
        raise InputError(f"the folder {folder} holds {len(series)} DICOM series{listed}; expected one")
    names = SimpleITK.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), series[0])
    if left := sorted({str(path) for path in folder.iterdir() if _looks_like_dicom(path)} - set(names)):
        raise InputError(
            f"{left[0]} cannot be read as part of the DICOM series in its folder; mend it, or take it away"
        )
    return tuple(names)


def _grid_of_series(names: tuple[str, ...], folder: Path) -> Grid:
    """The grid of slices that are evenly spaced; a gantry tilt becomes a shear of the affine."""
    headers = [_itk_header(Path(name)) for name in names]
    shape, affine = list(headers[0].GetSize()), _affine_of_itk(headers[0])
    if len(names) == 1:
        return Grid(tuple(shape), affine)
    places = np.array([header.GetOrigin() for header in headers])
    step = (places[-1] - places[0]) / (len(places) - 1)
    away = np.linalg.norm(places - places[0] - np.arange(len(places))[:, None] * step, axis=1).max()
    length = np.linalg.norm(step)
    if any(header.GetSize()[2:] != (1,) for header in headers) or length == 0 or away > EVEN * length:
        raise InputError(
            f"the {len(places)} slices in {folder} are not evenly spaced: one lies {away:.3g} mm from its place, at "
            f"{length:.3g} mm a step. A slice is missing or there twice, or there are several images"
        )
    affine[:3, 2], affine[:3, 3] = step * LPS, places[0] * LPS
    return Grid((*shape[:2], len(names)), affine)


def _read_dicom(folder: Path) -> Volume:
    names = _names_of_series(folder)
    volume = _series(names, folder)
    return volume._replace(affine=_grid_of_series(names, folder).affine)


def _looks_like_dicom(path: Path) -> bool:
    """By its name, or the four letters that begin its content."""
    if not path.is_file() or path.name.upper() == "DICOMDIR":
        return False
    if path.name.lower().endswith(".dcm"):
        return True
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM"


def _series(names: tuple[str, ...], folder: Path) -> Volume:
    reader = SimpleITK.ImageSeriesReader()
    reader.SetFileNames(names)
    # What it warns of is checked here.
    warns = SimpleITK.ProcessObject.GetGlobalWarningDisplay()
    SimpleITK.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        return from_itk(reader.Execute())
    except RuntimeError as error:
        raise InputError(
            f"the DICOM series in {folder} cannot be read: a slice is damaged or of another size"
        ) from error
    finally:
        SimpleITK.ProcessObject.SetGlobalWarningDisplay(warns)


def _affine_of_itk(image: Any) -> Float[np.ndarray, "4 4"]:
    """Voxel index to world RAS, mm, of an image of SimpleITK or of a header that it has read."""
    dimension = image.GetDimension()
    size = min(dimension, 3)
    affine = np.eye(4)
    direction = np.reshape(image.GetDirection(), (dimension, dimension))[:size, :size]
    affine[:size, :size] = direction * np.array(image.GetSpacing()[:size])
    affine[:size, 3] = image.GetOrigin()[:size]
    return convert_affine(affine)


def from_itk(image: Any) -> Volume:
    """What an image of SimpleITK holds."""
    array, dimension = SimpleITK.GetArrayFromImage(image), image.GetDimension()
    axes = (*range(dimension - 1, -1, -1), *range(dimension, array.ndim))
    return Volume(np.ascontiguousarray(array.transpose(axes)), _affine_of_itk(image))
