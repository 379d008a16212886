"""Self-similarity of an image, for pairs of unlike contrast: the differences of a point from its neighbours.

Tissues change their brightness from one contrast to another, but their borders stay in place. The descriptor of
Heinrich et al. 2012, "MIND: modality independent neighbourhood descriptor for multi-modal deformable registration", has
one value for each of six neighbours at x ± d along the axes of the fixed image, where d is the voxel size of the
coarser image,

MIND_r(x) = exp(−(D_r(x) − min_s D_s(x)) / V(x)),    D_r = G * (I(x) − I(x + r))²,

with a Gaussian patch G and V the mean of the D_r. It lies between 0 and 1, and a + b I has the same descriptor as I.
The six descriptors are images, which are compared by squared differences: their noise is Gaussian with one variance,
which T_s determines.

The likelihood uses one neighbour at every quadrature point, each neighbour in turn. Six values at one point would be
strongly dependent, and cost six times as much.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.interpolation import Interpolator
from bayesreg.model.observations.images.pointwise import Intensities, SimilaritySettings, SumOfSquaredDifferences
from bayesreg.types import AnyArray

# Standard deviation of the patch, as a share of the distance between neighbours, as in the paper.
PATCH = 0.5
# The smallest V, as a share of its mean over the grid: it prevents an amplification of noise in uniform regions.
LEAST = 1e-3


def describe_self_similarity(
    image: Image, axes: Float[np.ndarray, "3 3"], distance: float
) -> tuple[Image, Image, Image, Image, Image, Image]:
    """Compute the six descriptors of an image, on its grid.

    Parameters
    ----------
    image : Image
    axes : (3, 3) array
        Directions of the neighbours, in world RAS, one in each column.
    distance : float
        Distance to the neighbours, mm.
    """
    voxels = np.asarray(image.voxels, float)
    shifts = [way * distance * axis for axis in axes.T for way in (1, -1)]
    # SciPy's filters let other threads run.
    with ThreadPoolExecutor() as pool:
        distances = list(pool.map(partial(_patch_distance, image, voxels, PATCH * distance), shifts))
    variance = np.mean(distances, axis=0)
    variance = np.maximum(variance, LEAST * variance.mean() or 1.0)
    least = np.min(distances, axis=0)
    plus_first, minus_first, plus_second, minus_second, plus_third, minus_third = (
        image.with_voxels(np.exp((least - patch_distance) / variance).astype(np.float32))
        for patch_distance in distances
    )
    return plus_first, minus_first, plus_second, minus_second, plus_third, minus_third


def _patch_distance(image: Image, voxels: np.ndarray, sd: float, shift: np.ndarray) -> np.ndarray:
    """Compute D_r(x) with r a shift, mm; beyond its grid the image continues with its nearest value."""
    shifted = ndimage.shift(voxels, -(image.to_voxel[:3, :3] @ shift), order=1, mode="nearest")
    return np.asarray(ndimage.gaussian_filter((voxels - shifted) ** 2, sd / image.voxel_sizes))


class AlternatingImages(NamedTuple):
    """Several images as one function of places: point q uses image q modulo their number (a pytree).

    Attributes
    ----------
    images : Interpolator
        All images in one; the images are the leading axis of its arrays.
    """

    images: Interpolator

    @classmethod
    def of(cls, images: list[Interpolator]) -> AlternatingImages:
        """Combine these images; their grids have one shape."""
        return cls(jax.tree.map(lambda *arrays: jnp.stack(arrays), *images))

    def __call__(self, points: Float[AnyArray, "points 3"]) -> Float[AnyArray, "points"]:
        """Return the values at world points, mm; all points must be given, in their order."""
        count, images = len(points), len(self.images.to_voxel)
        turns = -(-count // images)
        filled = jnp.pad(points, ((0, turns * images - count), (0, 0)), mode="edge").reshape(turns, images, 3)
        values = jax.lax.map(
            lambda image_and_points: image_and_points[0](image_and_points[1]), (self.images, jnp.moveaxis(filled, 1, 0))
        )
        return values.T.reshape(-1)[:count]


class SelfSimilarity(SimilaritySettings):
    """Squared differences of self-similarity descriptors, for unlike contrasts."""

    serves_any_contrast = compares_descriptors = True
    formula = (
        "∫ (MIND<sub>r</sub>(<var>f</var>) − MIND<sub>r</sub>(<var>m</var>)(<var>x</var> + <var>u</var>))² "
        "d<var>x</var>, by quadrature over the mesh, whose points look at one neighbour <var>r</var> each"
    )
    residual = "a descriptor of f less that of m, of what a place looks like beside its neighbours"

    kind: Literal["mind"] = "mind"

    def on(
        self, positions: Float[np.ndarray, "points 3"], rest: Intensities, fixed: Interpolator, blur: float = 0.0
    ) -> SumOfSquaredDifferences:
        """Make the similarity at these points; see `AnySimilarity`."""
        return SumOfSquaredDifferences()
