"""The Gaussian that the curvature of a posterior defines at its mode (Laplace's approximation)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float

from bayesreg.inference.gaussian.density import estimands_at, height_and_slope, hessian_rows, regular
from bayesreg.inference.gaussian.evidence import volume_at
from bayesreg.inference.gaussian.hierarchy import mark_hyperparameters, mark_scales
from bayesreg.inference.layout import marked, unravel
from bayesreg.inference.target import Curvature, Target
from bayesreg.types import AnyArray, InputError

# A parameter that exceeds so many times the greatest start value of its kind runs away.
FAR = 1e6
# Precision of the other coordinates where the displacements alone are moved.
ALONE = 10.0
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
    curvature = _add_convexly(regular(approximate), remainder)
    precision = _jointly(target, target.data, flats[0], curvature, joint=True, at_draws=True)
    return recentre(target, gaussian_of(flats[0], precision), flats)


def recentre(target: Target, gaussian: Gaussian, flats: Sequence[Float[np.ndarray, "dimension"]]) -> Gaussian:
    """The Gaussian of the same shape that at some places pulls, on average, as the density does.

    Its centre is the mean of x + C ∇log π(x). A scale stays where it is: its force at the mode of what it scales is no
    hint (see `hierarchy`).
    """
    slopes = np.mean([slope_at(target, flat) for flat in flats], axis=0)
    factor, moving = np.asarray(gaussian.factor), 1 - mark_scales(target).astype(float)
    shift = moving * (factor @ (factor.T @ (moving * slopes)))
    return gaussian._replace(centre=jnp.asarray(np.mean(flats, axis=0) + shift))


def slope_at(target: Target, flat: Float[np.ndarray, "dimension"]) -> Float[np.ndarray, "dimension"]:
    """∇log π."""
    return height_and_slope(target, target.data, flat)[1]


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
    target: Target,
    flat: Float[np.ndarray, "dimension"],
    data: Any = None,
    joint: bool = True,
    fixed: Bool[np.ndarray, "dimension"] | None = None,
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
    fixed : (d,) bool array, optional
        Some of the others that are left uncorrelated all the same.

    Raises
    ------
    InputError
        If a parameter runs away, or its curvature is not finite.
    """
    data = target.data if data is None else data
    return _jointly(target, data, flat, regular(_curvature(target, data, flat).gauss_newton), joint, fixed=fixed)


def _curvature(target: Target, data: Any, flat: Float[np.ndarray, "dimension"]) -> Curvature:
    estimands = estimands_at(target, data, jnp.asarray(flat))
    expected = target.coordinates.reference()
    for name in (name for name in estimands if name not in ("field", "u_boundary")):
        usual = np.asarray(expected[name]).max() or 1.0
        _require_an_end((np.asarray(estimands[name]) < FAR * usual).all())
    assert target.mode_search is not None
    return target.mode_search.curvature(data, estimands)


def _require_an_end(found: bool | np.bool_) -> None:
    if not found:
        raise InputError(
            "the search for the mode has no end: λ, μ or a temperature runs away; fix one more of them, or give it a "
            "narrower prior"
        )


def _jointly(
    target: Target,
    data: Any,
    flat: Float[np.ndarray, "dimension"],
    curvature: Float[np.ndarray, "rows rows"],
    joint: bool,
    at_draws: bool = False,
    fixed: Bool[np.ndarray, "dimension"] | None = None,
) -> Float[np.ndarray, "dimension dimension"]:
    """The curvature in all coordinates, given that in the displacements and, jointly, the field.

    In the hyperparameters it is that of their evidence, or that at draws of the displacements (see `hierarchy`).
    """
    curved = _mark_curved(target, joint)
    alone = ~curved if not joint else np.zeros(len(flat), bool) if fixed is None else fixed & ~curved
    found = ALONE * np.eye(len(flat))
    # Where not jointly, the field's share of the given is left out.
    first = len(curvature) - int(curved.sum())
    found[np.ix_(curved, curved)] = curvature[first:, first:]
    entries = np.flatnonzero(~curved & ~alone)
    if not len(entries):
        return found
    rows = -hessian_rows(target, data, flat, entries)
    _require_an_end(np.isfinite(rows).all())
    cross, own = rows[:, curved], (rows[:, entries] + rows[:, entries].T) / 2
    hyperparameters = np.flatnonzero(mark_hyperparameters(target)[entries])
    if len(hyperparameters):
        volume = volume_at(target, flat, curvature)
        own[np.ix_(hyperparameters, hyperparameters)] += volume.excess if at_draws else volume.curvature
    inner = cross @ scipy.linalg.cho_solve(scipy.linalg.cho_factor(found[np.ix_(curved, curved)]), cross.T)
    least = ravel_pytree(target.coordinates.least_curvature(data, unravel(target)(jnp.asarray(flat))))[0]
    unit = np.sqrt(np.asarray(least)[entries])
    values, vectors = np.linalg.eigh((own - inner) / np.outer(unit, unit))
    vectors *= unit[:, None]
    convex = (vectors * np.maximum(np.abs(values), 1.0)) @ vectors.T
    found[np.ix_(entries, entries)] = convex + (inner + inner.T) / 2
    found[np.ix_(entries, curved)], found[np.ix_(curved, entries)] = cross, cross.T
    return found


def _mark_curved(target: Target, joint: bool) -> Bool[np.ndarray, "dimension"]:
    """Entries of a flat position whose curvature the target knows: "u_boundary" and, jointly, "field"."""
    return marked(target, "u_boundary", "field") if joint else marked(target, "u_boundary")
