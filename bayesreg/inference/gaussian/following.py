"""Displacements that follow the hyperparameters of their prior.

Where the data say little about the displacements u, most of what the posterior says of them is their prior, whose
precision depends on hyperparameters θ such as λ and the scales of loads. Thousands of displacements then determine θ
to a few per cent, while the posterior of θ is wide. With u unchanged, θ could move in small steps only, and a
covariance of u that is right at one θ is wrong at another. In the coordinates z, u therefore moves along with θ (a
partially non-centred parameterisation, Papaspiliopoulos, Roberts and Sköld 2007).

Let H(θ) be the precision of u, the sum of the data's and the prior's, in coordinates in which it is 1 at θ̂, the
centre of θ. V are the eigenvectors of its change with one hyperparameter, and h_i = V_iᵀ H V_i is the precision in
direction i. As the hyperparameter moves, the deviation of u from its mean is multiplied by h^{−1/2} in each direction,
and the mean, a compromise of the data with the prior's mean of zero, by 1/h. Several hyperparameters do so one after
another. For one scale of a Gaussian prior and Gaussian data, whose H keeps its eigenvectors, z is then independent of
θ.

log h is a polynomial through its values at some places. Its errors add up over all directions: 20 % in a thousand of
them would hold θ in an interval a seventh as wide as its posterior. The argument is w tanh(δ/w) for a change δ, so
that displacements follow no farther than w.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Float, Int

from bayesreg.types import AnyArray, Matrix, Scalar

# Displacements follow a hyperparameter up to so many of its standard deviations.
WIDEST = 3.0
# The places, in standard deviations, at which h is computed. The change between the first two defines the directions.
PLACES = (-1.0, 1.0, -2.0, 2.0)


class Following(NamedTuple):
    """How whitened displacements follow hyperparameters (a pytree).

    Attributes
    ----------
    entries : (k,) int array
        The entries of a flat position that hold the hyperparameters.
    directions : (k, r, r) array
        The directions V of each hyperparameter, in columns.
    coefficients : (k, powers, r) array
        The coefficients of log h in each direction, from that of the first power.
    widths : (k,) array
        The change w of each hyperparameter beyond which displacements do not follow it.
    mean : (r,) array
        The whitened mean of the displacements at θ̂; zero is the prior's mean.
    """

    entries: Int[AnyArray, "hyperparameters"]
    directions: Float[AnyArray, "hyperparameters rows rows"]
    coefficients: Float[AnyArray, "hyperparameters powers rows"]
    widths: Float[AnyArray, "hyperparameters"]
    mean: Float[AnyArray, "rows"]

    def follow(self, change: Float[AnyArray, "hyperparameters"], z: Float[AnyArray, "rows"]) -> AnyArray:
        """Map z to whitened displacements, the deviations from their mean at θ̂, for a change of the hyperparameters."""
        both = jnp.stack([z.astype(self.mean.dtype), self.mean], axis=1)
        for directions, log in zip(self.directions, self._log_precisions(change), strict=True):
            both = directions @ (jnp.exp(jnp.stack([-log / 2, -log], axis=1)) * (directions.T @ both))
        return both[:, 0] + both[:, 1] - self.mean

    def unfollow(self, change: Float[AnyArray, "hyperparameters"], whitened: Float[AnyArray, "rows"]) -> AnyArray:
        """Map whitened displacements to z: the inverse of `follow`."""
        z = whitened.astype(self.mean.dtype) - self.follow(change, jnp.zeros_like(self.mean))
        log_precisions = self._log_precisions(change)
        for directions, log in zip(self.directions[::-1], log_precisions[::-1], strict=True):
            z = directions @ (jnp.exp(log / 2) * (directions.T @ z))
        return z

    def log_jacobian(self, change: Float[AnyArray, "hyperparameters"]) -> Scalar:
        """Compute the log determinant of `follow` in z."""
        return -self._log_precisions(change).sum() / 2

    def _log_precisions(self, change: AnyArray) -> Float[AnyArray, "hyperparameters rows"]:
        """Compute log h of every hyperparameter and direction at a change of the hyperparameters."""
        x = self.widths * jnp.tanh(change.astype(self.widths.dtype) / self.widths)
        powers = x[:, None] ** jnp.arange(1, 1 + self.coefficients.shape[1])
        return jnp.einsum("kp,kpr->kr", powers, self.coefficients)


def follow_by(
    entries: Int[np.ndarray, "hyperparameters"],
    sds: Float[np.ndarray, "hyperparameters"],
    factor: Float[np.ndarray, "rows rows"],
    mean: Float[np.ndarray, "rows"],
    prior_at: Callable[[int, float], Matrix],
) -> Following:
    """Make the coordinates in which displacements follow hyperparameters.

    Parameters
    ----------
    entries : (k,) int array
    sds : (k,) array
        Standard deviations of the hyperparameters.
    factor : (r, r) array
        F, upper triangular, where F Fᵀ = H⁻¹ is the covariance of the displacements at θ̂.
    mean : (r,) array
        The mean of the displacements at θ̂.
    prior_at : callable
        (entry, δ) → the prior's precision of the displacements if the hyperparameter changes by δ.
    """
    each = zip(entries.tolist(), sds.tolist(), strict=True)
    parts = [_follow_one(sd, factor, partial(prior_at, entry)) for entry, sd in each]
    directions, coefficients = (jnp.asarray(np.array(part)) for part in zip(*parts, strict=True))
    whitened = scipy.linalg.solve_triangular(factor, mean)
    return Following(jnp.asarray(entries), directions, coefficients, jnp.asarray(WIDEST * sds), jnp.asarray(whitened))


def _follow_one(
    sd: float, factor: Float[np.ndarray, "rows rows"], prior_at: Callable[[float], Matrix]
) -> tuple[Float[np.ndarray, "rows rows"], Float[np.ndarray, "powers rows"]]:
    """Return the directions of one hyperparameter, and the coefficients of log h."""
    places, width = sd * np.array(PLACES), WIDEST * sd
    priors = [prior_at(place) for place in (0.0, *places)]
    # Single precision halves the time, and these arrays are rounded to it anyway.
    between = (factor.T @ ((priors[2] - priors[1]) @ factor)).astype(np.float32)
    directions = scipy.linalg.eigh(between, overwrite_a=True, check_finite=False)[1].astype(float)
    steps = factor @ directions
    at_centre, *values = (np.einsum("ji,ji->i", steps, prior @ steps) for prior in priors)
    # The curvature of images may be negative where they fit badly. The prior's share of H then exceeds 1.
    log_precisions = np.log1p((np.array(values) - at_centre) / np.maximum(at_centre, 1.0))
    powers = (width * np.tanh(places / width))[:, None] ** np.arange(1, 1 + len(places))
    return directions, np.linalg.solve(powers, log_precisions)


def follow_nothing(entries: Int[np.ndarray, "hyperparameters"], rows: int) -> Following:
    """Make coordinates of the same shapes in which the displacements follow nothing."""
    directions, coefficients = jnp.zeros((len(entries), rows, rows)), jnp.zeros((len(entries), len(PLACES), rows))
    return Following(jnp.asarray(entries), directions, coefficients, jnp.ones(len(entries)), jnp.zeros(rows))
