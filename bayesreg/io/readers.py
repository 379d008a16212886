"""Readers of volumes and their grids by nibabel or SimpleITK; world RAS, mm."""

from __future__ import annotations

import gzip
import logging
import os
from math import prod
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
from jaxtyping import Float
from nibabel.arrayproxy import ArrayProxy
from nibabel.spatialimages import SpatialImage

from bayesreg.io.grids import Grid, Volume, corners_apart, require_memory
from bayesreg.io.itk import is_itk, read_by_itk, read_grid_by_itk, read_series
from bayesreg.types import InputError

# Millimetres per unit of a NIfTI header. Files without a unit are in millimetres.
MILLIMETRES = {"unknown": 1.0, "mm": 1.0, "micron": 1e-3, "meter": 1e3}
# Two forms of a header agree if the distance between their corners is at most this share of a voxel.
SAME_FORM = 0.1
# The largest excess over one, due to rounding, of the squared norm of a unit quaternion.
ROUNDED = 1e-5

_log = logging.getLogger(__name__)


class _LaxHeader(nib.Nifti1Header):
    quaternion_threshold = np.float64(-ROUNDED)


class _LaxNifti(nib.Nifti1Image):
    """A NIfTI image whose quaternion may be rounded up, which nibabel's own class refuses."""

    header_class = _LaxHeader


def read_volume(path: str | Path) -> Volume:
    """Read a volume: NIfTI, MGZ and other formats by nibabel; NRRD, MetaImage and DICOM by SimpleITK.

    Parameters
    ----------
    path : path
        A file, or a folder with one DICOM series.

    Raises
    ------
    InputError
        If the file does not exist, cannot be read, is damaged or cut short, or a series has gaps.
    """
    path = Path(path)
    if _is_folder(path):
        return read_series(path)
    if is_itk(path):
        return read_by_itk(path)
    source = _open(path)
    grid = _grid_of(source)
    for remark in grid.remarks:
        _log.warning("%s: %s", path, remark)
    return Volume(_voxels(source, path), grid.affine, source.header)


def read_grid(path: str | Path) -> Grid:
    """Read the grid of a volume without its voxels; raise InputError as in `read_volume`."""
    path = Path(path)
    if _is_folder(path) or is_itk(path):
        return read_grid_by_itk(path)
    return _grid_of(_open(path))


def _is_folder(path: Path) -> bool:
    """Check whether a path is a folder; raise InputError if it does not exist or may not be read."""
    try:
        folder, exists = path.is_dir(), path.exists()
    except OSError as error:
        raise InputError(f"image {path}: {error.strerror}") from error
    if not exists:
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
    except Exception as error:  # The readers of nibabel have no common class of errors.
        raise InputError(f"image {path} cannot be read: {_first_line(error)}") from error
    if not isinstance(source, SpatialImage) or source.affine is None:
        raise InputError(f"{path} holds no image on a grid, but {type(source).__name__}")
    if min(_shape(source)) < 1:
        raise InputError(f"image {path} cannot be read: its header gives the shape {source.shape}")
    require_memory(_shape(source), path)
    return source


def _shape(source: SpatialImage) -> tuple[int, ...]:
    """Read the shape from a header, without the trailing zeros that some programs write."""
    shape = tuple(map(int, source.shape))
    while len(shape) > 3 and shape[-1] == 0:
        shape = shape[:-1]
    return shape


def _grid_of(source: SpatialImage) -> Grid:
    shape, affine = _shape(source), np.asarray(source.affine, float)
    if not isinstance(source, nib.Nifti1Pair):
        analyze = f"an Analyze file does not tell left from right; {_x_runs(affine)}"
        return Grid(shape, affine, None, (analyze,) if isinstance(source, nib.AnalyzeImage) else ())
    header, remarks, qform = source.header, [], None
    if not (header["sform_code"] or header["qform_code"]):
        remarks.append(f"it says nothing of its orientation (sform and qform code 0); centred, and {_x_runs(affine)}")
    elif header["sform_code"] and header["qform_code"]:
        affine, qform, messages = _choose_form(affine, _qform(header), shape)
        remarks += messages
    unit, unit_is_known = _unit(header)
    if not unit_is_known:
        remarks.append("its header has an unknown unit; taken to be mm")
    if MILLIMETRES[unit] != 1:
        remarks.append(f"its header is in units of a {unit}, converted to mm")
    scale = np.diag([*[MILLIMETRES[unit]] * 3, 1.0])
    return Grid(shape, scale @ affine, None if qform is None else scale @ qform, tuple(remarks))


def _unit(header: Any) -> tuple[str, bool]:
    """Read the unit of lengths, and whether its code is known."""
    try:
        return str(header.get_xyzt_units()[0]), True
    except KeyError:
        return "unknown", False


def _qform(header: Any) -> Float[np.ndarray, "4 4"] | None:
    """Read the q-form; return None if it has no inverse."""
    try:
        affine = np.asarray(header.get_qform(), float)
    except ValueError:
        return None
    return affine if _is_regular(affine) else None


def _is_regular(affine: Float[np.ndarray, "4 4"]) -> bool:
    return bool(np.isfinite(affine).all() and np.linalg.matrix_rank(affine[:3, :3]) == 3)


def _choose_form(
    sform: Float[np.ndarray, "4 4"], qform: Float[np.ndarray, "4 4"] | None, shape: tuple[int, ...]
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"] | None, list[str]]:
    """Choose the affine of a header that has both forms.

    The result is the s-form, and the q-form if it differs; only the q-form if the s-form has no inverse. Messages for
    the user come last.
    """
    if qform is None:
        return sform, None, []
    if not _is_regular(sform):
        return qform, None, ["its s-form has no inverse, and its q-form is taken"]
    distance = corners_apart(sform, qform, shape)
    if distance <= SAME_FORM * np.linalg.norm(sform[:3, :3], axis=0).min():
        return sform, None, []
    message = f"its s-form and its q-form place corners up to {distance:.3g} mm apart; the s-form is taken"
    return sform, qform, [f"{message}. If the q-form is right, write it into both"]


def _x_runs(affine: Float[np.ndarray, "4 4"]) -> str:
    return f"its first axis is taken to run to the {'right' if affine[0, 0] > 0 else 'left'}"


def _voxels(source: SpatialImage, path: Path) -> np.ndarray:
    data: Any = source.dataobj
    shape = _shape(source)
    if isinstance(source, nib.Nifti1Image):
        least = source.header.single_vox_offset
        if data.offset < least:
            # A single file begins with its header, even if its offset is 0.
            _log.warning("%s: its voxels are said to begin inside the header; read from byte %d on", path, least)
        if data.offset < least or shape != source.shape:
            data = ArrayProxy(str(path), (shape, data.dtype, max(data.offset, least), data.slope, data.inter))
    try:
        if path.name.lower().endswith(".gz"):
            _require_whole(path, int(data.offset) + prod(shape) * data.dtype.itemsize)
        return np.array(np.asarray(data))
    except Exception as error:  # See `_open`.
        raise InputError(f"image {path}: the file is cut short or damaged ({_first_line(error)})") from error


def _require_whole(path: Path, expected: int) -> None:
    """Read a compressed file to its end, so that gzip verifies the checksum there.

    Damage causes an error of gzip or zlib. A file that holds many more bytes than expected causes a ValueError.
    """
    count = 0
    with gzip.open(path) as file:
        while chunk := file.read(2**22):
            count += len(chunk)
            if count > 1.1 * expected + 2**20:
                raise ValueError("it holds far more than its header says")


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error).strip() else type(error).__name__
