"""A region without what a mesh cannot show: thin parts and bridges, and voxels that touch at edges or corners alone."""

from __future__ import annotations

import logging
from itertools import product

import edt
import numpy as np
from jaxtyping import Bool, Int
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.io.domain import MeshError, fill_holes, largest_part, millilitres, place
from bayesreg.io.surfaces import smoothed_region

# A sheet that is thinner vanishes when the region is smoothed for its surface; in edge lengths.
THICKNESS = 0.3
# What lies farther from the smoothed region is lost; in edge lengths. The corner of a box lies 0.31 away.
REACH = 0.45
# No more than the first share of a region may be lost; what is less than the second one is not told.
MOST, TOLD = 0.1, 0.001

_log = logging.getLogger(__name__)


def resolved(domain: Image, edge_length: float) -> Image:
    """Leave out of the region Ω what a mesh cannot show; the log tells it in ml.

    Parameters
    ----------
    domain : Image
        Nonzero in Ω.
    edge_length : float
        That of the mesh, mm.

    Returns
    -------
    Image
        uint8, 1 inside.

    Raises
    ------
    MeshError
        If more than a tenth of Ω would be lost: it is too thin, or hangs together by thin bridges alone.
    """
    before, after = np.asarray(domain.voxels) != 0, simplified(domain, edge_length)
    lost, share = before & ~after, np.count_nonzero(before & ~after) / np.count_nonzero(before)
    if share > MOST:
        raise MeshError(
            f"{millilitres(domain, lost)} of the {millilitres(domain, before)} of the region to mesh, "
            f"{place(domain, lost)}, are thinner than {THICKNESS * edge_length:.2g} mm or hang on such parts, which no "
            f"mesh with edges of {edge_length:.3g} mm shows; choose a shorter mesh.edge_length, or give labels of one "
            "solid body"
        )
    if share > TOLD:
        _log.warning(
            "%s of the region to mesh left out, %s, which are thinner than %.2g mm or hang on such parts",
            millilitres(domain, lost), place(domain, lost), THICKNESS * edge_length,
        )  # fmt: skip
    return domain.with_voxels(after.astype(np.uint8))


def simplified(domain: Image, edge_length: float) -> Bool[np.ndarray, "X Y Z"]:
    """Keep of a region what lies near the largest part of the smoothed region, whose surface is meshed.

    Of the result no two voxels touch at an edge or a corner alone.
    """
    field = smoothed_region(domain, edge_length)
    shown = np.asarray(field.voxels) > 0.5
    if not shown.any():
        return np.zeros(domain.shape, bool)
    distance = edt.edt(~largest_part(shown), anisotropy=tuple(field.voxel_sizes))
    between = field.to_voxel @ domain.affine
    near = ndimage.affine_transform(
        distance, between[:3, :3], between[:3, 3], domain.shape, order=1, mode="constant", cval=np.inf
    )
    kept = (np.asarray(domain.voxels) != 0) & (near <= REACH * edge_length)
    return well_composed(fill_holes(largest_part(kept)))


def well_composed(mask: Bool[np.ndarray, "X Y Z"]) -> Bool[np.ndarray, "X Y Z"]:
    """Add voxels to a mask until no two of its voxels, or of the empty ones, touch at an edge or a corner alone.

    Of the empty voxels of such a block, the one with most neighbours in the mask is added.

    References
    ----------
    Latecki, "3D well-composed pictures", 1997. Siqueira, Latecki, Tustison, Gallier, Gee, "Topological repairing of 3D
    digital images", 2008.
    """
    mask = mask.copy()
    while any(map(len, blocks := critical_blocks(mask))):
        neighbours = ndimage.uniform_filter(mask.astype(np.float32), 3, mode="constant")
        neighbours[mask] = -1
        for corners in blocks:
            best = neighbours[tuple(np.moveaxis(corners, -1, 0))].argmax(axis=1)
            mask[tuple(corners[np.arange(len(best)), best].T)] = True
    return mask


def critical_blocks(mask: Bool[np.ndarray, "X Y Z"]) -> list[Int[np.ndarray, "blocks corners 3"]]:
    """Find the blocks of 2 × 2 voxels in each plane, and of 2 × 2 × 2, of which two opposite ones differ from the rest.

    Returns
    -------
    list of (k, 4, 3) or (k, 8, 3) arrays
        The indices of the voxels of every block.
    """
    blocks = []
    for axes in ((0, 1), (0, 2), (1, 2), (0, 1, 2)):
        corners = np.array(list(product((0, 1), repeat=len(axes))))
        offsets = np.zeros((len(corners), 3), int)
        offsets[:, axes] = corners
        last = len(offsets) - 1
        extent = np.array(mask.shape) - offsets[last]
        code = np.zeros(extent, np.uint8)
        for bit, offset in enumerate(offsets):
            code |= mask[tuple(slice(o, o + n) for o, n in zip(offset, extent, strict=True))].astype(np.uint8) << bit
        pairs = [1 << bit | 1 << last - bit for bit in range(len(offsets) // 2)]
        critical = np.isin(code, [*pairs, *(2 ** len(offsets) - 1 - pair for pair in pairs)])
        blocks.append(np.argwhere(critical)[:, None] + offsets)
    return blocks
