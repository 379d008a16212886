"""Represent the skull as a smooth obstacle, for bodies that slide along it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from bayesreg.distance import MARGIN, shared_distance
from bayesreg.image import Image

# The distance has a gradient up to this depth in the skull, which leads a node there back out, mm.
_REACH = 10.0


class SmoothObstacle:
    """The smoothed signed distance to the skull, twice continuously differentiable.

    The surface of a voxel mask has steps, which stop a node that slides along it. The smoothed distance has no steps,
    but its error is as large as their height; `distance` gives the exact value.

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
        # The distance must reach further than the Gaussian, which changes the values near the end of the distance.
        self.exact = shared_distance(skull, max(MARGIN, 3 * smoothing_mm + _REACH))
        smooth = ndimage.gaussian_filter(self.exact.voxels, smoothing_mm / self.exact.voxel_sizes, mode="nearest")
        coefficients = ndimage.spline_filter(smooth, order=3, mode="mirror", output=float)
        self._coefficients = np.pad(coefficients, [(1, 2)] * 3, mode="reflect")

    def distance(self, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k"]:
        """Compute the exact signed distance (trilinear), mm; outside the grid, the nearest value."""
        indices = self.exact.world_to_voxel(points)
        return ndimage.map_coordinates(self.exact.voxels, indices.T, order=1, mode="nearest")

    def __call__(self, points: Float[np.ndarray, "k 3"]) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k 3"]]:
        """Compute the smoothed signed distance (cubic B-spline), mm, and its gradient in world space."""
        indices = np.clip(self.exact.world_to_voxel(points), 0, np.array(self.exact.shape) - 1.0)
        corner = np.floor(indices).astype(int)
        taps = corner[:, :, None] + np.arange(4)
        block = self._coefficients[taps[:, 0, :, None, None], taps[:, 1, None, :, None], taps[:, 2, None, None, :]]
        value, slope = _bspline(indices - corner)
        along = [[slope if axis == component else value for axis in range(3)] for component in range(3)]
        gradient = [np.einsum("kabc,ka,kb,kc->k", block, *(w[:, i] for i, w in enumerate(ws))) for ws in along]
        gap = np.einsum("kabc,ka,kb,kc->k", block, *np.moveaxis(value, 1, 0))
        return gap, np.stack(gradient, axis=1) @ self.exact.to_voxel[:3, :3]


def _bspline(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the weights of the four cubic B-splines around a point, and their derivatives; 0 ≤ t < 1."""
    s = 1 - t
    value = [s**3 / 6, 2 / 3 - t**2 * (2 - t) / 2, 2 / 3 - s**2 * (2 - s) / 2, t**3 / 6]
    slope = [-(s**2) / 2, t * (3 * t - 4) / 2, s * (4 - 3 * s) / 2, t**2 / 2]
    return np.stack(value, axis=-1), np.stack(slope, axis=-1)
