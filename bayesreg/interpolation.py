"""Interpolate images, trilinearly or by cubic B-splines, with derivatives in the points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from bayesreg.columns import with_chains_as_columns
from bayesreg.types import AnyArray

Interpolation = Literal["linear", "cubic"]


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["coefficients", "to_voxel"],
    meta_fields=["method"],
)
@dataclass(frozen=True)
class Interpolator:
    """An image as a function of world coordinates; it is a pytree, for use in jitted code.

    It is differentiable in the points, but not in the coefficients, which all lanes of a `vmap` share. The method is
    trilinear (continuous, with jumps of the gradient between voxels) or cubic B-spline (twice continuously
    differentiable; `scipy.ndimage.map_coordinates` with order 3 and mode "mirror"). Outside the grid the image has the
    nearest value on the grid.

    Attributes
    ----------
    coefficients : padded (X, Y, Z) array
        Voxel values, or B-spline coefficients.
    to_voxel : (4, 4) array
        The affine from world RAS, mm, to voxel indices.
    method : {"linear", "cubic"}
    """

    coefficients: AnyArray
    to_voxel: AnyArray
    method: Interpolation

    @jax.jit
    def __call__(self, points: Float[AnyArray, "*batch 3"]) -> Float[AnyArray, "*batch"]:
        """Interpolate at world points, mm."""
        along = [points[..., axis] for axis in range(3)]
        indices = [sum(self.to_voxel[i, j] * along[j] for j in range(3)) + self.to_voxel[i, 3] for i in range(3)]
        return _interpolate(self.method, self.coefficients, *indices)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _interpolate(method: Interpolation, coefficients: AnyArray, *indices: AnyArray) -> AnyArray:
    """Sum B-splines at voxel indices, given by axis; the sum is differentiable in the indices only."""
    return _of_one_chain(_VALUES[method], coefficients, *indices)


@_interpolate.defjvp
def _interpolated_jvp(
    method: Interpolation, primals: tuple[AnyArray, ...], tangents: tuple[AnyArray, ...]
) -> tuple[AnyArray, AnyArray]:
    # Value and gradient share one reading of the taps, which is the costly part.
    value, gradient = _with_gradient(method, *primals)
    return value, sum(slope * change for slope, change in zip(gradient, tangents[1:], strict=True))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _with_gradient(
    method: Interpolation, coefficients: AnyArray, *indices: AnyArray
) -> tuple[AnyArray, tuple[AnyArray, ...]]:
    """Compute the value and its gradient in the indices, by axis."""
    return _of_one_chain(_VALUES_AND_GRADIENTS[method], coefficients, *indices)


@_with_gradient.defjvp
def _with_gradient_jvp(
    method: Interpolation, primals: tuple[AnyArray, ...], tangents: tuple[AnyArray, ...]
) -> tuple[Any, Any]:
    # Second derivatives need this rule, because functions with chains as columns have no derivative.
    looked = _in_batches(partial(_value_and_gradient_at, _SPLINES[method]))
    return jax.jvp(partial(_of_one_chain, looked, primals[0]), primals[1:], tangents[1:])


def _of_one_chain(function: Callable[..., Any], coefficients: AnyArray, *indices: AnyArray) -> Any:
    """Call a function of indices (points, chains) by axis with the indices of one chain, of any shape."""
    results = function(coefficients, *(index.reshape(-1, 1) for index in indices))
    return jax.tree.map(lambda x: x.reshape(indices[0].shape), results)


def _together() -> int:
    """Return the number of points, over all chains, in one batch: their taps fit into a CPU's cache, or fill a GPU."""
    return 2**13 if jax.default_backend() == "cpu" else 2**20


def _in_batches(at_one_point: Callable[..., Any]) -> Callable[..., Any]:
    """Turn a function of single points into one of indices (points, chains) by axis."""

    def interpolation(coefficients: AnyArray, *indices: AnyArray) -> Any:
        # The taps of all points together exceed the cache, which takes three times as long. All batches have one size,
        # filled up with zeros, because a smaller last batch would need another compilation.
        count, chains = indices[0].shape
        batches = max(-(-count * chains // _together()), 1)
        size = -(-count // batches)
        filled = [jnp.pad(i, ((0, batches * size - count), (0, 0))).reshape(batches, size * chains) for i in indices]
        results = jax.lax.map(lambda batch: jax.vmap(partial(at_one_point, coefficients))(*batch), filled)
        return jax.tree.map(lambda x: x.reshape(-1, chains)[:count], jax.lax.optimization_barrier(results))

    return interpolation


class _Spline(NamedTuple):
    """The B-splines that overlap an interval between two voxels, as functions of the coordinate in this interval.

    Attributes
    ----------
    width : int
        The number of these B-splines.
    weights, slopes : callable
        Map the coordinate to the values and the derivatives of the B-splines.
    """

    width: int
    weights: Callable[[AnyArray], tuple[AnyArray, ...]]
    slopes: Callable[[AnyArray], tuple[AnyArray, ...]]


def _value_at(spline: _Spline, coefficients: AnyArray, *index: AnyArray) -> AnyArray:
    """Compute the value at one point, by sums over its taps, one axis after the other."""
    taps, weights, _ = _taps(spline, coefficients, index)
    for weight in weights:
        taps = jax.lax.optimization_barrier(_sum_taps(taps, weight))
    return taps


def _value_and_gradient_at(
    spline: _Spline, coefficients: AnyArray, *index: AnyArray
) -> tuple[AnyArray, tuple[AnyArray, ...]]:
    """Compute the value and its gradient at one point."""
    taps, (wx, wy, wz), (sx, sy, sz) = _taps(spline, coefficients, index)
    x, dx = jax.lax.optimization_barrier((_sum_taps(taps, wx), _sum_taps(taps, sx)))
    y, dy, y_dx = jax.lax.optimization_barrier((_sum_taps(x, wy), _sum_taps(x, sy), _sum_taps(dx, wy)))
    return _sum_taps(y, wz), (_sum_taps(y_dx, wz), _sum_taps(dy, wz), _sum_taps(y, sz))


def _taps(spline: _Spline, coefficients: AnyArray, index: tuple[AnyArray, ...]) -> Any:
    """Return the coefficients around a point, and the weights and the slopes of the spline by axis.

    A point outside the grid is replaced by the nearest point on the grid, and its slope across the border is zero.
    """
    last = [length - spline.width for length in coefficients.shape]
    nearest = [jnp.clip(i, 0.0, end) for i, end in zip(index, last, strict=True)]
    corner = [jax.lax.stop_gradient(jnp.floor(i)) for i in nearest]
    taps = jax.lax.dynamic_slice(coefficients, [first.astype(int) for first in corner], (spline.width,) * 3)
    offsets = [i - first for i, first in zip(nearest, corner, strict=True)]
    slopes = [
        tuple(jnp.where((i >= 0) & (i <= end), slope, 0.0) for slope in spline.slopes(offset))
        for i, end, offset in zip(index, last, offsets, strict=True)
    ]
    # Without the barriers XLA fuses the stages and gathers every tap anew for each of the four results.
    return jax.lax.optimization_barrier((taps, [spline.weights(offset) for offset in offsets], slopes))


def _sum_taps(taps: AnyArray, weights: tuple[AnyArray, ...]) -> AnyArray:
    """Sum the weighted taps over the first axis; the other axes are contiguous, which allows vector instructions."""
    return sum(taps[k] * weight for k, weight in enumerate(weights))


def _cubic_weights(t: AnyArray) -> tuple[AnyArray, ...]:
    """Evaluate the uniform cubic B-spline at distances t + 1, t, 1 − t, 2 − t from its centre, 0 ≤ t ≤ 1."""
    s = 1 - t
    return s**3 / 6, 2 / 3 - t**2 * (2 - t) / 2, 2 / 3 - s**2 * (2 - s) / 2, t**3 / 6


def _cubic_slopes(t: AnyArray) -> tuple[AnyArray, ...]:
    """Compute the derivatives of `_cubic_weights` in t."""
    s = 1 - t
    return -(s**2) / 2, t * (3 * t / 2 - 2), s * (2 - 3 * s / 2), t**2 / 2


def _linear_weights(t: AnyArray) -> tuple[AnyArray, ...]:
    """Evaluate the hat functions of the two voxels on both sides of a point, 0 ≤ t ≤ 1."""
    return 1 - t, t


def _linear_slopes(t: AnyArray) -> tuple[AnyArray, ...]:
    """Compute the derivatives of `_linear_weights` in t."""
    return -jnp.ones_like(t), jnp.ones_like(t)


_SPLINES: dict[Interpolation, _Spline] = {
    "linear": _Spline(2, _linear_weights, _linear_slopes),
    "cubic": _Spline(4, _cubic_weights, _cubic_slopes),
}
# The chains of one point are adjacent in memory, because they read the same voxels.
_VALUES = {name: with_chains_as_columns(_in_batches(partial(_value_at, spline))) for name, spline in _SPLINES.items()}
_VALUES_AND_GRADIENTS = {
    name: with_chains_as_columns(_in_batches(partial(_value_and_gradient_at, spline)))
    for name, spline in _SPLINES.items()
}
