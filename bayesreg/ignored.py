"""What a mask says of an image to ignore: on the grid of the image, whatever grid the mask lies on."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from bayesreg.image import Image


def ignored_voxels(image: Image, ignore: Image) -> Bool[np.ndarray, "X Y Z"]:
    """Tell which voxels of an image a mask ignores: by its nearest voxel, and none beyond its grid."""
    return np.asarray(ignore.nearest(image.grid_points()) != 0)


def fill_ignored(image: Image, ignore: Image | None) -> Image:
    """The image with the intensity of the nearest voxel that is looked at wherever one is ignored.

    Smoothing, gradients and interpolation near the mask then know nothing of what lies in it. An image of which all is
    ignored stays as it is.
    """
    if ignore is None:
        return image
    ignored = ignored_voxels(image, ignore)
    if ignored.all() or not ignored.any():
        return image
    nearest = ndimage.distance_transform_edt(ignored, image.voxel_sizes, return_distances=False, return_indices=True)
    return image.with_voxels(np.asarray(image.voxels)[tuple(nearest)])
