"""Signed distance to a forbidden region."""

from __future__ import annotations

from functools import lru_cache

import edt
import numpy as np
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.types import InputError

# Wide enough to lead back a body that has strayed from what is allowed, mm.
MARGIN = 16.0
# The smoothing: its standard deviation and its reach, voxels, and the least distance, voxels, of a voxel centre from
# the surface.
_SMOOTHING, _END, _KEPT = 1.0, 4, 0.02


def forbidden(intracranial: Image) -> Image:
    """Ω_SK, nonzero = forbidden: everything outside the intracranial mask."""
    return intracranial.with_voxels((np.asarray(intracranial.voxels) == 0).astype(np.uint8))


def signed_distance(skull: Image, margin: float = MARGIN) -> Image:
    """Distance to the forbidden region Ω_SK, positive outside it.

    Parameters
    ----------
    skull : Image
        Nonzero = forbidden. All that lies off its grid is forbidden too.
    margin : float
        How far from all that is allowed the distance is told at least, mm.

    Returns
    -------
    Image
        mm, negative where forbidden, on the skull's grid with one voxel more on each side, or as many as the margin
        asks for; for affines whose axes are orthogonal.

    Raises
    ------
    InputError
        If every voxel is forbidden.

    Notes
    -----
    The surface of a voxel mask is a staircase, in whose corners a node that slides along it is caught. The distance
    is therefore smoothed by one voxel, but so that every voxel centre stays on its own side (Whitaker 2000, "Reducing
    aliasing artifacts in iso-surfaces of binary volumes"): sheets and ridges of one voxel remain. Where the surface is
    flat and along the grid, its trilinear zero level runs half-way between allowed and forbidden voxel centres.
    """
    allowed = np.asarray(skull.voxels) == 0
    if not allowed.any():
        raise InputError("the skull image forbids every voxel: nonzero means forbidden, zero allowed")
    box, border = ndimage.find_objects(allowed.astype(np.uint8))[0], np.ceil(margin / skull.voxel_sizes).astype(int)
    before = np.maximum(border - [part.start for part in box], 1)
    after = np.maximum(border - np.subtract(allowed.shape, [part.stop for part in box]), 1)
    width = [(low + _END, high + _END) for low, high in zip(before, after, strict=True)]
    allowed = np.pad(allowed, width, constant_values=False)
    half = skull.voxel_sizes.min() / 2
    distance = edt.sdf(allowed, anisotropy=tuple(skull.voxel_sizes))
    distance -= np.copysign(half, distance, dtype=distance.dtype)
    distance = ndimage.gaussian_filter(distance, _SMOOTHING, output=float, mode="nearest", truncate=_END)
    kept = _KEPT * skull.voxel_sizes.min()
    np.maximum(distance, kept, out=distance, where=allowed)
    np.minimum(distance, -kept, out=distance, where=~allowed)
    affine = skull.affine.copy()
    affine[:3, 3] = skull.voxel_to_world(-before.astype(float))
    distance = distance[(slice(_END, -_END),) * 3]
    distance.flags.writeable = False
    return Image(distance, affine)


# For a synthetic pair and its posterior, which ask for the same one.
shared_distance = lru_cache(maxsize=1)(signed_distance)
