"""Files of intensities of about [0, 1] in two bytes each; the rounding is far below the noise of images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bayesreg.image import Image, IntensityScale
from bayesreg.io.volumes import save_image, write_nifti

# Stored intensities are multiples of this.
LEVEL = 2.0**-12


def in_levels(image: Image) -> Image:
    """Round intensities of about [0, 1] to multiples of `LEVEL`, far below their noise; float32."""
    # Whole numbers know no negative zero.
    return image.with_voxels((np.rint(np.asarray(image.voxels) / LEVEL) * LEVEL + 0.0).astype(np.float32))


def save_in_levels(image: Image, path: str | Path, scale: IntensityScale | None = None) -> None:
    """Write intensities of about [0, 1], rounded by `in_levels`, in two bytes each.

    If two bytes cannot hold the values, they are written as float32, which takes twice the space. If a scale is given,
    the file holds the intensities before that scale was applied.
    """
    image = in_levels(image)
    levels = np.rint(np.asarray(image.voxels) / LEVEL)
    low, high = (0.0, 1.0) if scale is None else scale
    if np.abs(levels).max() > np.iinfo(np.int16).max:
        save_image(image if scale is None else scale.undo(image), path)
    else:
        write_nifti(levels.astype(np.int16), image.affine, Path(path), scaling=(LEVEL * (high - low), low))
