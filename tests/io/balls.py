"""A brain of three nested balls, and the labels of a mesh."""

import numpy as np
from scipy.spatial.transform import Rotation

from bayesreg.image import Image

CENTRE = np.array([5.0, -3.0, 8.0])
RADII = {"csf": 12.0, "wm": 26.0, "gm": 36.0, "skull": 38.0}


def grid(sizes=(2.0, 2.0, 2.0), angles=(0.0, 0.0, 0.0), flip=False, extent=84.0):
    """Empty image about CENTRE."""
    shape = np.ceil(extent / np.array(sizes)).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix() * sizes
    affine[:3, 0] *= -1 if flip else 1
    affine[:3, 3] = CENTRE - affine[:3, :3] @ ((shape - 1) / 2)
    return Image(np.zeros(shape, np.int8), affine)


def offset_from_centre(image):
    return np.moveaxis(image.grid_points() - CENTRE, -1, 0)


def balls(image):
    """A ball of CSF in a ball of WM in a ball of GM, inside a skull."""
    distance = np.linalg.norm(offset_from_centre(image), axis=0)
    tissue = np.select([distance < RADII[name] for name in ("csf", "wm", "gm")], [1, 3, 2], 0)
    return image.with_voxels(tissue.astype(np.int8)), image.with_voxels((distance < RADII["skull"]).astype(np.uint8))


def volume_of(image, value):
    return np.count_nonzero(image.voxels == value) * image.voxel_volume
