"""Signed distance to a forbidden region."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial

import numpy as np
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.types import InputError

# Wide enough to lead back a body that has strayed from what is allowed, mm.
MARGIN = 16.0
# Of the smoothing, voxels: its standard deviation, where it ends, and what is left of a voxel centre's own side.
_SMOOTHING, _END, _KEPT = 1.0, 4, 0.02


def signed_distance(skull: Image, margin: float = MARGIN) -> Image:
    """Distance to the forbidden region Ω_SK, positive outside it.

    Parameters
    ----------
    skull : Image
        Nonzero = forbidden. All that lies off its grid is forbidden too.
    margin : float
        How far from all that is allowed the distance is still told, mm, rounded up to whole voxels.

    Returns
    -------
    Image
        mm, negative where forbidden, on the part of the skull's grid, or of its continuation, that holds what is
        allowed and the margin; for affines whose axes are orthogonal.

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
    return _signed_distance(skull, float(margin))


# A synthetic pair and the posterior ask for the same one.
@lru_cache(maxsize=2)
def _signed_distance(skull: Image, margin: float) -> Image:
    allowed = np.asarray(skull.voxels) == 0
    if not allowed.any():
        raise InputError("the skull image forbids every voxel: nonzero means forbidden, zero allowed")
    box = ndimage.find_objects(allowed.astype(np.uint8))[0]
    border = np.ceil(margin / skull.voxel_sizes).astype(int)
    allowed = np.pad(allowed[box], [(n + _END, n + _END) for n in border], constant_values=False)
    half = skull.voxel_sizes.min() / 2
    distance_to_zero = partial(ndimage.distance_transform_edt, sampling=skull.voxel_sizes)
    # SciPy lets other threads run.
    with ThreadPoolExecutor() as pool:
        inside, outside = pool.map(distance_to_zero, (allowed, ~allowed))
    smooth = np.where(allowed, inside - half, half - outside)
    smooth = ndimage.gaussian_filter(smooth, _SMOOTHING, mode="nearest", truncate=_END)
    kept = _KEPT * skull.voxel_sizes.min()
    distance = np.where(allowed, np.maximum(smooth, kept), np.minimum(smooth, -kept))
    affine = skull.affine.copy()
    affine[:3, 3] = skull.voxel_to_world(np.array([part.start for part in box], float) - border)
    return Image(distance[(slice(_END, -_END),) * 3], affine)
