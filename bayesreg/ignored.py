"""Find the voxels of an image that say nothing: those that a mask ignores, and the filling around what was seen."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from bayesreg.image import Image

# The filling of a grid is found if it has at least this share of the voxels on the faces of the grid.
LEAST = 0.05


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


def find_filling(image: Image) -> Bool[np.ndarray, "X Y Z"]:
    """Mark the voxels that fill the grid around what the scanner saw, such as the outside of an ultrasound's wedge.

    Measured intensities vary from voxel to voxel. The filling has one value, the most frequent one on the faces of the
    grid, and is connected to a face. A background that a program has set to zero, as around a brain without its skull,
    is marked, too.
    """
    voxels = np.asarray(image.voxels)
    on_face = np.ones(voxels.shape, bool)
    on_face[1:-1, 1:-1, 1:-1] = False
    values, counts = np.unique(voxels[on_face], return_counts=True)
    if counts.max() < LEAST * on_face.sum():
        return np.zeros(voxels.shape, bool)
    # A film of voxels that are equal by chance, as in the rounded noise of air, vanishes; the filling is thicker.
    alike = voxels == values[counts.argmax()]
    core = ndimage.binary_erosion(alike, ndimage.generate_binary_structure(3, 3), border_value=1)
    components, _ = ndimage.label(ndimage.binary_propagation(core, mask=alike))
    reaching = np.unique(components[on_face])
    return np.isin(components, reaching[reaching > 0])
