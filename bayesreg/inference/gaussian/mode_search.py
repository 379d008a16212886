"""The search for a mode of a posterior, in its support."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize

from bayesreg.inference.gaussian.density import (
    estimands_at,
    height_and_slope,
    mark_normaliser,
    normaliser_and_slope,
)
from bayesreg.inference.gaussian.evidence import FARTHEST, Found, maximise_evidence
from bayesreg.inference.gaussian.hierarchy import balance_field, mark_hyperparameters, mark_scales
from bayesreg.inference.gaussian.laplace import Gaussian, gaussian_of, laplace, precision_at
from bayesreg.inference.gaussian.pockets import leave_pockets
from bayesreg.inference.layout import displacements, flat_position, node_count, others, unravel
from bayesreg.inference.target import Target, clearance, without_normaliser
from bayesreg.types import AnyArray, InputError, Scalar

# The skull while the mode is looked for: a quadratic penalty of this standard deviation, mm, from this gap on.
SOFTNESS, GAP = 0.05, 0.02
# The last stage is repeated so often, at most, or until no coordinate moves by more, and no hyperparameter by more of
# its standard deviations.
REPEATS, SETTLED, SETTLED_SD = 20, 3e-3, 0.1
# A stage ends where an iteration gains less than this share of the height. On the way nothing is owed to a place that
# the next stage leaves: with that of the last, twice as many gradients led to the same modes.
ROUGH, FINE = 1e-4, 1e-10
# So often, at most, single nodes are moved elsewhere.
RESCUES = 3


def find_mode(
    target: Target,
    start: Float[np.ndarray, "dimension"],
    say: Callable[[str], None] = lambda text: None,
    iterations: int = 40,
) -> Float[np.ndarray, "dimension"]:
    """A mode of the log density of the position, in its support, by L-BFGS along the target's continuation.

    Single nodes that are then far more probable elsewhere are moved there, and the search goes on (`leave_pockets`).

    Parameters
    ----------
    target : Target
    start : (d,) array
        Flat position to start from; it need not lie in the support.
    say : callable
        Told of each stage.
    iterations : int
        Most iterations of a stage; the last is repeated, whitened anew, until it moves nothing.

    Returns
    -------
    (d,) array
        Flat position. Nodes that the soft skull let in are moved to its surface.

    Raises
    ------
    InputError
        If the density is not finite at the start.
    """
    flat = settle(target, approach(target, start, say, iterations), say, iterations)
    for _ in range(RESCUES):
        elsewhere, nodes = leave_pockets(target, flat)
        if not len(nodes):
            break
        named = ", ".join(map(str, np.asarray(target.variables.coords["node"])[nodes]))
        say(f"mode: moved to where they are more probable: nodes {named}")
        flat = settle(target, elsewhere, say, iterations)
    else:
        say("mode: single nodes may be more probable elsewhere")
    return flat


def approach(
    target: Target,
    start: Float[np.ndarray, "dimension"],
    say: Callable[[str], None] = lambda text: None,
    iterations: int = 40,
) -> Float[np.ndarray, "dimension"]:
    """Where the target's continuation leads the displacements from a flat position, or where a search has been."""
    assert target.mode_search is not None
    flat = np.asarray(start)
    if target.mode_search.approached is not None:
        flat = np.asarray(flat_position(target, target.data, target.mode_search.approached))
    for data in target.mode_search.continuation():
        flat = _improve(target, data, flat, False, iterations, say, gain=ROUGH)
    return flat


def settle(
    target: Target,
    flat: Float[np.ndarray, "dimension"],
    say: Callable[[str], None] = lambda text: None,
    iterations: int = 40,
    repeats: int = REPEATS,
) -> Float[np.ndarray, "dimension"]:
    """The mode next to a flat position: L-BFGS on the problem itself, whitened anew until it moves nothing.

    With fewer `repeats`, a place near it.
    """
    # The walls of the softened skull are moved inwards by as much as the nodes that press on them have gone too far
    # (Powell 1969, "A method for nonlinear constraints in minimization problems"), so that these come to rest at the
    # skull and not in it, however great the force that presses.
    shift, resting, before = np.zeros(node_count(target)), mark_hyperparameters(target), flat
    better = Found(flat, np.inf)
    for _ in range(repeats):
        found, pressed = _improve(target, target.data, better.flat, True, iterations, say, shift), shift
        shift = np.maximum(shift + GAP - _gaps(target, found), 0.0)
        balanced = balance_field(target, found, partial(_factor, target, found))
        moved = np.abs(balanced - before)[~resting].max(), np.abs(shift - pressed).max(initial=0.0)
        # Once they rest, what else moves is too little for them to follow.
        if better.moved < SETTLED_SD:
            better = better._replace(flat=balanced)
        else:
            # The units of a search that did not end at its bounds still hold.
            better = _improve_hyperparameters(target, balanced, better.units if better.moved < FARTHEST else None)
        before = balanced
        if max(moved) < SETTLED and better.moved < SETTLED_SD:
            # The evidence knows nothing of walls: nodes that press on them stay where they were found.
            return _admissible(target, balanced)
    if repeats == REPEATS:
        say("mode: not settled")
    return _admissible(target, better.flat)


def _improve_hyperparameters(
    target: Target,
    flat: Float[np.ndarray, "dimension"],
    units: Float[np.ndarray, "hyperparameters hyperparameters"] | None,
) -> Found:
    """The hyperparameters, if any, at the maximum of their evidence about a flat position."""
    assert target.mode_search is not None
    if not mark_hyperparameters(target).any():
        return Found(flat, 0.0)
    estimands = estimands_at(target, target.data, jnp.asarray(flat))
    curvature = target.mode_search.curvature(target.data, estimands).gauss_newton
    found = maximise_evidence(target, flat, curvature, units)
    # To second order the displacements may go too far: where the density itself is lower for that, they rest.
    data, resting = without_normaliser(target, target.data), np.where(mark_hyperparameters(target), found.flat, flat)
    higher = height_and_slope(target, data, found.flat)[0] >= height_and_slope(target, data, resting)[0]
    return found if higher else found._replace(flat=resting)


def _gaps(target: Target, flat: Float[np.ndarray, "dimension"]) -> Float[np.ndarray, "sampled"]:
    """Signed distance of every sampled node to the forbidden region, mm; infinite where there is none."""
    u = unravel(target)(jnp.asarray(flat))["u_boundary"]
    return np.asarray(clearance(target, target.data, u, jnp.arange(node_count(target))))


def _factor(target: Target, flat: Float[np.ndarray, "dimension"]) -> Float[np.ndarray, "dimension dimension"]:
    return np.asarray(laplace(target, flat).factor)


def _improve(
    target: Target,
    data: Any,
    flat: Float[np.ndarray, "dimension"],
    moves: bool,
    iterations: int,
    say: Callable[[str], None],
    shift: Float[np.ndarray, "sampled"] | None = None,
    gain: float = FINE,
) -> Float[np.ndarray, "dimension"]:
    """L-BFGS in the coordinates whitened where it starts, the skull softened and moved inwards by `shift`, mm."""
    shift = np.zeros(node_count(target)) if shift is None else shift
    resting = mark_scales(target)
    log_normaliser = 0.0
    if not moves or resting[mark_normaliser(target)].all():
        # The normaliser is the same for all that moves.
        data = without_normaliser(target, data)
        log_normaliser = normaliser_and_slope(target, flat)[0] if moves else 0.0
    gaussian = gaussian_of(flat, _decouple(precision_at(target, flat, data, moves, resting), resting))
    moving, own = 1 - resting.astype(float), displacements(target)
    if not moves:
        moving[others(target)] = 0.0
    best: list[tuple[Any, float, Any, float]] = []

    def objective(xi: np.ndarray) -> tuple[float, np.ndarray]:
        there = np.asarray(_place(gaussian, moving * xi))
        height, slope = height_and_slope(target, data, there)
        pressed, push = _penalty_with_slope(target, target.data, jnp.asarray(there[own].reshape(-1, 3)), shift)
        value, slope = float(pressed) - height, -slope
        slope[own] += np.asarray(push).ravel()
        gradient = moving * np.asarray(_pull_back(gaussian, slope))
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            if not best:
                raise InputError("the mode cannot be looked for: the density is not finite at the start field")
            # A wall for the line search: uphill from the best place so far, sloping back to it.
            place, least, slope, _ = best[-1]
            return least + 2 * abs(slope @ (xi - place)), -slope
        if not best or value < best[-1][1]:
            best[:] = [(xi.copy(), value, gradient, float(pressed))]
        return value, gradient

    options = {"maxiter": iterations, "maxcor": 20, "ftol": gain, "gtol": 1e-2}
    minimize(objective, np.zeros(len(flat)), jac=True, method="L-BFGS-B", options=options)
    place, least, _, pressed = best[-1]
    say(f"mode: log density {pressed - least + log_normaliser:.1f}")
    return np.asarray(_place(gaussian, moving * place))


# On the device: the threads of NumPy's products stay awake for a while and are in the way of what comes next.
_place = jax.jit(Gaussian.place)
_pull_back = jax.jit(lambda gaussian, slope: gaussian.factor.T @ slope)


def _decouple(
    precision: Float[np.ndarray, "dimension dimension"], held: Bool[np.ndarray, "dimension"]
) -> Float[np.ndarray, "dimension dimension"]:
    """Without what couples the held entries to the others: no move of the whitened others moves the held then."""
    precision = np.array(precision)
    precision[held] = precision[:, held] = 0.0
    precision[held, held] = 1.0
    return precision


def penalty(target: Target, data: Any, u: Float[AnyArray, "sampled 3"], shift: AnyArray | float = 0.0) -> Scalar:
    """The penalty on minus the log density in place of the hard skull, moved inwards by `shift`, mm."""
    gap = clearance(target, data, u, jnp.arange(node_count(target)))
    return 0.5 * (jnp.minimum(gap - GAP - shift, 0.0) ** 2).sum() / SOFTNESS**2


_penalty_with_slope = jax.jit(jax.value_and_grad(penalty, argnums=2), static_argnums=0)


def _admissible(target: Target, flat: Float[np.ndarray, "dimension"]) -> Float[np.ndarray, "dimension"]:
    """Nodes inside the skull, or nearer to it than the gap, moved out along the gradient of the distance."""
    own = displacements(target)
    u = np.array(flat[own].reshape(-1, 3))
    for _ in range(100):
        gap, slope = (np.asarray(found) for found in _clearance_with_slope(target, target.data, jnp.asarray(u)))
        inside = gap < GAP / 2
        if not inside.any():
            moved = np.array(flat)
            moved[own] = u.ravel()
            return moved
        steepness = np.maximum((slope[inside] ** 2).sum(axis=1, keepdims=True), 0.05)
        u[inside] += (GAP - gap[inside])[:, None] * slope[inside] / steepness
    raise InputError(f"{int(inside.sum())} nodes of the mode cannot be moved out of the skull; start elsewhere")


@partial(jax.jit, static_argnums=0)
def _clearance_with_slope(target: Target, data: Any, u: AnyArray) -> tuple[AnyArray, AnyArray]:
    gap, pullback = jax.vjp(lambda u: clearance(target, data, u, jnp.arange(len(u))), u)
    return gap, pullback(jnp.ones_like(gap))[0]
