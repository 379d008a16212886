"""The skull as a smooth obstacle, for bodies that slide along it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from bayesreg.distance import MARGIN, shared_distance
from bayesreg.image import Image

# How far off what is allowed the distance still grows, so that a body that has strayed there is led back, mm.
_REACH = 10.0


class SmoothObstacle:
    """Signed distance to the skull, smoothed: twice continuously differentiable.

    The surface of a voxel mask is a staircase; a node that slides along it is caught on every step. The
    smoothed distance has no steps, but is wrong by their height: `distance` tells the exact one.

    Parameters
    ----------
    skull : Image
        Nonzero = forbidden.
    smoothing_mm : float
        Standard deviation of the Gaussian.

    Attributes
    ----------
    exact : Image
        The signed distance itself (`bayesreg.distance.signed_distance`), mm.
    """

    def __init__(self, skull: Image, smoothing_mm: float) -> None:
        # The smoothing is another one where the distance ends.
        self.exact = shared_distance(skull, max(MARGIN, 3 * smoothing_mm + _REACH))
        smooth = ndimage.gaussian_filter(self.exact.voxels, smoothing_mm / self.exact.voxel_sizes, mode="nearest")
        coefficients = ndimage.spline_filter(smooth, order=3, mode="mirror", output=float)
        self._coefficients = np.pad(coefficients, [(1, 2)] * 3, mode="reflect")

    def distance(self, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k"]:
        """Exact signed distance (trilinear), mm; nearest value off the grid."""
        indices = self.exact.world_to_voxel(points)
        return ndimage.map_coordinates(self.exact.voxels, indices.T, order=1, mode="nearest")

    def __call__(self, points: Float[np.ndarray, "k 3"]) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k 3"]]:
        """Smoothed signed distance (cubic B-spline), mm, and its gradient in world space."""
        indices = np.clip(self.exact.world_to_voxel(points), 0, np.array(self.exact.shape) - 1.0)
        corner = np.floor(indices).astype(int)
        taps = corner[:, :, None] + np.arange(4)
        block = self._coefficients[taps[:, 0, :, None, None], taps[:, 1, None, :, None], taps[:, 2, None, None, :]]
        value, slope = _bspline(indices - corner)
        along = [[slope if axis == part else value for axis in range(3)] for part in range(3)]
        gradient = [np.einsum("kabc,ka,kb,kc->k", block, *(w[:, i] for i, w in enumerate(ws))) for ws in along]
        gap = np.einsum("kabc,ka,kb,kc->k", block, *np.moveaxis(value, 1, 0))
        return gap, np.stack(gradient, axis=1) @ self.exact.to_voxel[:3, :3]


def _bspline(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the four cubic B-splines around a point, and their derivatives; 0 ≤ t < 1."""
    s = 1 - t
    value = [s**3 / 6, 2 / 3 - t**2 * (2 - t) / 2, 2 / 3 - s**2 * (2 - s) / 2, t**3 / 6]
    slope = [-(s**2) / 2, t * (3 * t - 4) / 2, s * (4 - 3 * s) / 2, t**2 / 2]
    return np.stack(value, axis=-1), np.stack(slope, axis=-1)
