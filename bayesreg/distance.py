"""Signed distance to a forbidden region."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.types import InputError


def signed_distance(skull: Image) -> Image:
    """Distance to the forbidden region Ω_SK, positive outside it.

    Parameters
    ----------
    skull : Image
        Nonzero = forbidden. All that lies off its grid is forbidden too.

    Returns
    -------
    Image
        mm, negative where forbidden, on the skull's grid with one voxel more on each side. Its trilinear
        zero level runs half-way between allowed and forbidden voxel centres. Exact for affines whose axes
        are orthogonal.

    Raises
    ------
    ValueError
        If every voxel is forbidden.
    """
    allowed = np.pad(np.asarray(skull.voxels) == 0, 1, constant_values=False)
    if not allowed.any():
        raise InputError("the skull image forbids every voxel: nonzero means forbidden, zero allowed")
    half = skull.voxel_sizes.min() / 2
    inside = ndimage.distance_transform_edt(allowed, sampling=skull.voxel_sizes) - half
    outside = ndimage.distance_transform_edt(~allowed, sampling=skull.voxel_sizes) - half
    affine = skull.affine.copy()
    affine[:3, 3] = skull.voxel_to_world(np.array([-1.0, -1.0, -1.0]))
    return Image(np.where(allowed, inside, -outside), affine)
