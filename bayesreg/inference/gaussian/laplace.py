"""The Gaussian that the curvature of a posterior defines at its mode (Laplace's approximation)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float, Int

from bayesreg.inference.gaussian.hierarchy import Volume, mark_scales, mark_scales_of_displacements, volume_of
from bayesreg.inference.layout import marked, unravel
from bayesreg.inference.target import Curvature, Target, estimands_of, logdensity, without_walls
from bayesreg.types import AnyArray, InputError

# A parameter that exceeds so many times the greatest start value of its kind runs away.
FAR = 1e6
# Precision of the other coordinates where the displacements alone are moved.
ALONE = 10.0
# Step of differences between gradients, in Normal scores and logarithms.
STEP = 1e-4
# Step of differences between curvatures, which are powers of a scale, in the logarithm of that scale.
SCALE_STEP = 0.01
# Where residuals make the exact curvature less than Gauss–Newton's, or negative, this share of the latter counts.
LEAST_RATIO = 0.25


class Gaussian(NamedTuple):
    """The Gaussian N(centre, factor · factorᵀ) of a flat position (a pytree).

    Attributes
    ----------
    centre : (d,) array
    factor : (d, d) array
        Upper triangular; the whitened coordinates are ξ = factor⁻¹ (x − centre).
    """

    centre: Float[AnyArray, "dimension"]
    factor: Float[AnyArray, "dimension dimension"]

    def place(self, xi: AnyArray) -> AnyArray:
        """The flat position at whitened coordinates ξ."""
        return self.centre + self.factor @ xi


def volume_at(target: Target, data: Any, flat: Float[np.ndarray, "dimension"]) -> Volume:
    """The derivatives of −½ log det H in the scales of the displacements, H their curvature; by differences of it."""
    here = _curvature(target, data, flat).gauss_newton
    derivatives = []
    for entry in np.flatnonzero(mark_scales_of_displacements(target)):
        step = np.zeros(len(flat))
        step[entry] = SCALE_STEP
        ahead, behind = (_curvature(target, data, flat + way * step).gauss_newton for way in (1, -1))
        derivatives.append(((ahead - behind) / (2 * SCALE_STEP), (ahead - 2 * here + behind) / SCALE_STEP**2))
    return volume_of(_regular(here), derivatives)


def laplace(target: Target, flat: Float[np.ndarray, "dimension"], data: Any = None, joint: bool = True) -> Gaussian:
    """The Gaussian about a flat position, with the curvature there (see `precision_at`)."""
    return gaussian_of(flat, precision_at(target, flat, data, joint))


def average_gaussian(target: Target, flats: Sequence[Float[np.ndarray, "dimension"]]) -> Gaussian:
    """The Gaussian with the mean of the exact curvatures at places of which the mode is the first, `recentre` by all.

    Where the images say little at the mode and much beside it, the curvature at the mode alone makes a Gaussian too
    wide, and trajectories meet forces in it that ask for short steps. Gauss–Newton's alone does so where a model leaves
    large residuals. Of the parameters the curvature at the mode is kept: that of a logarithm grows with its argument,
    and its mean over places would be that of the largest. In the logarithm of a scale it is that at draws about the
    mode, which trajectories meet, though the posterior of the scale is wider.
    """
    # One after the other: each holds more than these two arrays.
    curvatures = (_curvature(target, target.data, flat) for flat in flats)
    pairs = [(found.gauss_newton, found.remainder) for found in curvatures]
    approximate, remainder = (np.mean(parts, axis=0) for parts in zip(*pairs, strict=True))
    curvature = _add_convexly(_regular(approximate), remainder)
    precision = _jointly(target, target.data, flats[0], curvature, joint=True, at_draws=True)
    return recentre(target, gaussian_of(flats[0], precision), flats)


def recentre(target: Target, gaussian: Gaussian, flats: Sequence[Float[np.ndarray, "dimension"]]) -> Gaussian:
    """The Gaussian of the same shape that at some places pulls, on average, as the density without walls does.

    Its centre is the mean of x + C ∇log π(x). Where walls hold the mode, the force that presses on them is then the
    Gaussian's own, whose motion is reflected exactly; kicks are left with what is beyond second order. A scale stays
    where it is: its force at the mode of what it scales is no hint (see `hierarchy`).
    """
    slopes = np.mean([slope_at(target, flat) for flat in flats], axis=0)
    factor, moving = np.asarray(gaussian.factor), 1 - mark_scales(target).astype(float)
    shift = moving * (factor @ (factor.T @ (moving * slopes)))
    return gaussian._replace(centre=jnp.asarray(np.mean(flats, axis=0) + shift))


def slope_at(target: Target, flat: Float[np.ndarray, "dimension"]) -> Float[np.ndarray, "dimension"]:
    """∇log π of the density without walls."""
    return height_and_slope(target, target.data, flat)[1]


def height_and_slope(
    target: Target, data: Any, flat: Float[np.ndarray, "dimension"]
) -> tuple[float, Float[np.ndarray, "dimension"]]:
    """log π and ∇log π of the density without walls.

    Parameters
    ----------
    target : Target
    data : pytree
        The target's, or that of a similar problem.
    flat : (d,) array
        Flat position.
    """
    height, slope = _height_and_slope(target, without_walls(target, data), jnp.asarray(flat))
    return float(height), np.asarray(slope)


@partial(jax.jit, static_argnums=0)
def _height_and_slope(target: Target, data: Any, flat: AnyArray) -> tuple[AnyArray, AnyArray]:
    return jax.value_and_grad(lambda x: logdensity(target, data, unravel(target)(x)))(flat)


def _add_convexly(
    approximate: Float[np.ndarray, "rows rows"], remainder: Float[np.ndarray, "rows rows"]
) -> Float[np.ndarray, "rows rows"]:
    """The sum of a positive definite curvature and another, made positive definite.

    In coordinates that whiten the first, eigenvalues of the sum count by their size, and as no less than `LEAST_RATIO`.
    """
    lower = np.linalg.cholesky(approximate)
    half = scipy.linalg.solve_triangular(lower, remainder, lower=True)
    values, vectors = np.linalg.eigh(scipy.linalg.solve_triangular(lower, half.T, lower=True))
    vectors = lower @ vectors
    return (vectors * np.maximum(np.abs(1 + values), LEAST_RATIO)) @ vectors.T


def gaussian_of(
    centre: Float[np.ndarray, "dimension"], precision: Float[np.ndarray, "dimension dimension"]
) -> Gaussian:
    """The Gaussian of a centre and a precision."""
    lower = np.linalg.cholesky(precision)
    factor = scipy.linalg.solve_triangular(lower, np.eye(len(centre)), lower=True).T
    return Gaussian(jnp.asarray(centre), jnp.asarray(factor))


def precision_at(
    target: Target, flat: Float[np.ndarray, "dimension"], data: Any = None, joint: bool = True
) -> Float[np.ndarray, "dimension dimension"]:
    """A positive definite curvature of minus the log density.

    The curvature in the displacements and the field is Gauss–Newton's, the rows of the others are differences of the
    gradient; directions in which these are not convex count by their size, and as no less than the target says.

    Parameters
    ----------
    target : Target
    flat : (d,) array
    data : pytree, optional
        Data of a problem other than the target's own.
    joint : bool
        Whether the other coordinates are given curvature; else they are left uncorrelated.

    Raises
    ------
    InputError
        If a parameter runs away, or its curvature is not finite.
    """
    data = target.data if data is None else data
    return _jointly(target, data, flat, _regular(_curvature(target, data, flat).gauss_newton), joint)


def _curvature(target: Target, data: Any, flat: Float[np.ndarray, "dimension"]) -> Curvature:
    estimands = _estimands_at(target, data, jnp.asarray(flat))
    expected = target.coordinates.reference()
    for name in (name for name in estimands if name not in ("field", "u_boundary")):
        _require_an_end((np.asarray(estimands[name]) < FAR * np.asarray(expected[name]).max()).all())
    assert target.mode_search is not None
    return target.mode_search.curvature(data, estimands)


@partial(jax.jit, static_argnums=0)
def _estimands_at(target: Target, data: Any, flat: AnyArray) -> Any:
    return estimands_of(target, data, unravel(target)(flat))


def _require_an_end(found: bool | np.bool_) -> None:
    if not found:
        raise InputError(
            "the search for the mode has no end: λ, μ or a temperature runs away; fix one more of them, or give it a "
            "narrower prior"
        )


def _regular(curvature: Float[np.ndarray, "rows rows"]) -> Float[np.ndarray, "rows rows"]:
    """A trace of the identity keeps directions finite that neither images nor elasticity see."""
    return curvature + 1e-9 * np.trace(curvature) * np.eye(len(curvature))


def _jointly(
    target: Target,
    data: Any,
    flat: Float[np.ndarray, "dimension"],
    curvature: Float[np.ndarray, "rows rows"],
    joint: bool,
    at_draws: bool = False,
) -> Float[np.ndarray, "dimension dimension"]:
    """The curvature in all coordinates, given that in the displacements and, jointly, the field.

    In the scales of the displacements it is that of their evidence, or that at draws of these (see `hierarchy`).
    """
    curved = _mark_curved(target, joint)
    count = int((~curved).sum())
    # The coordinates whose curvature counts come last. Where not jointly, the field's share of the given is left out.
    order = np.argsort(curved, kind="stable")
    precision = np.zeros((len(flat), len(flat)))
    first = len(curvature) - int(curved.sum())
    precision[count:, count:] = curvature[first:, first:]
    if joint and count:
        rows = -hessian_rows(target, data, flat, order[:count])[:, order]
        _require_an_end(np.isfinite(rows).all())
        scales = np.flatnonzero(mark_scales_of_displacements(target)[order[:count]])
        if len(scales):
            volume = volume_at(target, data, flat)
            rows[np.ix_(scales, scales)] += np.diag(volume.excess) if at_draws else volume.curvature
        precision[:count] = rows
        precision[count:, :count] = rows[:, count:].T
        cross = rows[:, count:]
        inner = scipy.linalg.cho_solve(scipy.linalg.cho_factor(precision[count:, count:]), cross.T)
        schur = (rows[:, :count] + rows[:, :count].T) / 2 - cross @ inner
        least = ravel_pytree(target.coordinates.least_curvature(data, unravel(target)(jnp.asarray(flat))))[0]
        unit = np.sqrt(np.asarray(least)[order[:count]])
        values, vectors = np.linalg.eigh(schur / np.outer(unit, unit))
        vectors *= unit[:, None]
        convex = (vectors * np.maximum(np.abs(values), 1.0)) @ vectors.T
        precision[:count, :count] = convex + cross @ inner
    else:
        precision[:count, :count] = ALONE * np.eye(count)
    precision[np.ix_(order, order)] = (precision + precision.T) / 2
    return precision


def _mark_curved(target: Target, joint: bool) -> Bool[np.ndarray, "dimension"]:
    """Entries of a flat position whose curvature the target knows: "u_boundary" and, jointly, "field"."""
    return marked(target, "u_boundary", "field") if joint else marked(target, "u_boundary")


def hessian_rows(
    target: Target, data: Any, flat: Float[np.ndarray, "dimension"], entries: Int[np.ndarray, "rows"]
) -> Float[np.ndarray, "rows dimension"]:
    """Rows of the Hessian of the log density without walls, by differences of its gradient.

    The coordinates are Normal scores and logarithms, so that one step suits all. Exact rows would cost more to compile
    than the search.
    """
    rows = []
    for entry in entries:
        step = np.zeros(len(flat))
        step[entry] = STEP
        ahead, behind = (height_and_slope(target, data, flat + way * step)[1] for way in (1, -1))
        rows.append((ahead - behind) / (2 * STEP))
    return np.array(rows)
