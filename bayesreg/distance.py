"""Compute the signed distance to a forbidden region, and interpolate signed distances."""

from __future__ import annotations

from functools import lru_cache

import edt
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.types import InputError

# The distance has a gradient up to this depth in the forbidden region, which leads a node there back out, mm.
MARGIN = 16.0
# The standard deviation and the reach of the smoothing, and the least distance of a voxel centre from the surface; all
# in voxels.
_SMOOTHING, _END, _KEPT = 1.0, 4, 0.02


def forbidden(intracranial: Image) -> Image:
    """Make the image of Ω_SK, nonzero = forbidden: everything outside the intracranial mask."""
    return intracranial.with_voxels((np.asarray(intracranial.voxels) == 0).astype(np.uint8))


def signed_distance(skull: Image, margin: float = MARGIN) -> Image:
    """Compute the distance to the forbidden region Ω_SK, positive outside this region.

    Parameters
    ----------
    skull : Image
        Nonzero = forbidden. Everything outside its grid is forbidden, too.
    margin : float
        The least distance from the allowed region to the border of the result's grid, mm.

    Returns
    -------
    Image
        The distance, mm, negative in the forbidden region. Its grid is the skull's grid, extended on each side by at
        least one voxel, or by as many as the margin needs. The axes of the affine must be orthogonal.

    Raises
    ------
    InputError
        If every voxel is forbidden.

    Notes
    -----
    The surface of a voxel mask has steps, whose corners stop a node that slides along it. The distance is therefore
    smoothed by one voxel, but every voxel centre stays on its own side (Whitaker 2000, "Reducing aliasing artifacts in
    iso-surfaces of binary volumes"), so that sheets and ridges of one voxel remain. If the surface is flat and parallel
    to the grid, its trilinear zero level lies half-way between allowed and forbidden voxel centres.
    """
    allowed = np.asarray(skull.voxels) == 0
    if not allowed.any():
        raise InputError("the skull image forbids every voxel: nonzero means forbidden, zero allowed")
    box, border = ndimage.find_objects(allowed.astype(np.uint8))[0], np.ceil(margin / skull.voxel_sizes).astype(int)
    before = np.maximum(border - [extent.start for extent in box], 1)
    after = np.maximum(border - np.subtract(allowed.shape, [extent.stop for extent in box]), 1)
    width = [(low + _END, high + _END) for low, high in zip(before, after, strict=True)]
    allowed = np.pad(allowed, width, constant_values=False)
    half = skull.voxel_sizes.min() / 2
    distance = edt.sdf(allowed, anisotropy=tuple(skull.voxel_sizes))
    distance -= np.copysign(half, distance, dtype=distance.dtype)
    distance = ndimage.gaussian_filter(distance, _SMOOTHING, output=float, mode="nearest", truncate=_END)
    least_distance = _KEPT * skull.voxel_sizes.min()
    np.maximum(distance, least_distance, out=distance, where=allowed)
    np.minimum(distance, -least_distance, out=distance, where=~allowed)
    affine = skull.affine.copy()
    affine[:3, 3] = skull.voxel_to_world(-before.astype(float))
    distance = distance[(slice(_END, -_END),) * 3]
    distance.flags.writeable = False
    return Image(distance, affine)


def distance_at(distance: Image, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
    """Interpolate a signed distance at world points, mm."""
    index = np.moveaxis(distance.world_to_voxel(points), -1, 0)
    return ndimage.map_coordinates(np.asarray(distance.voxels), index, order=1, mode="nearest")


def slope_at(distance: Image, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Compute its gradient by central differences over two voxels, which smooths the kinks of a voxelwise distance."""
    step = distance.voxel_sizes.max() * np.eye(3)
    ahead, behind = (np.stack([distance_at(distance, points + sign * e) for e in step], axis=-1) for sign in (1, -1))
    return (ahead - behind) / (2 * step[0, 0])


# A synthetic pair and its posterior need the same distance.
shared_distance = lru_cache(maxsize=1)(signed_distance)
