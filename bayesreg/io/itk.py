"""Images of SimpleITK in LPS, converted to and from RAS: NRRD, MetaImage and DICOM files, and images in memory."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK
from jaxtyping import Float

from bayesreg.image import Image
from bayesreg.io.grids import Grid, Volume, require_memory
from bayesreg.io.spaces import LPS, convert_affine
from bayesreg.types import InputError

# Suffixes of files that SimpleITK reads and nibabel does not.
ITK_SUFFIXES = (".nrrd", ".nhdr", ".mha", ".mhd", ".dcm")
# Slices of a series are evenly spaced if each lies within this share of their spacing from its expected position.
EVEN = 0.02

_log = logging.getLogger(__name__)


def is_itk(path: Path) -> bool:
    """Decide by its name whether SimpleITK reads a file."""
    return path.name.lower().endswith(ITK_SUFFIXES)


def read_grid_by_itk(path: Path) -> Grid:
    """Read the grid of a file or of a DICOM series in a folder."""
    if path.is_dir():
        return _grid_of_series(_names_of_series(path), path)
    header = _itk_header(path)
    return Grid(tuple(header.GetSize()), _affine_of_itk(header))


def _itk_header(path: Path) -> Any:
    """Read the header of a file; return SimpleITK's reader, which holds it."""
    header = SimpleITK.ImageFileReader()
    header.SetFileName(str(path))
    try:
        header.ReadImageInformation()
    except RuntimeError as error:
        raise InputError(
            f"image {path} cannot be read: SimpleITK finds it damaged, cut short or of another kind"
        ) from error
    require_memory(header.GetSize(), path)
    return header


def read_by_itk(path: Path) -> Volume:
    """Read a file by SimpleITK; raise InputError if it is damaged or a single slice of DICOM."""
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
    """List the files of the one DICOM series in a folder, in the order of the slices."""
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
    """Compute the grid of evenly spaced slices; a gantry tilt becomes a shear of the affine."""
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


def read_series(folder: Path) -> Volume:
    """Read the one DICOM series in a folder; raise InputError if a slice is missing or damaged."""
    names = _names_of_series(folder)
    volume = _series(names, folder)
    return volume._replace(affine=_grid_of_series(names, folder).affine)


def _looks_like_dicom(path: Path) -> bool:
    """Decide whether a file is DICOM, by its suffix or by the letters DICM at byte 128."""
    if not path.is_file() or path.name.upper() == "DICOMDIR":
        return False
    if path.name.lower().endswith(".dcm"):
        return True
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM"


def _series(names: tuple[str, ...], folder: Path) -> Volume:
    reader = SimpleITK.ImageSeriesReader()
    reader.SetFileNames(names)
    # The conditions of SimpleITK's warnings are checked in `_grid_of_series`.
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
    """Compute the affine from voxel index to world RAS, mm, of a SimpleITK image or header."""
    dimension = image.GetDimension()
    size = min(dimension, 3)
    affine = np.eye(4)
    direction = np.reshape(image.GetDirection(), (dimension, dimension))[:size, :size]
    affine[:size, :size] = direction * np.array(image.GetSpacing()[:size])
    affine[:size, 3] = image.GetOrigin()[:size]
    return convert_affine(affine)


def from_itk(image: Any) -> Volume:
    """Convert a SimpleITK image to a `Volume`."""
    array, dimension = SimpleITK.GetArrayFromImage(image), image.GetDimension()
    axes = (*range(dimension - 1, -1, -1), *range(dimension, array.ndim))
    return Volume(np.ascontiguousarray(array.transpose(axes)), _affine_of_itk(image))


def to_itk(image: Image, dtype: str) -> SimpleITK.Image:
    """Convert an image with orthogonal axes to SimpleITK."""
    itk_image = SimpleITK.GetImageFromArray(np.asarray(image.voxels).astype(dtype).transpose(2, 1, 0))
    affine = convert_affine(image.affine)
    itk_image.SetSpacing(image.voxel_sizes.tolist())
    itk_image.SetDirection((affine[:3, :3] / image.voxel_sizes).ravel().tolist())
    itk_image.SetOrigin(affine[:3, 3].tolist())
    return itk_image
