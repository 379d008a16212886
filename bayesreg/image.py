"""Represent 3D images in world space (RAS, mm)."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from bayesreg.interpolation import Interpolation, Interpolator
from bayesreg.types import AnyArray, InputError

# Two axes are orthogonal if the absolute cosine of their angle is smaller.
RIGHT_ANGLE = 1e-4


@dataclass(frozen=True, eq=False)
class Image:
    """A 3D image on a regular grid in world space.

    Parameters
    ----------
    voxels : (X, Y, Z) array
        Finite values; any real or integer type.
    affine : (4, 4) array
        Maps voxel indices to world RAS, mm. It must be invertible; any orientation is allowed, also anisotropic or
        left-handed.

    Raises
    ------
    ValueError
        If the voxels are not 3D, are empty or not finite, or the affine is not an invertible 4 × 4 affine.
    """

    voxels: AnyArray
    affine: AnyArray

    def __post_init__(self) -> None:
        voxels, affine = np.asarray(self.voxels), np.asarray(self.affine, float)
        if voxels.ndim != 3 or voxels.size == 0:
            raise InputError(f"an image is a non-empty 3D array (X, Y, Z); got shape {voxels.shape}")
        if voxels.dtype.kind not in "biuf":
            raise InputError(f"the voxels of an image are real numbers; got {voxels.dtype}")
        if affine.shape != (4, 4) or not np.isfinite(affine).all() or not np.allclose(affine[3], (0, 0, 0, 1)):
            raise InputError(f"an affine is a finite 4 × 4 matrix with last row 0 0 0 1; got {affine.tolist()}")
        if np.linalg.cond(affine[:3, :3]) > 1e8:
            raise InputError(f"the affine is singular (no inverse from world to voxel): {affine.tolist()}")
        if not np.isfinite(voxels).all():
            count = int(np.count_nonzero(~np.isfinite(voxels)))
            raise InputError(f"{count} voxels are NaN or infinite; replace them before the registration")
        object.__setattr__(self, "voxels", voxels)
        object.__setattr__(self, "affine", affine)

    @property
    def shape(self) -> tuple[int, int, int]:
        """The number of voxels along each axis."""
        return self.voxels.shape

    @cached_property
    def to_voxel(self) -> Float[np.ndarray, "4 4"]:
        """The affine from world RAS, mm, to voxel indices."""
        return np.linalg.inv(self.affine)

    @cached_property
    def voxel_sizes(self) -> Float[np.ndarray, "3"]:
        """The edge lengths of a voxel, mm."""
        return np.linalg.norm(self.affine[:3, :3], axis=0)

    @property
    def voxel_volume(self) -> float:
        """The volume of a voxel, mm³."""
        return float(abs(np.linalg.det(self.affine[:3, :3])))

    @cached_property
    def digest(self) -> str:
        """The SHA-256 digest of the voxels (as float64) and the affine."""
        arrays = (np.asarray(self.voxels, "<f8"), np.asarray(self.affine, "<f8"))
        return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()

    @cached_property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """The directions of the voxel axes, as columns; for a sheared grid, the nearest orthogonal directions."""
        left, _, right = np.linalg.svd(self.affine[:3, :3] / self.voxel_sizes)
        return left @ right

    @property
    def is_orthogonal(self) -> bool:
        """Whether the voxel axes are orthogonal, as most programs require."""
        directions = self.affine[:3, :3] / self.voxel_sizes
        return bool(np.abs(directions.T @ directions - np.eye(3)).max() < RIGHT_ANGLE)

    def on_orthogonal_grid(self, voxel_sizes: AnyArray | None = None, order: int = 1) -> Image:
        """Resample the image on an orthogonal grid that covers its grid; an orthogonal image is returned unchanged.

        Parameters
        ----------
        voxel_sizes : (3,) array, optional
            Voxel sizes of the new grid, mm; the default is those of the image. If given, the image is always resampled.
        order : int
            Order of the interpolating splines; 0 takes the nearest voxel, and zero outside the grid.
        """
        if self.is_orthogonal and voxel_sizes is None:
            return self
        sizes, axes = self.voxel_sizes if voxel_sizes is None else np.asarray(voxel_sizes), self.axes
        ends = np.stack(np.meshgrid(*((-0.5, n - 0.5) for n in self.shape), indexing="ij"), axis=-1).reshape(-1, 3)
        corners = self.voxel_to_world(ends) @ axes
        low, high = corners.min(axis=0), corners.max(axis=0)
        count = np.maximum(np.rint((high - low) / sizes).astype(int), 1)
        affine = np.eye(4)
        affine[:3, :3] = axes * sizes
        affine[:3, 3] = axes @ ((low + high) / 2 - sizes * (count - 1) / 2)
        between, mode = self.to_voxel @ affine, "nearest" if order else "constant"
        voxels = np.asarray(self.voxels, float) if order else np.asarray(self.voxels)
        matrix, offset = between[:3, :3], between[:3, 3]
        return Image(ndimage.affine_transform(voxels, matrix, offset, tuple(count), order=order, mode=mode), affine)

    def with_voxels(self, voxels: AnyArray) -> Image:
        """Return an image with other voxels on the same grid."""
        if np.shape(voxels) != self.shape:
            raise InputError(f"expected voxels of shape {self.shape}, got {np.shape(voxels)}")
        return Image(voxels, self.affine)

    def cropped(self, box: Sequence[slice]) -> Image:
        """Crop the image to a box of voxels; they keep their coordinates in the world."""
        affine = np.array(self.affine, float)
        affine[:3, 3] = self.voxel_to_world(np.array([float(along.start) for along in box]))
        return Image(np.asarray(self.voxels)[tuple(box)], affine)

    def world_to_voxel(self, points: Float[AnyArray, "*batch 3"]) -> Float[AnyArray, "*batch 3"]:
        """Convert world points (mm) to continuous voxel indices."""
        return points @ self.to_voxel[:3, :3].T + self.to_voxel[:3, 3]

    def voxel_to_world(self, indices: AnyArray) -> Float[AnyArray, "*batch 3"]:
        """Convert (continuous) voxel indices to world points (mm)."""
        return indices @ self.affine[:3, :3].T + self.affine[:3, 3]

    def grid_points(self) -> Float[np.ndarray, "X Y Z 3"]:
        """Compute the world coordinates of every voxel centre, mm."""
        x, y, z = (np.arange(n)[:, None] * self.affine[:3, axis] for axis, n in enumerate(self.shape))
        return x[:, None, None] + y[:, None] + (z + self.affine[:3, 3])

    def centres(self, numbers: Int[np.ndarray, "k"]) -> Float[np.ndarray, "k 3"]:
        """Compute the world coordinates of voxel centres, mm, from the voxels' numbers in the order of memory."""
        return self.voxel_to_world(np.stack(np.unravel_index(numbers, self.shape), axis=1).astype(float))

    def blocks(self, length: int = 500_000) -> Iterator[tuple[slice, Float[np.ndarray, "k 3"]]]:
        """Yield blocks of up to `length` voxels, in the order of memory, with their world coordinates, mm."""
        for block in slices(int(np.prod(self.shape)), length):
            yield block, self.centres(np.arange(block.start, block.stop))

    def contains(self, points: Float[AnyArray, "*batch 3"]) -> Bool[AnyArray, "*batch"]:
        """Decide which world points (mm) lie on the grid, the extent of its voxels included."""
        indices = self.world_to_voxel(points)
        return ((indices >= -0.5) & (indices <= np.array(self.shape) - 0.5)).all(axis=-1)

    def nearest(self, points: Float[AnyArray, "*batch 3"]) -> np.ndarray:
        """Return the value of the nearest voxel at world points (mm), and zero outside the grid."""
        indices = np.rint(np.asarray(self.world_to_voxel(points))).astype(int)
        on_grid = ((indices >= 0) & (indices < np.array(self.shape))).all(axis=-1)
        i, j, k = np.moveaxis(np.where(on_grid[..., None], indices, 0), -1, 0)
        values = np.asarray(self.voxels)[i, j, k]
        return np.where(on_grid, values, np.zeros_like(values))

    def smoothed(self, sd: float) -> Image:
        """Smooth the image by a Gaussian with the standard deviation `sd`, mm."""
        voxels = ndimage.gaussian_filter(np.asarray(self.voxels, float), sd / self.voxel_sizes, mode="nearest")
        return self.with_voxels(voxels)

    def interpolator(self, method: Interpolation = "linear") -> Interpolator:
        """Make a differentiable function of world coordinates from the image; see `Interpolator`."""
        voxels = np.asarray(self.voxels, float)
        if method == "cubic":
            # The padding holds the outer taps of points near the faces.
            coefficients = ndimage.spline_filter(voxels, order=3, mode="mirror", output=float)
            coefficients = _mirror(coefficients, before=1, after=2)
        elif method == "linear":
            coefficients = np.pad(voxels, [(0, 1)] * 3, mode="edge")
        else:
            raise InputError(f"interpolation is 'linear' or 'cubic', got {method!r}")
        return Interpolator(jnp.asarray(coefficients), jnp.asarray(self.to_voxel), method)

    def interpolate(
        self, points: Float[AnyArray, "*batch 3"], method: Interpolation = "linear"
    ) -> Float[AnyArray, "*batch"]:
        """Interpolate at world points (mm), with the nearest value outside the grid; differentiable in `points`."""
        return self.interpolator(method)(jnp.asarray(points, float))


def slices(count: int, length: int) -> Iterator[slice]:
    """Yield consecutive slices of at most `length` numbers that cover 0 to `count`."""
    for first in range(0, count, length):
        yield slice(first, min(first + length, count))


def _mirror(array: np.ndarray, before: int, after: int) -> np.ndarray:
    """Pad every axis by reflection about its end samples; axes of length one are repeated."""
    for axis, length in enumerate(array.shape):
        width = [(0, 0)] * array.ndim
        width[axis] = (before, after)
        array = np.pad(array, width, mode="reflect" if length > 1 else "edge")
    return array


class IntensityScale(NamedTuple):
    """The affine map of intensities that maps `low` to 0 and `high` to 1."""

    low: float
    high: float

    def __call__(self, image: Image) -> Image:
        """Rescale the intensities of an image; values outside [low, high] are not clipped to [0, 1]."""
        return image.with_voxels((np.asarray(image.voxels, float) - self.low) / (self.high - self.low))

    def undo(self, image: Image) -> Image:
        """Restore the original intensities of a rescaled image."""
        return image.with_voxels(np.asarray(image.voxels, float) * (self.high - self.low) + self.low)


def robust_scale(image: Image, mask: Bool[np.ndarray, "X Y Z"] | None = None) -> IntensityScale:
    """Compute the intensity scale that maps the 0.5 % and 99.5 % quantiles inside a mask to 0 and 1.

    Parameters
    ----------
    image : Image
    mask : (X, Y, Z) bool array, optional
        The voxels that count; the default is all voxels.

    Raises
    ------
    ValueError
        If the mask is empty or the intensities inside it are constant.
    """
    values = np.asarray(image.voxels, float)
    values = values.ravel() if mask is None else values[mask]
    if values.size == 0:
        raise InputError("the mask for the intensity scale is empty")
    low, high = np.quantile(values, (0.005, 0.995))
    if not high > low:
        raise InputError(f"the image has no contrast inside the mask: its 0.5 % and 99.5 % quantiles are both {low}")
    return IntensityScale(float(low), float(high))
