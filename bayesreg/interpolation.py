"""Interpolation of images, differentiable in the places: trilinear, or by cubic B-splines."""

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
    """An image as a function of world position, for use inside jitted code (it is a pytree).

    Differentiable in the points, not in the coefficients. All that `vmap` runs side by side share it.
    Trilinear (continuous, its gradient jumps between voxels) or cubic B-spline (twice continuously
    differentiable; `scipy.ndimage.map_coordinates` with order 3 and mode "mirror"). Outside the grid the
    image continues with its nearest value.

    Attributes
    ----------
    coefficients : padded (X, Y, Z) array
        Voxels, or B-spline coefficients.
    to_voxel : (4, 4) array
        World RAS mm to voxel index.
    method : {"linear", "cubic"}
    """

    coefficients: AnyArray
    to_voxel: AnyArray
    method: Interpolation

    @jax.jit
    def __call__(self, points: Float[AnyArray, "*batch 3"]) -> Float[AnyArray, "*batch"]:
        """Values at world points, mm."""
        along = [points[..., axis] for axis in range(3)]
        indices = [sum(self.to_voxel[i, j] * along[j] for j in range(3)) + self.to_voxel[i, 3] for i in range(3)]
        return _interpolate(self.method, self.coefficients, *indices)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _interpolate(method: Interpolation, coefficients: AnyArray, *indices: AnyArray) -> AnyArray:
    """Sum of B-splines at voxel indices, given by axis; its derivative is in these alone."""
    return _of_one_chain(_VALUES[method], coefficients, *indices)


@_interpolate.defjvp
def _interpolated_jvp(
    method: Interpolation, primals: tuple[AnyArray, ...], tangents: tuple[AnyArray, ...]
) -> tuple[AnyArray, AnyArray]:
    # Value and gradient from one look at the taps: they are what costs.
    value, gradient = _with_gradient(method, *primals)
    return value, sum(slope * change for slope, change in zip(gradient, tangents[1:], strict=True))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _with_gradient(
    method: Interpolation, coefficients: AnyArray, *indices: AnyArray
) -> tuple[AnyArray, tuple[AnyArray, ...]]:
    """Value, and its gradient in the indices, by axis."""
    return _of_one_chain(_VALUES_AND_GRADIENTS[method], coefficients, *indices)


@_with_gradient.defjvp
def _with_gradient_jvp(
    method: Interpolation, primals: tuple[AnyArray, ...], tangents: tuple[AnyArray, ...]
) -> tuple[Any, Any]:
    # This serves second derivatives: functions with chains as columns have none of their own.
    looked = _in_batches(partial(_value_and_gradient_at, _SPLINES[method]))
    return jax.jvp(partial(_of_one_chain, looked, primals[0]), primals[1:], tangents[1:])


def _of_one_chain(function: Callable[..., Any], coefficients: AnyArray, *indices: AnyArray) -> Any:
    """Call a function of indices (points, chains) by axis with those of one chain, of any shape."""
    found = function(coefficients, *(index.reshape(-1, 1) for index in indices))
    return jax.tree.map(lambda x: x.reshape(indices[0].shape), found)


def _together() -> int:
    """Lookups, those of all chains, whose taps are held at once: what stays in a processor's cache, or fills a GPU."""
    return 2**13 if jax.default_backend() == "cpu" else 2**20


def _in_batches(at: Callable[..., Any]) -> Callable[..., Any]:
    """Turn a function of single points into one of indices (points, chains) by axis."""

    def interpolation(coefficients: AnyArray, *indices: AnyArray) -> Any:
        # The taps of all points at once leave the cache, which costs three times as much. The batches are of one size,
        # filled up with zeros: a smaller last one would be compiled as well.
        count, chains = indices[0].shape
        batches = max(-(-count * chains // _together()), 1)
        size = -(-count // batches)
        filled = [jnp.pad(i, ((0, batches * size - count), (0, 0))).reshape(batches, size * chains) for i in indices]
        found = jax.lax.map(lambda batch: jax.vmap(partial(at, coefficients))(*batch), filled)
        return jax.tree.map(lambda x: x.reshape(-1, chains)[:count], jax.lax.optimization_barrier(found))

    return interpolation


class _Spline(NamedTuple):
    """The B-splines that reach between two voxels, by the place in between: their values, and their slopes there."""

    width: int
    weights: Callable[[AnyArray], tuple[AnyArray, ...]]
    slopes: Callable[[AnyArray], tuple[AnyArray, ...]]


def _value_at(spline: _Spline, coefficients: AnyArray, *index: AnyArray) -> AnyArray:
    """Value at one point: the sum over its taps, one axis after the other."""
    taps, weights, _ = _taps(spline, coefficients, index)
    for weight in weights:
        taps = jax.lax.optimization_barrier(_sum_taps(taps, weight))
    return taps


def _value_and_gradient_at(
    spline: _Spline, coefficients: AnyArray, *index: AnyArray
) -> tuple[AnyArray, tuple[AnyArray, ...]]:
    """Value and gradient at one point."""
    taps, (wx, wy, wz), (sx, sy, sz) = _taps(spline, coefficients, index)
    x, dx = jax.lax.optimization_barrier((_sum_taps(taps, wx), _sum_taps(taps, sx)))
    y, dy, y_dx = jax.lax.optimization_barrier((_sum_taps(x, wy), _sum_taps(x, sy), _sum_taps(dx, wy)))
    return _sum_taps(y, wz), (_sum_taps(y_dx, wz), _sum_taps(dy, wz), _sum_taps(y, sz))


def _taps(spline: _Spline, coefficients: AnyArray, index: tuple[AnyArray, ...]) -> Any:
    """Coefficients about a point, and by axis what the spline makes of them, for the value and for the slope.

    Off the grid the point is the nearest on it, and the slope across the border zero.
    """
    last = [length - spline.width for length in coefficients.shape]
    nearest = [jnp.clip(i, 0.0, end) for i, end in zip(index, last, strict=True)]
    corner = [jax.lax.stop_gradient(jnp.floor(i)) for i in nearest]
    taps = jax.lax.dynamic_slice(coefficients, [first.astype(int) for first in corner], (spline.width,) * 3)
    places = [i - first for i, first in zip(nearest, corner, strict=True)]
    slopes = [
        tuple(jnp.where((i >= 0) & (i <= end), slope, 0.0) for slope in spline.slopes(place))
        for i, end, place in zip(index, last, places, strict=True)
    ]
    # Without the barriers XLA fuses the stages and gathers every tap anew for each of the four results.
    return jax.lax.optimization_barrier((taps, [spline.weights(place) for place in places], slopes))


def _sum_taps(taps: AnyArray, weights: tuple[AnyArray, ...]) -> AnyArray:
    """Over the first axis; what is left lies together, and is summed side by side."""
    return sum(taps[k] * weight for k, weight in enumerate(weights))


def _cubic_weights(t: AnyArray) -> tuple[AnyArray, ...]:
    """Uniform cubic B-spline at distances t + 1, t, 1 − t, 2 − t from its centre, 0 ≤ t ≤ 1."""
    s = 1 - t
    return s**3 / 6, 2 / 3 - t**2 * (2 - t) / 2, 2 / 3 - s**2 * (2 - s) / 2, t**3 / 6


def _cubic_slopes(t: AnyArray) -> tuple[AnyArray, ...]:
    """Derivatives of `_cubic_weights` in t."""
    s = 1 - t
    return -(s**2) / 2, t * (3 * t / 2 - 2), s * (2 - 3 * s / 2), t**2 / 2


def _linear_weights(t: AnyArray) -> tuple[AnyArray, ...]:
    """Hat functions of the two voxels that a point lies between, 0 ≤ t ≤ 1."""
    return 1 - t, t


def _linear_slopes(t: AnyArray) -> tuple[AnyArray, ...]:
    """Derivatives of `_linear_weights` in t."""
    return -jnp.ones_like(t), jnp.ones_like(t)


_SPLINES: dict[Interpolation, _Spline] = {
    "linear": _Spline(2, _linear_weights, _linear_slopes),
    "cubic": _Spline(4, _cubic_weights, _cubic_slopes),
}
# Chains come one after the other at each point: they look at the same voxels.
_VALUES = {name: with_chains_as_columns(_in_batches(partial(_value_at, spline))) for name, spline in _SPLINES.items()}
_VALUES_AND_GRADIENTS = {
    name: with_chains_as_columns(_in_batches(partial(_value_and_gradient_at, spline)))
    for name, spline in _SPLINES.items()
}
