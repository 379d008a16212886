"""The Gaussian that the curvature of a posterior defines at its mode (Laplace's approximation)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float

from bayesreg.inference.gaussian.density import (
    estimands_at,
    height_and_slope,
    hessian_rows,
    mark_normaliser,
    regular,
)
from bayesreg.inference.gaussian.evidence import curvature_without_images, volume_at
from bayesreg.inference.gaussian.following import Following, follow_by, follow_nothing
from bayesreg.inference.gaussian.hierarchy import mark_followed, mark_hyperparameters, mark_scales
from bayesreg.inference.layout import dimension, marked, unravel
from bayesreg.inference.target import Curvature, Target, without_normaliser
from bayesreg.types import AnyArray, InputError

# The search has no end if a parameter exceeds the greatest reference value of its kind by this factor.
FAR = 1e6
# The precision of the coordinates other than the displacements if only the displacements move.
ALONE = 10.0
# Residuals can make the exact curvature less than Gauss–Newton's, or negative; at least this share of the latter is
# kept.
LEAST_RATIO = 0.25


class Gaussian(NamedTuple):
    """The Gaussian N(centre, factor · factorᵀ) of a flat position (a pytree).

    Attributes
    ----------
    centre : (d,) array
    factor : (d, d) array
        An upper triangular matrix; the whitened coordinates are ξ = factor⁻¹ (x − centre).
    following : Following or None
        How the displacements, the last entries, follow hyperparameters. This precedes the product with the factor, and
        what is placed is then no Gaussian.
    """

    centre: Float[AnyArray, "dimension"]
    factor: Float[AnyArray, "dimension dimension"]
    following: Following | None = None

    def place(self, xi: AnyArray) -> AnyArray:
        """Map whitened coordinates ξ to a flat position."""
        if self.following is not None:
            first = len(xi) - len(self.following.mean)
            xi = xi.at[first:].set(self.following.follow(self._change(xi[:first]), xi[first:]))
        return self.centre + _product(self.factor, xi)

    def log_jacobian(self, xi: AnyArray) -> AnyArray:
        """Compute the log determinant of `place`, up to a constant."""
        if self.following is None:
            return jnp.zeros(())
        return self.following.log_jacobian(self._change(xi[: len(xi) - len(self.following.mean)]))

    def _change(self, parameters: AnyArray) -> AnyArray:
        """Map the whitened coordinates of all but the displacements to the change of the followed hyperparameters.

        These are independent of the displacements, which are the last entries, in the upper triangular factor.
        """
        assert self.following is not None
        first = len(parameters)
        return _product(self.factor[:first, :first], parameters)[self.following.entries]

    def pull_back(self, slope: AnyArray) -> AnyArray:
        """Map a slope in the flat position to the slope in the whitened coordinates."""
        return _product(self.factor.T, slope)

    def in_single_precision(self) -> Gaussian:
        """Return the Gaussian with its factor in single precision: it takes half the time to multiply."""
        return jax.tree.map(_in_single_precision, self)._replace(centre=self.centre)

    def whiten(self, flat: AnyArray) -> AnyArray:
        """Map a flat position to whitened coordinates ξ."""
        xi = solve_upper(self.factor, flat - self.centre)
        if self.following is None:
            return xi
        first = len(xi) - len(self.following.mean)
        return xi.at[first:].set(self.following.unfollow(self._change(xi[:first]), xi[first:]))


def _in_single_precision(array: AnyArray) -> AnyArray:
    return jnp.asarray(array, jnp.float32) if jnp.issubdtype(array.dtype, jnp.floating) else jnp.asarray(array)


def _product(matrix: Float[AnyArray, "rows columns"], vector: Float[AnyArray, "columns"]) -> Float[AnyArray, "rows"]:
    """Multiply in the precision of the matrix; on a GPU the default for single precision has half of its digits."""
    return jnp.matmul(matrix, vector.astype(matrix.dtype), precision=jax.lax.Precision.HIGHEST)


def solve_upper(matrix: Float[AnyArray, "rows rows"], vector: Float[AnyArray, "rows"]) -> Float[AnyArray, "rows"]:
    """Solve a system with an upper triangular matrix.

    LAPACK stores matrices by columns. It is given the transpose, so that XLA need not store the whole factor by columns
    in one part of a program and by rows in another, with a copy of it between them in each trajectory.
    """
    return jax.scipy.linalg.solve_triangular(matrix.T, vector, trans=1, lower=True)


def laplace(target: Target, flat: Float[np.ndarray, "dimension"], data: Any = None, joint: bool = True) -> Gaussian:
    """Make the Gaussian about a flat position with the curvature at it (see `precision_at`)."""
    gaussian = gaussian_of(flat, precision_at(target, flat, data, joint))
    return let_follow(target, gaussian) if joint else gaussian


def let_follow(target: Target, gaussian: Gaussian) -> Gaussian:
    """Let the displacements of a Gaussian follow hyperparameters, if those of the target do (see `following`)."""
    entries, rows = np.flatnonzero(mark_followed(target)), marked(target, "u_boundary")
    if not len(entries):
        return gaussian
    centre, factor = np.asarray(gaussian.centre), np.asarray(gaussian.factor)
    sds, prior_at = np.linalg.norm(factor[entries], axis=1), curvature_without_images(target, centre)
    return gaussian._replace(following=follow_by(entries, sds, factor[np.ix_(rows, rows)], centre[rows], prior_at))


def blank_gaussian(target: Target) -> Gaussian:
    """Make a Gaussian N(0, I) of the shapes that all Gaussians of the target have."""
    unknowns, entries = dimension(target), np.flatnonzero(mark_followed(target))
    following = follow_nothing(entries, int(marked(target, "u_boundary").sum())) if len(entries) else None
    return Gaussian(jnp.zeros(unknowns), jnp.eye(unknowns), following)


def average_gaussian(target: Target, flats: Sequence[Float[np.ndarray, "dimension"]]) -> Gaussian:
    """Make the Gaussian with the mean of the exact curvatures at several points; the first of them is the mode.

    Its centre is that of `recentre`. If the images are informative beside the mode but not at it, the curvature at the
    mode makes a Gaussian that is too wide, and trajectories meet forces that require short steps. Gauss–Newton's
    curvature has the same effect if a model leaves large residuals. The parameters keep their curvature at the mode:
    the curvature in a logarithm grows with its argument, and the largest one would dominate a mean over points. The
    curvature in the logarithm of a scale is that at draws about the mode, because trajectories meet it, although the
    posterior of the scale is wider.
    """
    # A generator keeps one curvature in memory, which holds more than these two arrays.
    curvatures = (_curvature(target, target.data, flat) for flat in flats)
    pairs = [(point_curvature.gauss_newton, point_curvature.remainder) for point_curvature in curvatures]
    approximate, remainder = (np.mean(matrices, axis=0) for matrices in zip(*pairs, strict=True))
    curvature = _add_convexly(regular(approximate), remainder)
    precision = _jointly(target, target.data, flats[0], curvature, joint=True, at_draws=True)
    return let_follow(target, recentre(target, gaussian_of(flats[0], precision), flats))


def recentre(target: Target, gaussian: Gaussian, flats: Sequence[Float[np.ndarray, "dimension"]]) -> Gaussian:
    """Move a Gaussian so that its mean slope at some points equals that of the density.

    The new centre is the mean of x + C ∇log π(x). A scale does not move: its slope at the mode of the components that
    it scales does not point to its own posterior (see `hierarchy`).
    """
    slopes = np.mean([slope_at(target, flat) for flat in flats], axis=0)
    factor, moving = np.asarray(gaussian.factor), 1 - mark_scales(target).astype(float)
    shift = moving * (factor @ (factor.T @ (moving * slopes)))
    return gaussian._replace(centre=jnp.asarray(np.mean(flats, axis=0) + shift))


def slope_at(target: Target, flat: Float[np.ndarray, "dimension"]) -> Float[np.ndarray, "dimension"]:
    """Compute ∇log π at a flat position.

    A normaliser that depends on scales only is left out, and the slope lacks its part in their entries.
    """
    is_scale = mark_scales(target)[mark_normaliser(target)].all()
    return height_and_slope(target, without_normaliser(target, target.data) if is_scale else target.data, flat)[1]


def _add_convexly(
    approximate: Float[np.ndarray, "rows rows"], remainder: Float[np.ndarray, "rows rows"]
) -> Float[np.ndarray, "rows rows"]:
    """Add a curvature to a positive definite one, and make the sum positive definite.

    In coordinates that whiten the first, eigenvalues of the sum are replaced by their absolute values, and by
    `LEAST_RATIO` if these are smaller. Most often none is, which a Cholesky factorisation finds out soon.
    """
    try:
        scipy.linalg.cholesky((1 - LEAST_RATIO) * approximate + remainder, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError:
        return approximate + remainder + _lift_eigenvalues(approximate, remainder)
    return approximate + remainder


def _lift_eigenvalues(
    approximate: Float[np.ndarray, "rows rows"], remainder: Float[np.ndarray, "rows rows"]
) -> Float[np.ndarray, "rows rows"]:
    """Compute what `_add_convexly` adds to the sum. Only the few eigenvalues below `LEAST_RATIO` are computed."""
    lower = np.linalg.cholesky(approximate)
    half = scipy.linalg.solve_triangular(lower, remainder, lower=True)
    whitened = scipy.linalg.solve_triangular(lower, half.T, lower=True)
    values, vectors = scipy.linalg.eigh(whitened, subset_by_value=(-np.inf, LEAST_RATIO - 1))
    vectors = lower @ vectors
    return (vectors * (np.maximum(np.abs(1 + values), LEAST_RATIO) - 1 - values)) @ vectors.T


def gaussian_of(
    centre: Float[np.ndarray, "dimension"], precision: Float[np.ndarray, "dimension dimension"]
) -> Gaussian:
    """Make the Gaussian of a centre and a precision."""
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
    """Compute a positive definite curvature of minus the log density.

    The curvature in the displacements and the field is Gauss–Newton's. The rows of the other coordinates are finite
    differences of the gradient. The eigenvalues of this part are replaced by absolute values, and by the target's
    `least_curvature` if these are smaller.

    Parameters
    ----------
    target : Target
    flat : (d,) array
    data : pytree, optional
        Data of a problem other than the target's own.
    joint : bool
        Whether the curvature of the other coordinates is computed; else they are left uncorrelated.
    fixed : (d,) bool array, optional
        The other coordinates that are left uncorrelated also if `joint` is true.

    Raises
    ------
    InputError
        If a parameter grows without bound, or its curvature is not finite.
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


def _require_an_end(has_end: bool | np.bool_) -> None:
    if not has_end:
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
    """Complete the curvature in the displacements and, if `joint`, the field to that in all coordinates.

    The curvature in the hyperparameters is that of their evidence, or that at draws of the displacements (see
    `hierarchy`).
    """
    curved = _mark_curved(target, joint)
    alone = ~curved if not joint else np.zeros(len(flat), bool) if fixed is None else fixed & ~curved
    precision = ALONE * np.eye(len(flat))
    # Without `joint`, the field's part of the given curvature is left out.
    first = len(curvature) - int(curved.sum())
    precision[np.ix_(curved, curved)] = curvature[first:, first:]
    entries = np.flatnonzero(~curved & ~alone)
    if not len(entries):
        return precision
    rows = -hessian_rows(target, data, flat, entries)
    _require_an_end(np.isfinite(rows).all())
    cross, diagonal_block = rows[:, curved], (rows[:, entries] + rows[:, entries].T) / 2
    hyperparameters = np.flatnonzero(mark_hyperparameters(target)[entries])
    if len(hyperparameters):
        volume = volume_at(target, flat, curvature)
        # Where displacements follow, trajectories meet the curvature of the evidence.
        is_met = at_draws and not mark_followed(target).any()
        diagonal_block[np.ix_(hyperparameters, hyperparameters)] += volume.excess if is_met else volume.curvature
    inner = cross @ scipy.linalg.cho_solve(scipy.linalg.cho_factor(precision[np.ix_(curved, curved)]), cross.T)
    least = ravel_pytree(target.coordinates.least_curvature(data, unravel(target)(jnp.asarray(flat))))[0]
    unit = np.sqrt(np.asarray(least)[entries])
    values, vectors = np.linalg.eigh((diagonal_block - inner) / np.outer(unit, unit))
    vectors *= unit[:, None]
    convex = (vectors * np.maximum(np.abs(values), 1.0)) @ vectors.T
    followed = mark_followed(target)[entries]
    # Displacements that follow hyperparameters have coordinates that are independent of them.
    cross[followed] = inner[followed] = inner[:, followed] = 0.0
    convex[np.ix_(followed, ~followed)] = convex[np.ix_(~followed, followed)] = 0.0
    precision[np.ix_(entries, entries)] = convex + (inner + inner.T) / 2
    precision[np.ix_(entries, curved)], precision[np.ix_(curved, entries)] = cross, cross.T
    return precision


def _mark_curved(target: Target, joint: bool) -> Bool[np.ndarray, "dimension"]:
    """Mark the entries whose curvature the target computes: "u_boundary" and, if `joint`, "field"."""
    return marked(target, "u_boundary", "field") if joint else marked(target, "u_boundary")
