"""The hard skull constraint: where the sampled nodes may be."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from bayesreg.image import Image, Interpolator
from bayesreg.types import AnyArray


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
        raise ValueError("the skull image forbids every voxel: nonzero means forbidden, zero allowed")
    half = skull.voxel_sizes.min() / 2
    inside = ndimage.distance_transform_edt(allowed, sampling=skull.voxel_sizes) - half
    outside = ndimage.distance_transform_edt(~allowed, sampling=skull.voxel_sizes) - half
    affine = skull.affine.copy()
    affine[:3, 3] = skull.voxel_to_world(np.array([-1.0, -1.0, -1.0]))
    return Image(np.where(allowed, inside, -outside), affine)


def is_allowed(
    distance: Interpolator, points: Float[AnyArray, "nodes 3"]
) -> Bool[AnyArray, "nodes"]:
    """Which points (world, mm) lie outside Ω_SK, by the signed distance."""
    return distance(points) >= 0
