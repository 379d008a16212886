"""Writer of transforms as ITK composites in HDF5 (.h5): a displacement field on a grid and a pose, in LPS."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Float

from bayesreg.image import Image
from bayesreg.io.atomic import replacing
from bayesreg.io.spaces import LPS, convert_affine, convert_motion
from bayesreg.pose import Pose
from bayesreg.types import AnyArray

# Fields are rounded to multiples of this, mm: files become smaller, and the error is an eighth of a micrometre.
QUANTUM = 2.0**-12


def save_transform(
    path: str | Path, field: Float[AnyArray, "X Y Z 3"], grid: Image, pose: Pose, pose_first: bool = False
) -> None:
    """Write the transform y = pose(x + u(x)), or y = x′ + u(x′) with x′ = pose(x) if the pose comes first, for ITK.

    Parameters
    ----------
    path : path
        Ends in .h5.
    field : (X, Y, Z, 3) array
        u at the voxel centres of the grid, mm, world RAS. ITK interpolates it linearly and sets it to zero beyond the
        grid.
    grid : Image
        The grid of the field; its axes must be orthogonal (`Image.is_orthogonal`).
    pose : Pose
    pose_first : bool

    Notes
    -----
    The layout is that of `itk::HDF5TransformIO`: transforms in a queue, of which the last is applied first. The field
    is stored as compressed float32, which ITK can read but does not write itself.
    """
    if not grid.is_orthogonal:
        raise ValueError("ITK's grids have axes at right angles; use Image.on_orthogonal_grid")
    transforms = [_affine(pose), _displacement_field(field, grid)]
    with replacing(path) as temporary, h5py.File(temporary, "w", track_order=False) as file:
        _write_text(file, "ITKVersion", "5.4.0")
        _write_text(file, "HDFVersion", h5py.version.hdf5_version)
        _write_text(file, "OSName", "")
        _write_text(file, "OSVersion", "")
        _write_text(file, "TransformGroup/0/TransformType", "CompositeTransform_double_3_3")
        for number, (kind, fixed_parameters, parameters) in enumerate(
            transforms[::-1] if pose_first else transforms, start=1
        ):
            group = f"TransformGroup/{number}"
            _write_text(file, f"{group}/TransformType", f"{kind}_double_3_3")
            file[f"{group}/TransformFixedParameters"] = fixed_parameters
            packed = {"compression": "gzip", "compression_opts": 4, "shuffle": True} if parameters.size > 100 else {}
            file.create_dataset(f"{group}/TransformParameters", data=parameters, **packed)


def _write_text(file: h5py.File, name: str, text: str) -> None:
    file.create_dataset(name, (1,), h5py.string_dtype("ascii"), data=[text])


def _affine(pose: Pose) -> tuple[str, np.ndarray, np.ndarray]:
    """Convert a pose to ITK's affine transform: name, centre (the origin), matrix by rows and translation."""
    matrix = convert_motion(pose.matrix)
    return "AffineTransform", np.zeros(3), np.concatenate([matrix[:3, :3].ravel(), matrix[:3, 3]])


def _displacement_field(field: Float[AnyArray, "X Y Z 3"], grid: Image) -> tuple[str, np.ndarray, np.ndarray]:
    """Convert a field to ITK's transform: name; size, origin, spacing and directions of the grid; vectors.

    The first voxel axis of the vectors varies fastest.
    """
    affine = convert_affine(grid.affine)
    directions = affine[:3, :3] / grid.voxel_sizes
    fixed_parameters = np.concatenate([grid.shape, affine[:3, 3], grid.voxel_sizes, directions.ravel()])
    vectors = np.round(np.asarray(field) / QUANTUM) * QUANTUM * LPS
    return "DisplacementFieldTransform", fixed_parameters, vectors.transpose(2, 1, 0, 3).astype(np.float32).ravel()
