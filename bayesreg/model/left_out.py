"""Landmarks left out in turn: what all other observations say of each, without sampling again."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from bayesreg.model.coordinates import complete
from bayesreg.model.posterior import Posterior
from bayesreg.model.program import Problem
from bayesreg.model.state import state_of
from bayesreg.model.terms.landmarks import ComparedPoints
from bayesreg.types import AnyArray

# A direction of which the others say next to nothing: share of the information that is the landmark's own.
OWN = 1 - 1e-6
# Share of the curvature's trace that keeps directions finite of which nothing is known, such as free rigid motions.
TRACE = 1e-9


class LeftOut(NamedTuple):
    """Predictions of landmarks, each by all observations but itself.

    Attributes
    ----------
    residual : (k, 3) array
        q − p − u(p), mm, u the mean given the others; NaN where these do not determine it.
    covariance : (k, 3, 3) array
        Covariance of that residual, mm²: that of u(p) given the others, and the landmark's own error.
    """

    residual: Float[np.ndarray, "k 3"]
    covariance: Float[np.ndarray, "k 3 3"]


def leave_out(posterior: Posterior, term: ComparedPoints, estimands: dict[str, AnyArray]) -> LeftOut:
    """Leave each landmark out in turn, at given stiffness and scales.

    Given these, u_B is Gaussian as far as the other observations are linear in it. With H its precision (Gauss and
    Newton's at `estimands`), u(p) = A u_B + const and C = A H⁻¹ Aᵀ, taking away a landmark of error s² I leaves the
    residual (I − C / s²)⁻¹ r with the covariance s² (I − C / s²)⁻¹, r the residual with the landmark (the known result
    of linear regression, for three rows at a time).

    Parameters
    ----------
    posterior : Posterior
    term : ComparedPoints
        One of its terms.
    estimands : dict
        Where the posterior is linearised: its mean.
    """
    data = posterior.data
    values = complete(data.blocks, estimands)
    curvature = np.asarray(posterior.mode_search.curvature(data, estimands).gauss_newton)
    own = curvature[-3 * len(posterior.sampled) :, -3 * len(posterior.sampled) :]
    own = own + TRACE * np.trace(own) * np.eye(len(own))
    predicted, response = (np.asarray(found) for found in _predicted_with_response(data, term, values))
    count = len(predicted)
    A = response.reshape(3 * count, -1)
    spread = (A @ cho_solve(cho_factor(own), A.T)).reshape(count, 3, count, 3)
    residual, sd = np.asarray(term.shift) - predicted, np.asarray(term.sd(values))
    share = np.einsum("kikj->kij", spread) / sd[:, None, None] ** 2
    found = [_without(*one) for one in zip(residual, share, sd, strict=True)]
    return LeftOut(*(np.stack(parts) for parts in zip(*found, strict=True)))


def _without(
    residual: Float[np.ndarray, "3"], share: Float[np.ndarray, "3 3"], sd: float
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    if np.linalg.eigvalsh(share).max() > OWN:
        return np.full(3, np.nan), np.full((3, 3), np.inf)
    left = np.linalg.inv(np.eye(3) - share)
    return left @ residual, sd**2 * left


@jax.jit
def _predicted_with_response(
    problem: Problem, term: ComparedPoints, values: dict[str, AnyArray]
) -> tuple[AnyArray, AnyArray]:
    """u(p), and its derivative by u_B: (k, 3, sampled, 3)."""

    def predicted(u_boundary: AnyArray) -> AnyArray:
        return term.predicted(state_of(problem.body, problem.blocks, {**values, "u_boundary": u_boundary}))

    u_boundary = jnp.asarray(values["u_boundary"])
    return predicted(u_boundary), jax.jacrev(predicted)(u_boundary)
