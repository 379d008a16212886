"""The search for hyperparameters: the maximum of their evidence, with the displacements integrated out.

The joint mode of displacements and hyperparameters is far from most of the probability (see `hierarchy`). Only the
images are far from quadratic in the displacements u. They are expanded to second order about u_0, with the curvature A
and the slope g. All other terms, the rest, are quadratic in u at given hyperparameters θ. The evidence is then

log p(θ | data) = g · d − ½ dᵀ A d + log rest(u_0 + d, θ) − ½ log det (A + R(θ)) + const,

where R is the curvature of the rest, and d = (A + R)⁻¹ (g + ∇ log rest(u_0, θ)) is the maximum over u. The derivative
of the evidence is that of log rest at u_0 + d, less ½ tr((A + R)⁻¹ ∂R).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse
from jaxtyping import Float, Int
from scipy.optimize import minimize

from bayesreg.inference.deadline import NEVER, Deadline
from bayesreg.inference.gaussian.density import (
    estimands_at,
    height_and_slope,
    hessian_rows,
    normaliser_and_slope,
    regular,
)
from bayesreg.inference.gaussian.hierarchy import Volume, mark_hyperparameters
from bayesreg.inference.layout import marked
from bayesreg.inference.target import Target, without_normaliser
from bayesreg.types import InputError, Matrix

# The step of finite differences of the curvature, in the logarithm of a scale or a Normal score.
STEP = 0.01
# The greatest change of a hyperparameter in one search; the expansion is not accurate for greater ones.
FARTHEST = 3.0
# The greatest number of iterations of a search, whose coordinates are standard deviations; the slope at which it ends;
# and the least curvature of a hyperparameter's evidence, which is that of a prior of ±3.
MOST_ITERATIONS, PRECISE, LEAST_CURVATURE = 10, 0.02, 0.1
# A search ends, too, if an iteration gains less than this share of the whole gain: the next expansion changes more.
LEAST_SHARE = 0.01


class Expansion(NamedTuple):
    """The expansion of the density about a flat position.

    Attributes
    ----------
    flat : (d,) array
    entries : (k,) int array
        The entries of `flat` that hold hyperparameters.
    images : (r, r) array
        A, the curvature of the images' part in "field" and "u_boundary".
    slope : (d,) array
        The slope of the images' part.
    """

    flat: Float[np.ndarray, "dimension"]
    entries: Int[np.ndarray, "hyperparameters"]
    images: Float[np.ndarray, "rows rows"]
    slope: Float[np.ndarray, "dimension"]


class Found(NamedTuple):
    """The result of a search for hyperparameters.

    Attributes
    ----------
    flat : (d,) array
        The hyperparameters at the maximum of their evidence, with the displacements of highest density given them.
    greatest_change : float
        The greatest change of the hyperparameters, in their standard deviations.
    units : (k, k) array or None
        The directions of these standard deviations, one in each column; None before a search.
    """

    flat: Float[np.ndarray, "dimension"]
    greatest_change: float
    units: Float[np.ndarray, "hyperparameters hyperparameters"] | None = None


def maximise_evidence(
    target: Target,
    flat: Float[np.ndarray, "dimension"],
    curvature: Float[np.ndarray, "rows rows"],
    units: Float[np.ndarray, "hyperparameters hyperparameters"] | None = None,
    deadline: Deadline = NEVER,
) -> Found:
    """Look for the maximum of the evidence of the hyperparameters about a flat position.

    Parameters
    ----------
    target : Target
    flat : (d,) array
        A mode given the hyperparameters, or a point near one.
    curvature : (r, r) array
        The Gauss–Newton curvature at `flat`, in "field" and "u_boundary".
    units : (k, k) array, optional
        The units of an earlier search near `flat`. Without them they are computed from the curvature of the evidence,
        which costs several evaluations.
    deadline : Deadline
        The search ends then.
    """
    entries = np.flatnonzero(mark_hyperparameters(target))
    about = _expand(target, flat, entries, curvature)
    if units is None:
        values, vectors = np.linalg.eigh(evidence_curvature(target, about, curvature))
        units = vectors / np.sqrt(np.maximum(np.abs(values), LEAST_CURVATURE))
    best: list[tuple[float, np.ndarray, np.ndarray, np.ndarray]] = []
    # The log evidence at the start and after each iteration.
    heights: list[float] = []

    def objective(xi: np.ndarray) -> tuple[float, np.ndarray]:
        height, slope, position = evidence(target, about, flat[entries] + units @ xi)
        slope = units.T @ slope
        if not (np.isfinite(height) and np.isfinite(slope).all()):
            if not best:
                raise InputError("the mode cannot be looked for: the evidence of the hyperparameters is not finite")
            # A value that makes the line search turn back: it rises with the distance from the best point so far.
            top, _, best_xi, best_slope = best[-1]
            return -top + 2 * abs(best_slope @ (xi - best_xi)), best_slope
        if not heights:
            heights.append(height)
        if not best or height > best[-1][0]:
            best[:] = [(height, position, xi.copy(), slope)]
        return -height, -slope

    def stop_if_settled(intermediate_result: Any) -> None:
        deadline.require_time()
        heights.append(-intermediate_result.fun)
        if heights[-1] - heights[-2] < LEAST_SHARE * (heights[-1] - heights[0]):
            raise StopIteration

    reach = FARTHEST / np.abs(units).max(axis=0)
    options = {"maxiter": MOST_ITERATIONS, "ftol": 1e-12, "gtol": PRECISE}
    minimize(objective, np.zeros(len(entries)), jac=True, method="L-BFGS-B", bounds=[(-r, r) for r in reach],
             options=options, callback=stop_if_settled)  # fmt: skip
    return Found(best[-1][1], float(np.abs(best[-1][2]).max()), units)


def evidence_curvature(
    target: Target, about: Expansion, curvature: Float[np.ndarray, "rows rows"]
) -> Float[np.ndarray, "hyperparameters hyperparameters"]:
    """Compute minus the second derivatives of the log evidence at the point of the expansion.

    The displacements follow the hyperparameters: the evidence is less curved than the density at fixed displacements.
    """
    assert target.mode_search is not None
    data = target.mode_search.quadratic_part(target.data)
    rows = hessian_rows(target, data, about.flat, about.entries)
    cross = rows[:, marked(target, "field", "u_boundary")]
    volume = volume_at(target, about.flat, regular(curvature))
    minus_hessian = volume.curvature - rows[:, about.entries] - cross @ volume.covariance @ cross.T
    return (minus_hessian + minus_hessian.T) / 2


def evidence(
    target: Target, about: Expansion, theta: Float[np.ndarray, "hyperparameters"]
) -> tuple[float, Float[np.ndarray, "hyperparameters"], Float[np.ndarray, "dimension"]]:
    """Compute the log evidence of θ, its slope, and the flat position with θ and the most likely displacements."""
    assert target.mode_search is not None
    data = target.mode_search.quadratic_part(target.data)
    start = np.array(about.flat)
    start[about.entries] = theta
    is_displacement, rows = marked(target, "u_boundary"), marked(target, "field", "u_boundary")
    # θ is the same at both points, and so is the normaliser, which may be costly.
    plain = without_normaliser(target, data)
    log_normaliser, push_of_normaliser = normaliser_and_slope(target, start)
    slope = height_and_slope(target, plain, start)[1]
    precision = regular(about.images + dense(_curvature(target, start, start)))
    factor = scipy.linalg.cholesky(precision, lower=True, overwrite_a=True, check_finite=False), True
    moving = is_displacement[rows]
    push = np.where(moving, (about.slope + slope)[rows], 0.0)
    # The field does not move, because the rest is not quadratic in it.
    inner = factor if moving.all() else scipy.linalg.cho_factor(precision[np.ix_(moving, moving)], lower=True)
    step = np.zeros(len(push))
    step[moving] = scipy.linalg.cho_solve(inner, push[moving])
    position = np.array(start)
    position[rows] += step
    height, slope = height_and_slope(target, plain, position)
    height, slope = height + log_normaliser, slope + push_of_normaliser
    gain = about.slope @ (position - about.flat) - step @ (about.images @ step) / 2
    trace_at = _trace_function(target, start, _inverse(factor[0]))
    traces = [(trace_at({k: STEP}) - trace_at({k: -STEP})) / (2 * STEP) for k in about.entries.tolist()]
    log_det = 2 * np.log(np.diag(factor[0])).sum()
    return (
        float(gain + height - log_det / 2),
        about.slope[about.entries] + slope[about.entries] - np.array(traces) / 2,
        position,
    )


def _expand(
    target: Target,
    flat: Float[np.ndarray, "dimension"],
    entries: Int[np.ndarray, "hyperparameters"],
    curvature: Float[np.ndarray, "rows rows"],
) -> Expansion:
    assert target.mode_search is not None
    data = without_normaliser(target, target.data)
    rest = target.mode_search.quadratic_part(data)
    images = curvature - dense(_curvature(target, flat, flat))
    slope = height_and_slope(target, data, flat)[1] - height_and_slope(target, rest, flat)[1]
    return Expansion(flat, entries, images, slope)


def slopes_of_curvature(
    target: Target, flat: Float[np.ndarray, "dimension"], entries: Int[np.ndarray, "hyperparameters"]
) -> list[Matrix]:
    """Differentiate the curvature in u of all terms but the images by the hyperparameters."""
    slopes = []
    for entry in entries.tolist():
        ahead, behind = (_curvature(target, _moved(flat, {entry: way * STEP}), flat) for way in (1, -1))
        slopes.append((ahead - behind) / (2 * STEP))
    return slopes


def curvature_without_images(target: Target, flat: Float[np.ndarray, "dimension"]) -> Callable[[int, float], Matrix]:
    """Make the map from an entry of a flat position and its change to the curvature in u of all but the images."""
    return lambda entry, by: _curvature(target, _moved(flat, {entry: by}), flat)


def volume_at(
    target: Target, flat: Float[np.ndarray, "dimension"], curvature: Float[np.ndarray, "rows rows"]
) -> Volume:
    """Expand −½ log det H in the hyperparameters, where H is the curvature in "field" and "u_boundary"."""
    entries = np.flatnonzero(mark_hyperparameters(target)).tolist()
    lower = scipy.linalg.cholesky(curvature, lower=True)
    covariance = _inverse(lower)
    trace_at = _trace_function(target, flat, covariance)
    centre_trace = trace_at({})
    alone = {(k, way): trace_at({k: way * STEP}) for k in entries for way in (1, -1)}
    traces = np.zeros((len(entries), len(entries)))
    for row, k in enumerate(entries):
        traces[row, row] = alone[k, 1] + alone[k, -1] - 2 * centre_trace
        for column, other_entry in enumerate(entries[:row]):
            both = trace_at({k: STEP, other_entry: STEP}) + trace_at({k: -STEP, other_entry: -STEP})
            alone_sum = sum(alone[entry, way] for entry in (k, other_entry) for way in (1, -1))
            traces[row, column] = traces[column, row] = (both - alone_sum + 2 * centre_trace) / 2
    return Volume(lower, covariance, traces / STEP**2, partial(slopes_of_curvature, target, flat, np.array(entries)))


def _inverse(lower: Float[np.ndarray, "rows rows"]) -> Float[np.ndarray, "rows rows"]:
    """Compute the inverse of a matrix from its lower Cholesky factor, which is zero above the diagonal."""
    inverse, _ = scipy.linalg.lapack.dpotri(lower, lower=1)
    whole = inverse + inverse.T
    whole[np.diag_indices(len(whole))] /= 2
    return whole


def _trace_function(
    target: Target, flat: Float[np.ndarray, "dimension"], covariance: Float[np.ndarray, "rows rows"]
) -> Callable[[dict[int, float]], float]:
    """Make the function that maps steps of some entries of a flat position to tr(C R), up to a constant."""
    assert target.mode_search is not None
    data = target.mode_search.quadratic_part(target.data)
    trace = target.mode_search.quadratic_trace(data, estimands_at(target, data, jnp.asarray(flat)), covariance)
    return lambda steps: trace(estimands_at(target, data, jnp.asarray(_moved(flat, steps))))


def dense(matrix: Matrix) -> Float[np.ndarray, "rows rows"]:
    """Convert a matrix to a dense array."""
    return matrix.toarray() if scipy.sparse.issparse(matrix) else np.asarray(matrix)


def _moved(flat: Float[np.ndarray, "dimension"], steps: dict[int, float]) -> Float[np.ndarray, "dimension"]:
    position = np.array(flat)
    for entry, step in steps.items():
        position[entry] += step
    return position


def _curvature(target: Target, flat: Float[np.ndarray, "dimension"], near: Float[np.ndarray, "dimension"]) -> Matrix:
    """Compute the curvature of all terms but the images at `flat`.

    The free nodes follow the sampled nodes as they do at `near`.
    """
    assert target.mode_search is not None
    data = target.mode_search.quadratic_part(target.data)
    estimands, near_estimands = (estimands_at(target, data, jnp.asarray(position)) for position in (flat, near))
    return target.mode_search.quadratic_curvature(data, estimands, near_estimands)
