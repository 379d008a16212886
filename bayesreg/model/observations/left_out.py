"""Leave-one-out predictions of landmarks by all other observations, without sampling again."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from bayesreg.model.coordinates import complete
from bayesreg.model.posterior import Posterior
from bayesreg.model.program import Problem
from bayesreg.model.state import state_of
from bayesreg.types import AnyArray

# This share of the curvature's trace keeps directions finite that no observation determines, such as free rigid
# motions. If ten times this share changes a prediction, then the share makes the prediction, and not the other
# observations.
TRACE, MORE = 1e-10, 10.0


class LeftOut(NamedTuple):
    """Predictions of landmarks, each by all other observations.

    Attributes
    ----------
    residual : (k, 3) array
        q − p − u(p), mm, where u is the mean given the others; NaN if these do not determine u.
    covariance : (k, 3, 3) array
        Covariance of that residual, mm²: that of u(p) given the others, and the landmark's own error.
    """

    residual: Float[np.ndarray, "k 3"]
    covariance: Float[np.ndarray, "k 3 3"]


def leave_out(posterior: Posterior, term: Any, estimands: dict[str, AnyArray]) -> LeftOut:
    """Leave each landmark out in turn, at given stiffness and scales.

    For given stiffness and scales, u_B is Gaussian if the other observations are linear in it. Let H be its
    Gauss–Newton precision at `estimands`, u(p) = A u_B + const, and C = A H⁻¹ Aᵀ. A landmark whose error has the
    precision P adds Aᵀ P A to H. Without it, the residual is (I − C P)⁻¹ r, and the covariance of u(p) is
    (I − C P)⁻¹ C, where r is the residual with the landmark (the known result of linear regression, for three rows at a
    time). With errors of Student's t, P has the weight of the landmark; weights of the others stay.

    Parameters
    ----------
    posterior : Posterior
    term : ComparedPoints
        The posterior's term of the landmarks.
    estimands : dict
        The estimands at which the posterior is linearised: its mean.
    """
    data = posterior.data
    values = complete(data.blocks, estimands)
    curvature = np.asarray(posterior.target.mode_search.curvature(data, estimands).gauss_newton)
    # The components of a field come first in the rows.
    components = len(curvature) - 3 * len(posterior.sampled)
    H = curvature[components:, components:]
    predicted, response = (np.asarray(array) for array in _predicted_with_response(data, term, values))
    A = response.reshape(3 * len(predicted), -1)
    residual = np.asarray(term.shift) - predicted
    u = state_of(data.body, data.blocks, values).u
    precision = np.asarray(term.gauss_newton(u, values).matrices)
    error = term.noise.variance * np.asarray(term.sd(values)) ** 2
    spreads = [_spreads(H + trace * np.trace(H) * np.eye(len(H)), A) for trace in (TRACE, MORE * TRACE)]
    left_out = [_without(*landmark) for landmark in zip(residual, *spreads, precision, error, strict=True)]
    return LeftOut(*(np.stack(fields) for fields in zip(*left_out, strict=True)))


def _spreads(
    precision: Float[np.ndarray, "rows rows"], response: Float[np.ndarray, "coordinates rows"]
) -> Float[np.ndarray, "k 3 3"]:
    """Compute C of every landmark."""
    spread, count = response @ cho_solve(cho_factor(precision), response.T), len(response) // 3
    return np.einsum("kikj->kij", spread.reshape(count, 3, count, 3))


def _without(
    residual: Float[np.ndarray, "3"],
    spread: Float[np.ndarray, "3 3"],
    less: Float[np.ndarray, "3 3"],
    precision: Float[np.ndarray, "3 3"],
    error: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Compute the residual without the landmark, and its covariance; `less` is C with more regularisation."""
    root = np.sqrt(precision)
    least, least_regularised = (np.linalg.eigvalsh(np.eye(3) - root @ C @ root).min() for C in (spread, less))
    if least_regularised > 2 * least:
        return np.full(3, np.nan), np.full((3, 3), np.inf)
    left = np.linalg.inv(np.eye(3) - spread @ precision)
    return left @ residual, left @ spread + np.diag(error)


@jax.jit
def _predicted_with_response(problem: Problem, term: Any, values: dict[str, AnyArray]) -> tuple[AnyArray, AnyArray]:
    """Compute u(p), and its derivative by u_B: (k, 3, sampled, 3)."""

    def predicted(u_boundary: AnyArray) -> AnyArray:
        return term.predicted(state_of(problem.body, problem.blocks, {**values, "u_boundary": u_boundary}))

    u_boundary = jnp.asarray(values["u_boundary"])
    return predicted(u_boundary), jax.jacrev(predicted)(u_boundary)
