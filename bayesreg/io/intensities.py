"""Intensities of about [0, 1] in files, two bytes each: rounded far below the noise of images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bayesreg.image import Image, IntensityScale
from bayesreg.io.volumes import save_image, write_nifti

# Intensities are multiples of this.
LEVEL = 2.0**-12


def in_levels(image: Image) -> Image:
    """Intensities of about [0, 1], rounded to multiples of `LEVEL`, far below their noise: single precision."""
    # Whole numbers know no negative zero.
    return image.with_voxels((np.rint(np.asarray(image.voxels) / LEVEL) * LEVEL + 0.0).astype(np.float32))


def save_in_levels(image: Image, path: str | Path, scale: IntensityScale | None = None) -> None:
    """Write intensities of about [0, 1], rounded as by `in_levels`, in two bytes each where that holds them all.

    A file of the same image in single precision takes twice as much. With a scale the file has the intensities before
    that.
    """
    image = in_levels(image)
    levels = np.rint(np.asarray(image.voxels) / LEVEL)
    low, high = (0.0, 1.0) if scale is None else scale
    if np.abs(levels).max() > np.iinfo(np.int16).max:
        save_image(image if scale is None else scale.undo(image), path)
    else:
        write_nifti(levels.astype(np.int16), image.affine, Path(path), scaling=(LEVEL * (high - low), low))
