"""The search for a mode of a posterior."""

from __future__ import annotations

import logging
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize

from bayesreg.inference.deadline import NEVER, Deadline
from bayesreg.inference.gaussian.density import (
    estimands_at,
    height_and_slope,
    mark_normaliser,
    normaliser_and_slope,
)
from bayesreg.inference.gaussian.evidence import FARTHEST, Found, maximise_evidence
from bayesreg.inference.gaussian.hierarchy import balance_field, mark_hyperparameters, mark_scales
from bayesreg.inference.gaussian.laplace import Gaussian, gaussian_of, laplace, precision_at
from bayesreg.inference.layout import flat_position, others
from bayesreg.inference.target import Target, without_normaliser
from bayesreg.types import InputError

_log = logging.getLogger(__name__)

# The greatest number of repeats of the last stage. It ends earlier if no coordinate moves by more than SETTLED and no
# hyperparameter by more than SETTLED_SD standard deviations.
REPEATS, SETTLED, SETTLED_SD = 20, 3e-3, 0.1
# A stage ends if an iteration gains less than this share of the log density. ROUGH is enough for all but the last
# stage: with FINE for all, twice as many gradients led to the same modes.
ROUGH, FINE = 1e-4, 1e-10


def find_mode(
    target: Target,
    start: Float[np.ndarray, "dimension"],
    iterations: int = 40,
    deadline: Deadline = NEVER,
) -> Float[np.ndarray, "dimension"]:
    """Find a mode of the log density of the position, by L-BFGS along the target's continuation.

    Parameters
    ----------
    target : Target
    start : (d,) array
        Flat position to start from.
    iterations : int
        The greatest number of iterations of a stage. The last stage is whitened and run again until it converges.
    deadline : Deadline
        The search ends then, and returns the best point so far.

    Returns
    -------
    (d,) array
        Flat position.

    Raises
    ------
    InputError
        If the density is not finite at the start.
    """
    return settle(target, approach(target, start, iterations, deadline), iterations, deadline=deadline)


def approach(
    target: Target,
    start: Float[np.ndarray, "dimension"],
    iterations: int = 40,
    deadline: Deadline = NEVER,
) -> Float[np.ndarray, "dimension"]:
    """Move the displacements along the target's continuation.

    The start is the target's `search_start` estimands if it has them, else the given flat position.
    """
    assert target.mode_search is not None
    flat = np.asarray(start)
    if target.mode_search.search_start is not None:
        flat = np.asarray(flat_position(target, target.data, target.mode_search.search_start))
    elif loosening := target.mode_search.loosening:
        estimands = estimands_at(target, target.data, jnp.asarray(flat))
        loose = {name: factor * estimands[name] for name, factor in loosening.items()}
        flat = np.asarray(flat_position(target, target.data, {**estimands, **loose}))
    for data in target.mode_search.continuation():
        if deadline.has_passed:
            break
        flat = _improve(target, data, flat, False, iterations, deadline, gain=ROUGH)
    return flat


def settle(
    target: Target,
    flat: Float[np.ndarray, "dimension"],
    iterations: int = 40,
    repeats: int = REPEATS,
    deadline: Deadline = NEVER,
) -> Float[np.ndarray, "dimension"]:
    """Find the mode next to a flat position by L-BFGS on the target's own problem.

    The coordinates are whitened again before each repeat. With fewer `repeats` the result is a point near the mode.
    """
    resting, before = mark_hyperparameters(target), flat
    better = Found(flat, np.inf)
    for _ in range(repeats):
        if deadline.has_passed:
            break
        improved = improve(target, better.flat, iterations, deadline)
        if deadline.has_passed:
            better = better._replace(flat=improved)
            break
        balanced = balance_field(target, improved, partial(_factor, target, improved))
        shift = np.abs(balanced - before)[~resting].max()
        # Once the hyperparameters have settled, the other coordinates move too little to change them.
        if better.greatest_change < SETTLED_SD:
            better = better._replace(flat=balanced)
        else:
            # The units are reused if the last search did not end at its bounds.
            better = _improve_hyperparameters(
                target, balanced, better.units if better.greatest_change < FARTHEST else None, deadline
            )
        before = balanced
        if shift < SETTLED and better.greatest_change < SETTLED_SD:
            return better.flat
    if deadline.has_passed:
        _log.warning("mode: the time is spent before the search settled")
    elif repeats == REPEATS:
        _log.warning("mode: not settled")
    return better.flat


def improve(
    target: Target, flat: Float[np.ndarray, "dimension"], iterations: int = 40, deadline: Deadline = NEVER
) -> Float[np.ndarray, "dimension"]:
    """Move all coordinates but the scales (`mark_scales`) towards the mode."""
    return _improve(target, target.data, flat, True, iterations, deadline)


def _improve_hyperparameters(
    target: Target,
    flat: Float[np.ndarray, "dimension"],
    units: Float[np.ndarray, "hyperparameters hyperparameters"] | None,
    deadline: Deadline,
) -> Found:
    """Move the hyperparameters, if there are any, to the maximum of their evidence about a flat position."""
    assert target.mode_search is not None
    if not mark_hyperparameters(target).any():
        return Found(flat, 0.0)
    estimands = estimands_at(target, target.data, jnp.asarray(flat))
    curvature = target.mode_search.curvature(target.data, estimands).gauss_newton
    maximum = maximise_evidence(target, flat, curvature, units, deadline)
    # The expansion is of second order, so the displacements may go too far. If that lowers the density, they stay.
    data, resting = without_normaliser(target, target.data), np.where(mark_hyperparameters(target), maximum.flat, flat)
    higher = height_and_slope(target, data, maximum.flat)[0] >= height_and_slope(target, data, resting)[0]
    return maximum if higher else maximum._replace(flat=resting)


def _factor(target: Target, flat: Float[np.ndarray, "dimension"]) -> Float[np.ndarray, "dimension dimension"]:
    return np.asarray(laplace(target, flat).factor)


def _improve(
    target: Target,
    data: Any,
    flat: Float[np.ndarray, "dimension"],
    moves: bool,
    iterations: int,
    deadline: Deadline,
    gain: float = FINE,
) -> Float[np.ndarray, "dimension"]:
    """Run L-BFGS in coordinates whitened at its start."""
    resting = mark_scales(target)
    log_normaliser = 0.0
    if not moves or resting[mark_normaliser(target)].all():
        # The normaliser depends on no coordinate that moves.
        data = without_normaliser(target, data)
        log_normaliser = normaliser_and_slope(target, flat)[0] if moves else 0.0
    gaussian = gaussian_of(flat, _decouple(precision_at(target, flat, data, moves, resting), resting))
    moving = 1 - resting.astype(float)
    if not moves:
        moving[others(target)] = 0.0
    best: list[tuple[Any, float, Any]] = []

    def objective(xi: np.ndarray) -> tuple[float, np.ndarray]:
        position = np.asarray(_place(gaussian, moving * xi))
        height, slope = height_and_slope(target, data, position)
        value, gradient = -height, -moving * np.asarray(_pull_back(gaussian, slope))
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            if not best:
                raise InputError("the mode cannot be looked for: the density is not finite at the start field")
            # A value that makes the line search turn back: it rises with the distance from the best point so far.
            best_xi, least, slope = best[-1]
            return least + 2 * abs(slope @ (xi - best_xi)), -slope
        if not best or value < best[-1][1]:
            best[:] = [(xi.copy(), value, gradient)]
        return value, gradient

    options = {"maxiter": iterations, "maxcor": 20, "ftol": gain, "gtol": 1e-2}
    start = np.zeros(len(flat))
    minimize(objective, start, jac=True, method="L-BFGS-B", options=options, callback=deadline.require_time)
    optimum, least, _ = best[-1]
    _log.info("mode: log density %.1f", log_normaliser - least)
    return np.asarray(_place(gaussian, moving * optimum))


# These products run on the device, because the threads of NumPy's products stay active for a while and slow down the
# next computation.
_place = jax.jit(Gaussian.place)
_pull_back = jax.jit(Gaussian.pull_back)


def _decouple(
    precision: Float[np.ndarray, "dimension dimension"], held: Bool[np.ndarray, "dimension"]
) -> Float[np.ndarray, "dimension dimension"]:
    """Remove the coupling of the held entries to the others, so that a move of the others leaves them unchanged."""
    precision = np.array(precision)
    precision[held] = precision[:, held] = 0.0
    precision[held, held] = 1.0
    return precision
