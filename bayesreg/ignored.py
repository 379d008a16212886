"""Find the voxels of an image that a mask ignores; the grids of mask and image may differ."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from bayesreg.image import Image


def ignored_voxels(image: Image, ignore: Image) -> Bool[np.ndarray, "X Y Z"]:
    """Mark the voxels of an image whose nearest voxel in the mask is not zero; the mask is zero outside its grid."""
    return np.asarray(ignore.nearest(image.grid_points()) != 0)


def fill_ignored(image: Image, ignore: Image | None) -> Image:
    """Replace the intensity of every ignored voxel by that of the nearest voxel that is not ignored.

    Smoothing, gradients and interpolation near the mask then do not depend on the ignored intensities. An image that is
    ignored as a whole does not change.
    """
    if ignore is None:
        return image
    ignored = ignored_voxels(image, ignore)
    if ignored.all() or not ignored.any():
        return image
    nearest = ndimage.distance_transform_edt(ignored, image.voxel_sizes, return_distances=False, return_indices=True)
    return image.with_voxels(np.asarray(image.voxels)[tuple(nearest)])
