"""Leave-one-out predictions of landmarks by all other observations, without sampling again."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve
from scipy.special import softmax

from bayesreg.model.blocks import Values
from bayesreg.model.coordinates import complete, estimands_of, fill
from bayesreg.model.marginal import Marginal, points_of
from bayesreg.model.point_algebra import algebra_of
from bayesreg.model.posterior import Posterior
from bayesreg.model.program import Problem
from bayesreg.model.state import state_of
from bayesreg.types import AnyArray

# This share of the curvature's trace keeps directions finite that no observation determines, such as free rigid
# motions. If ten times this share changes a prediction, then the share makes the prediction, and not the other
# observations.
TRACE, MORE = 1e-10, 10.0
# The others determine a landmark if they leave it less than the variance of its error over this.
LEAST = 1e-10
# About so many simulated landmarks say which share of a prediction lies nearer than the landmark itself.
SIMULATED = 4000


class Predictions(NamedTuple):
    """Predictions of landmarks, each by all other observations, at given stiffnesses and scales: those of some draws.

    Attributes
    ----------
    residual : (draws, k, 3) array
        q − p − u(p), mm, where u is the mean given the others; NaN if these do not determine u.
    covariance : (draws, k, 3, 3) array
        That of u(p) given the others, mm².
    sd : (draws, k, 3) array
        That of a landmark's error, mm, before it is drawn from Student's t.
    weights : (draws, k) array
        The weight of each draw for each landmark; their sum over draws is one.
    """

    residual: Float[np.ndarray, "draws k 3"]
    covariance: Float[np.ndarray, "draws k 3 3"]
    sd: Float[np.ndarray, "draws k 3"]
    weights: Float[np.ndarray, "draws k"]


class LeftOut(NamedTuple):
    """Predictions of landmarks, each by all other observations.

    Attributes
    ----------
    residual : (k, 3) array
        q − p − u(p), mm, where u is the mean given the others; NaN if these do not determine u.
    covariance : (k, 3, 3) array
        Covariance of that residual, mm²: that of u(p) given the others, and the landmark's own error.
    share : (k,) array
        The share of the predicted landmarks that lie nearer to their mean, by that covariance; NaN as the residual.
    """

    residual: Float[np.ndarray, "k 3"]
    covariance: Float[np.ndarray, "k 3 3"]
    share: Float[np.ndarray, "k"]


def leave_out(predictions: Predictions, noise: Any) -> LeftOut:
    """Average predictions over draws, and find the share of each that lies nearer than its landmark.

    A predicted landmark is a mixture over draws of a Gaussian displacement with the landmark's error, which may have
    Student's t. The law of total covariance gives its covariance, and simulated landmarks give the share.

    Parameters
    ----------
    predictions : Predictions
    noise : StudentTNoise or NormalNoise
    """
    w = predictions.weights
    residual = np.einsum("sk,ski->ki", w, predictions.residual)
    away = predictions.residual - residual
    own = noise.variance * np.einsum("sk,ski->ki", w, predictions.sd**2)[:, :, None] * np.eye(3)
    covariance = (
        np.einsum("sk,skij->kij", w, predictions.covariance) + np.einsum("sk,ski,skj->kij", w, away, away) + own
    )
    found = np.isfinite(residual).all(axis=1)
    share = np.full(len(residual), np.nan)
    # The share is the same after the axes of each landmark are scaled to the covariance one.
    whitening = np.linalg.inv(np.linalg.cholesky(covariance[found]))
    values, vectors = np.linalg.eigh(predictions.covariance[:, found])
    roots = whitening @ (vectors * np.sqrt(values.clip(0.0))[..., None, :])
    residuals = np.einsum("kij,kj->ki", whitening, residual[found])
    by_draw = (np.einsum("kij,skj->ski", whitening, away[:, found]), roots, predictions.sd[:, found], w[:, found])
    landmarks = residuals, whitening, *(np.moveaxis(array, 1, 0) for array in by_draw)
    share[found] = _shares_nearer(noise, jax.random.key(0), *landmarks)
    return LeftOut(residual, np.where(found[:, None, None], covariance, np.inf), share)


@partial(jax.jit, static_argnums=0)
def _shares_nearer(noise: Any, key: AnyArray, *landmarks: AnyArray) -> Float[AnyArray, "k"]:
    """Simulate landmarks, and compute the share of them that lies nearer to their mean than the residual of each."""

    def share(landmark: tuple[AnyArray, ...]) -> AnyArray:
        key, residual, whitening, away, roots, sd, weights = landmark
        repeats = math.ceil(SIMULATED / len(away))
        key_u, key_error = jax.random.split(key)
        u = jnp.einsum("sij,rsj->rsi", roots, jax.random.normal(key_u, (repeats, *away.shape)))
        error = noise.distribution(jnp.zeros_like(sd), sd).sample(key_error, (repeats,)) @ whitening.T
        is_nearer = ((u + error - away) ** 2).sum(axis=-1) < (residual**2).sum()
        return is_nearer.mean(axis=0) @ weights

    return jax.lax.map(share, (jax.random.split(key, len(landmarks[0])), *landmarks))


def predict_at_mean(posterior: Posterior, term: Any, estimands: dict[str, AnyArray]) -> Predictions:
    """Predict each landmark at one stiffness and at one value of each scale.

    There, u_B is Gaussian if the other observations are linear in it. Let H be its Gauss–Newton precision at
    `estimands`, u(p) = A u_B + const, and C = A H⁻¹ Aᵀ. A landmark whose error has the precision W adds Aᵀ W A to H.
    The (P y)_k and P_kk of `bayesreg.model.point_algebra` then are W r and W − W C W, where r is the residual with the
    landmark. With errors of Student's t, W has the weight of the landmark; weights of the others stay.

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
    moved, response = (np.asarray(array) for array in _predicted_with_response(data, term, values))
    A = response.reshape(3 * len(moved), -1)
    u = state_of(data.body, data.blocks, values).u
    W = np.asarray(term.gauss_newton(u, values).matrices)
    pull = np.einsum("kij,kj->ki", W, np.asarray(term.shift) - moved)
    information, regularised = (
        W - W @ _spreads(H + trace * np.trace(H) * np.eye(len(H)), A) @ W for trace in (TRACE, MORE * TRACE)
    )
    variances = 1 / np.diagonal(W, axis1=1, axis2=2)
    least, least_regularised = (_least_share(P, variances) for P in (information, regularised))
    information[least_regularised > 2 * least] = 0.0
    predicted = *_without(pull, information, variances), np.asarray(term.sd(values)), np.ones(len(term.shift))
    return Predictions(*(array[None] for array in predicted))


def predict_at_draws(marginal: Marginal, term: Any, draws: Values) -> Predictions:
    """Predict each landmark at the stiffness, scales and weights of draws, with the displacements integrated out.

    The draws have seen the landmark. A weight, the inverse of the density of the landmark given stiffness, scales, and
    the others with their weights, makes draws of the posterior without it of them (importance sampling, Gelfand 1992).
    The barrier is left out.

    Parameters
    ----------
    marginal : Marginal
    term : ComparedPoints
        The posterior's term of the landmarks.
    draws : dict
        Values of blocks, whose leading axis is that of the draws.
    """
    keys = jax.random.split(jax.random.key(0), len(draws["u_boundary"]))
    *given, sd = map(np.asarray, _given_at_draws(marginal, term, keys, dict(draws)))
    pulls, information = algebra_of(marginal.number).leave_out(*given)
    points = points_of(marginal.problem)
    own = np.repeat([other.name == term.name for other in points], [len(other.shift) for other in points])
    variances = given[-1][:, : 3 * len(own)].reshape(pulls.shape)
    predicted = *_without(pulls[:, own], information[:, own], variances[:, own]), sd
    return Predictions(*predicted, softmax(-_log_densities(*predicted, term.noise), axis=0))


def _log_densities(
    residual: Float[np.ndarray, "draws k 3"],
    covariance: Float[np.ndarray, "draws k 3 3"],
    sd: Float[np.ndarray, "draws k 3"],
    noise: Any,
) -> Float[np.ndarray, "draws k"]:
    """Compute the log density of residuals, up to a constant for each landmark."""
    found = np.isfinite(residual).all(axis=-1, keepdims=True)
    r, C = np.where(found, residual / sd, 0.0), np.where(found[..., None], covariance, 0.0)
    values, vectors = np.linalg.eigh(C / (sd[..., :, None] * sd[..., None, :]))
    squares = np.einsum("...ij,...i->...j", vectors, r) ** 2
    log_density = np.full(residual.shape[:2], -np.inf)
    for precision, log_probability in noise.mixture:
        variances = values.clip(0.0) + 1 / precision
        log_given = -(np.log(variances) + squares / variances).sum(axis=-1) / 2
        log_density = np.logaddexp(log_density, log_probability + log_given)
    return log_density - np.log(sd).sum(axis=-1)


@jax.jit
def _given_at_draws(
    marginal: Marginal, term: Any, keys: AnyArray, draws: dict[str, AnyArray]
) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
    """Draw the weights of the points; return what `PointAlgebra.leave_out` takes, and the sd of the term."""
    blocks = marginal.problem.blocks

    def of_draw(key: AnyArray, draw: dict[str, AnyArray]) -> tuple[AnyArray, ...]:
        weights, estimands = marginal.draw_weights(key, estimands_of(blocks, fill(blocks, draw)))
        values = complete(blocks, estimands)
        return *marginal.given(values, weights), term.sd(values)

    return jax.vmap(of_draw)(keys, draws)


def _without(
    pull: Float[np.ndarray, "*draws k 3"],
    information: Float[np.ndarray, "*draws k 3 3"],
    variances: Float[np.ndarray, "*draws k 3"],
) -> tuple[Float[np.ndarray, "*draws k 3"], Float[np.ndarray, "*draws k 3 3"]]:
    """Compute the residuals without each landmark, and the covariance of u(p), from (P y)_k, P_kk and Σ_k."""
    found = _least_share(information, variances) > LEAST
    covariance = np.linalg.inv(np.where(found[..., None, None], information, np.eye(3)))
    residual = np.where(found[..., None], (covariance @ pull[..., None])[..., 0], np.nan)
    return residual, covariance - variances[..., None] * np.eye(3)


def _least_share(
    information: Float[np.ndarray, "*draws k 3 3"], variances: Float[np.ndarray, "*draws k 3"]
) -> Float[np.ndarray, "*draws k"]:
    """Return the least share, over all directions, that a landmark's error has in the variance of its residual."""
    root = np.sqrt(variances)
    return np.linalg.eigvalsh(root[..., :, None] * information * root[..., None, :])[..., 0]


def _spreads(
    precision: Float[np.ndarray, "rows rows"], response: Float[np.ndarray, "coordinates rows"]
) -> Float[np.ndarray, "k 3 3"]:
    """Compute C of every landmark."""
    spread, count = response @ cho_solve(cho_factor(precision), response.T), len(response) // 3
    return np.einsum("kikj->kij", spread.reshape(count, 3, count, 3))


@jax.jit
def _predicted_with_response(problem: Problem, term: Any, values: dict[str, AnyArray]) -> tuple[AnyArray, AnyArray]:
    """Compute u(p), and its derivative by u_B: (k, 3, sampled, 3)."""

    def predicted(u_boundary: AnyArray) -> AnyArray:
        return term.predicted(state_of(problem.body, problem.blocks, {**values, "u_boundary": u_boundary}))

    u_boundary = jnp.asarray(values["u_boundary"])
    return predicted(u_boundary), jax.jacrev(predicted)(u_boundary)
