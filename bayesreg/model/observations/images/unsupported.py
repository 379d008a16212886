"""Places where the images do not support the displacement: what is not compared, and what does not fit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.model.observations.observation import MAPS
from bayesreg.printable import place_text

# The map has voxels of this side, mm, and is smoothed by a Gaussian of this sd, mm.
STEP, SMOOTHING = 3.0, 3.0
# Residuals, in units of the scale of the noise, are cut at this size, so that a few outliers do not mark a place.
LARGEST = 4.0
# A place does not fit where the smoothed residual is greater. That of noise with heavy tails is about 0.15 there.
MISFIT = 1.5
# It is not compared where the smoothed share of comparison is smaller.
COMPARED = 0.5
# The organ is where the smoothed number of points is greater than this share of that at its median point.
INSIDE = 0.4
# Smaller regions are not named, ml; nor is a smaller share of the organ that is not compared.
LEAST_MISFIT, LEAST_UNSEEN = 1.0, 0.02
# Values of the map: beyond the organ, where the images support the displacement, and where they are not compared. The
# regions of misfit have the next numbers, the largest first.
BEYOND, SUPPORTED, NOT_COMPARED = 0, 1, 2


class Points(NamedTuple):
    """All quadrature points of the organ.

    Attributes
    ----------
    positions : (q, 3) array
        mm.
    residual : (q,) array
        In units of the scale of the noise; zero where nothing is compared.
    share : (q,) array
        The share of each point that is compared, from 0 to 1.
    volumes : (q,) array
        mm³.
    """

    positions: Float[np.ndarray, "points 3"]
    residual: Float[np.ndarray, "points"]
    share: Float[np.ndarray, "points"]
    volumes: Float[np.ndarray, "points"]

    @classmethod
    def where(
        cls,
        seen: Bool[np.ndarray, "points"],
        positions: Float[np.ndarray, "points 3"],
        residual: Float[np.ndarray, "seen"],
        share: Float[np.ndarray, "seen"],
        volumes: Float[np.ndarray, "points"],
    ) -> Points:
        """Make the points from the residuals and the shares of those that are seen; the others are not compared."""
        residuals, shares = np.zeros((2, len(seen)))
        residuals[seen], shares[seen] = residual, share
        return cls(positions, residuals, shares, volumes)


def find_unsupported(points: Points) -> dict[str, np.ndarray]:
    """Find the connected regions where nothing is compared, or where the residual has one sign over many points.

    Returns
    -------
    dict
        support : (X, Y, Z) int array
            The map, see `BEYOND`.
        support_affine : (4, 4) array
            Voxel to world RAS, mm.
        regions : (k, 5) array
            For each value of the map from `NOT_COMPARED` on: volume in ml, centre in mm, mean residual of the region.
            The first row is that of the largest region that is not compared.
        unseen : float
            The share of the organ that is not compared.
    """
    low = points.positions.min(axis=0) - STEP
    voxels = tuple(np.floor((points.positions - low) / STEP).astype(int).T)
    shape = tuple(int(index.max()) + 2 for index in voxels)
    residual = np.clip(points.residual, -LARGEST, LARGEST)
    weights = points.volumes / points.volumes.mean()
    count, of_residual, of_share = (
        _smoothed_sum(voxels, weights * values, shape) for values in (np.ones_like(residual), residual, points.share)
    )
    organ = count > INSIDE * np.median(count[voxels])
    count = np.where(organ, count, 1.0)
    misfit, unseen = of_residual / count, organ & (of_share / count < COMPARED)

    def figures(region: np.ndarray) -> list[float]:
        chosen = region[voxels]
        volume = points.volumes[chosen].sum() / 1e3
        return [volume, *points.positions[chosen].mean(axis=0), residual[chosen].mean()]

    def regions_of(mask: np.ndarray) -> list[tuple[list[float], np.ndarray]]:
        found = [(figures(region), region) for region in _connected(mask) if region[voxels].any()]
        return sorted(found, key=lambda region: -region[0][0])

    hidden = regions_of(unseen)
    misfits = regions_of(organ & ~unseen & (misfit > MISFIT)) + regions_of(organ & ~unseen & (misfit < -MISFIT))
    misfits = sorted((region for region in misfits if region[0][0] > LEAST_MISFIT), key=lambda region: -region[0][0])
    support = np.where(unseen, NOT_COMPARED, np.where(organ, SUPPORTED, BEYOND))
    for number, (_, region) in enumerate(misfits):
        support[region] = NOT_COMPARED + 1 + number
    affine = np.diag([STEP, STEP, STEP, 1.0])
    affine[:3, 3] = low + STEP / 2
    rows = [hidden[0][0] if hidden else [0.0] * 5, *(row for row, _ in misfits)]
    return {
        "support": support.astype(np.int16),
        "support_affine": affine,
        "regions": np.array(rows),
        "unseen": np.array(1 - np.average(points.share, weights=points.volumes)),
    }


def explain_unsupported(summary: Mapping[str, np.ndarray], name: str = "images") -> list[str]:
    """Write a sentence on what is not compared, and one on the regions of misfit."""
    sentences = []
    (_, *centre, _), *misfits = summary["regions"]
    if (unseen := float(summary["unseen"])) > LEAST_UNSEEN:
        sentences.append(
            f"{unseen:.0%} of the organ, most of it about {place_text(centre)}, is ignored or lies beyond the moving "
            f"image{_of(name)}: only the prior and other data say how it moved."
        )
    if misfits:
        regions = ", ".join(f"{volume:.2g} ml about {place_text(centre)}" for volume, *centre, _ in misfits[:3])
        more = f" and {len(misfits) - 3} smaller ones" if len(misfits) > 3 else ""
        sentences.append(
            f"The images{_of(name)} do not match at {regions}{more}: is tissue gone there, or new? If so, the "
            "displacement near it is not to be trusted; run again with --moving-ignore "
            f"{misfit_file(name)}, which marks {'it' if len(misfits) == 1 else 'them'} in the moving image."
        )
    return sentences


def misfit_file(name: str) -> str:
    """Return the name of the file with the mask of misfit of a pair of images."""
    return f"{MAPS}/misfit{'' if name == 'images' else '_' + name}.nii.gz"


def support_file(name: str) -> str:
    """Return the name of the file with the map of the support of a pair of images."""
    return f"{MAPS}/support{'' if name == 'images' else '_' + name}.nii.gz"


def mark_places(places: Float[np.ndarray, "points 3"], grid: Image) -> Image:
    """Mark the voxels of a grid around some places, mm, which are a sample of the voxels of a region."""
    voxels = np.rint(grid.world_to_voxel(places)).astype(int)
    on_grid = ((voxels >= 0) & (voxels < grid.shape)).all(axis=1)
    marked = np.zeros(grid.shape, bool)
    marked[tuple(voxels[on_grid].T)] = True
    # The dilation fills what lies between the places; the smaller erosion leaves a margin, which a sample misses.
    # A voxel's border is half a voxel from its centre.
    margin = STEP / 2 + grid.voxel_sizes.max() / 2
    near = ndimage.distance_transform_edt(~marked, sampling=grid.voxel_sizes) <= STEP
    closed = near & (ndimage.distance_transform_edt(near, sampling=grid.voxel_sizes) > margin)
    return grid.with_voxels((closed | marked).astype(np.uint8))


def support_at(
    summary: Mapping[str, np.ndarray], positions: Float[np.ndarray, "points 3"]
) -> Int[np.ndarray, "points"]:
    """Return the value of the map at some points, mm."""
    support, affine = np.asarray(summary["support"]), np.asarray(summary["support_affine"])
    voxels = np.rint((positions - affine[:3, 3]) / np.diag(affine)[:3]).astype(int)
    within = ((voxels >= 0) & (voxels < support.shape)).all(axis=1)
    return np.where(within, support[tuple(np.where(within[:, None], voxels, 0).T)], BEYOND)


def _smoothed_sum(voxels: tuple[np.ndarray, ...], values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    total = np.zeros(shape)
    np.add.at(total, voxels, values)
    return ndimage.gaussian_filter(total, SMOOTHING / STEP, mode="constant")


def _connected(mask: np.ndarray) -> list[np.ndarray]:
    labels, count = ndimage.label(mask)
    return [labels == number for number in range(1, count + 1)]


def _of(name: str) -> str:
    return "" if name == "images" else f" of {name!r}"
