"""Files of displacement fields on a grid, by the conventions of the programs that write them."""

from __future__ import annotations

from pathlib import Path

import nibabel as nib
import numpy as np
import SimpleITK
from jaxtyping import Float

from bayesreg.image import Image
from bayesreg.io.grids import Volume
from bayesreg.io.itk import from_itk
from bayesreg.io.readers import read_volume
from bayesreg.io.spaces import LPS
from bayesreg.io.volumes import write_nifti
from bayesreg.types import AnyArray, InputError

TRANSFORM_SUFFIXES = (".h5", ".tfm")
# Codes of NIfTI's intents: displacement vectors (FreeSurfer, RAS), vectors (ITK, LPS), and FSL's fields, which have
# FSL's own coordinates.
DISPLACEMENT_INTENT, VECTOR_INTENT, FSL_INTENTS = 1006, 1007, range(2001, 2020)


def save_displacement(path: str | Path, field: Float[AnyArray, "X Y Z 3"], affine: Float[AnyArray, "4 4"]) -> None:
    """Write a displacement field that ITK, ANTs and nitransforms read as a resampling transform.

    Parameters
    ----------
    path : path
        Ends in .nii or .nii.gz.
    field : (X, Y, Z, 3) array
        Displacement at every voxel centre, mm, world RAS. The file has the shape (X, Y, Z, 1, 3), the intent 1007
        (vector), and values in LPS.
    affine : (4, 4) array
        Voxel index to world RAS, mm.
    """
    lps = np.asarray(field, np.float32) * LPS.astype(np.float32)
    write_nifti(lps[:, :, :, None], affine, Path(path), intent=VECTOR_INTENT)


def load_displacement(path: str | Path) -> tuple[Image, Image, Image]:
    """Read a displacement field; the inverse of `save_displacement`.

    A NIfTI header shows which program wrote the file. ITK and ANTs (intent 1007, or none) store displacements in LPS.
    FreeSurfer (intent 1006) and NiftyReg ("NREG_TRANS", first parameter 1) store displacements in RAS. SPM (named
    "Mapping") and NiftyReg (first parameter 0) store the RAS coordinates to which the voxels move; the displacement is
    computed from them. NRRD, MetaImage and ITK's transforms (.h5, .tfm) hold LPS.

    Parameters
    ----------
    path : path
        Vectors in mm, of shape (X, Y, Z, 1, 3) or (X, Y, Z, 3).

    Returns
    -------
    three Images
        Components along x, y and z, mm, world RAS.

    Raises
    ------
    InputError
        If the file does not exist, is damaged, holds no field, or holds a field of an unknown kind.
    """
    path = Path(path)
    volume = _transform_field(path) if path.name.lower().endswith(TRANSFORM_SUFFIXES) else read_volume(path)
    shape = volume.voxels.shape
    if shape[3:] not in ((1, 3), (3,)):
        raise InputError(
            f"{path} is no displacement field: expected the shape (X, Y, Z, 1, 3) or (X, Y, Z, 3), vectors in mm, got "
            f"{shape}"
        )
    if volume.voxels.dtype.kind not in "iuf":
        raise InputError(f"{path} is no displacement field: expected real numbers, mm, got {volume.voxels.dtype}")
    vectors = np.asarray(volume.voxels, float).reshape(*shape[:3], 3)
    try:
        grid = Image(np.zeros(shape[:3], np.int8), volume.affine)
        x, y, z = np.moveaxis(_displacements(vectors, grid, volume, path), -1, 0)
        return grid.with_voxels(x), grid.with_voxels(y), grid.with_voxels(z)
    except ValueError as error:
        raise InputError(f"displacement field {path}: {error}") from error


def _displacements(
    vectors: Float[np.ndarray, "X Y Z 3"], grid: Image, volume: Volume, path: Path
) -> Float[np.ndarray, "X Y Z 3"]:
    """Convert the vectors of a file to displacements in world RAS, mm, according to its header."""
    if not isinstance(volume.header, nib.Nifti1Header):
        return vectors * LPS
    code, name = int(volume.header["intent_code"]), str(volume.header.get_intent("code")[2])
    first = float(volume.header["intent_p1"])
    if code in FSL_INTENTS:
        raise InputError("FSL's fields and coefficients are in coordinates of its own; convert it to ITK's convention")
    if name.startswith("NREG"):
        if name != "NREG_TRANS" or first not in (0, 1):
            raise InputError(f"NiftyReg's {name} of kind {first:g} is no field of positions or displacements")
        return vectors if first == 1 else vectors - grid.grid_points()
    if name == "Mapping":
        return vectors - grid.grid_points()
    return vectors if code == DISPLACEMENT_INTENT else vectors * LPS


def _whole_field(transform: SimpleITK.Transform) -> SimpleITK.Image:
    """Compute the displacement field of an ITK transform; a composite is evaluated on the grid of its one field."""
    if transform.GetName() != "CompositeTransform":
        return SimpleITK.DisplacementFieldTransform(transform).GetDisplacementField()
    composite = SimpleITK.CompositeTransform(transform)
    transforms = [composite.GetNthTransform(k) for k in range(composite.GetNumberOfTransforms())]
    inner = [member for member in transforms if member.GetName() == "DisplacementFieldTransform"]
    if len(inner) != 1:
        raise RuntimeError(f"a composite of {len(inner)} fields")
    grid = SimpleITK.DisplacementFieldTransform(inner[0]).GetDisplacementField()
    if len(transforms) == 1:
        return grid
    where = grid.GetSize(), grid.GetOrigin(), grid.GetSpacing(), grid.GetDirection()
    return SimpleITK.TransformToDisplacementField(transform, SimpleITK.sitkVectorFloat64, *where)


def _transform_field(path: Path) -> Volume:
    """Read the displacement field of a file with an ITK transform."""
    if not path.is_file():
        raise InputError(f"displacement field {path}: there is no such file")
    try:
        field = _whole_field(SimpleITK.ReadTransform(str(path)))
    except RuntimeError as error:
        raise InputError(f"{path} holds no displacement field as ITK writes it, or is damaged") from error
    return from_itk(field)
