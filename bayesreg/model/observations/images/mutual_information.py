"""Mutual information, for pairs of unlike contrast: every intensity of m may mean any mixture of intensities of f.

The model is that f(x_q) is drawn from a distribution p(f | m(x_q + u)) that is unknown, but the same for all points.
Its best estimate from the pair itself, the joint histogram P, gives the profile likelihood

log p(f | m) = Σ_q log p(f_q | m_q) = N (I(P) − H(f)),    I = Σ_ij P_ij log(P_ij / (P_i P_j)),

where H(f) does not depend on u: the compared points are fixed, so that the normalisation that other programs use for
changing overlaps is not needed. P is a histogram of cubic B-splines (Thévenaz and Unser 2000, "Optimization of mutual
information for multiresolution image registration"), which makes it smooth in u.

The model has no noise sd, so T_s cannot be inferred. The temperature of the options tempers the likelihood itself: E_s
is −T_s N I, and a search for the mode that raises T_s tempers the likelihood.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayesreg.interpolation import Interpolator
from bayesreg.model.observations.images.pointwise import (
    Intensities,
    SimilaritySettings,
    SumOfSquaredDifferences,
    ValueCurvature,
    total,
)
from bayesreg.settings import Positive
from bayesreg.types import AnyArray, InputError, Scalar

# Bins of each image; the outer bins hold the values beyond the range.
BINS = 24
# Every pair of bins has at least this share of the points, so that no logarithm is infinite.
LEAST = 1e-9


class Histogram(NamedTuple):
    """The joint histogram of a pair, and the bins of each point.

    Attributes
    ----------
    joint : (BINS, BINS) array
        P_ij, which sums to one; first f, then m.
    fixed, moving : (q, BINS) arrays
        The share of each point in the bins of f and of m.
    count : scalar
        N.
    """

    joint: Float[AnyArray, "bins bins"]
    fixed: Float[AnyArray, "points bins"]
    moving: Float[AnyArray, "points bins"]
    count: Scalar

    def log_conditional(self) -> Float[AnyArray, "bins bins"]:
        """Return log(P_ij / P_j): the log probability of the bins of f, given those of m."""
        return jnp.log(self.joint) - jnp.log(self.joint.sum(axis=0))


class JointInformation(NamedTuple):
    """Mutual information; see `Similarity`.

    Attributes
    ----------
    temperature : scalar
        T_s of the options.
    fixed_range, moving_range : (2,) arrays
        Intensities between which the bins lie.
    """

    temperature: Scalar
    fixed_range: Float[AnyArray, "2"]
    moving_range: Float[AnyArray, "2"]

    def histogram(self, pair: Intensities) -> Histogram:
        """Compute the joint histogram of a pair."""
        fixed, moving = _bins(pair.fixed, self.fixed_range), _bins(pair.moving, self.moving_range)
        counted = (pair.weights / pair.weights.mean() * pair.shares).astype(float)
        joint = (fixed * counted[:, None]).T @ moving.astype(float) + LEAST * len(counted)
        return Histogram(joint / joint.sum(), fixed, moving, counted.sum())

    def energy(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """Return the energy −T_s N I."""
        histogram = self.histogram(pair)
        information = (
            histogram.joint * (histogram.log_conditional() - jnp.log(histogram.joint.sum(axis=1))[:, None])
        ).sum()
        return -self.temperature * histogram.count * information

    def log_normaliser(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """Return Σ_q log p(f_q), with which the likelihood is a density of f."""
        histogram = self.histogram(pair)
        width = (self.fixed_range[1] - self.fixed_range[0]) / (BINS - 3)
        return total(pair.shares, histogram.fixed @ jnp.log(histogram.joint.sum(axis=1) / width))

    def residuals(self, pair: Intensities) -> Float[AnyArray, "points"]:
        """Return f minus its mean given m."""
        histogram = self.histogram(pair)
        conditional = histogram.moving @ histogram.joint.T
        return pair.fixed - conditional @ _centres(self.fixed_range) / conditional.sum(axis=1)

    def convexity(self, pair: Intensities, temperature: Scalar) -> ValueCurvature:
        """Return T_s times the observed Fisher information: the square of each point's ∂ log p(f_q | m_q) / ∂m_q."""
        histogram = self.histogram(pair)
        slope = jax.jvp(lambda m: _bins(m, self.moving_range), (pair.moving,), (jnp.ones_like(pair.moving),))[1]
        score = ((histogram.fixed @ histogram.log_conditional()) * slope).sum(axis=1)
        return ValueCurvature(self.temperature * pair.weights / pair.weights.mean() * pair.shares * score**2)

    def curvature(self, pair: Intensities, temperature: Scalar) -> ValueCurvature:
        """Return `convexity`: on average, the curvature of a log likelihood equals the square of its gradient."""
        return self.convexity(pair, temperature)

    def variance(self) -> Scalar:
        """Return one: T_s does not determine the scale of the residuals."""
        return jnp.ones(())

    def draw(self, key: AnyArray, pair: Intensities) -> Float[AnyArray, "points"]:
        """Draw residuals of f from p(f | m)."""
        histogram = self.histogram(pair)
        conditional, centres = histogram.moving @ histogram.joint.T, _centres(self.fixed_range)
        key_bin, key_within = jax.random.split(key)
        within = (centres[1] - centres[0]) * (jax.random.uniform(key_within, pair.fixed.shape) - 0.5)
        drawn = centres[jax.random.categorical(key_bin, jnp.log(conditional))] + within
        scale = jnp.sqrt(self.temperature / (2 * pair.weights))
        return (drawn - conditional @ centres / conditional.sum(axis=1)) / scale

    def expected_slope(self, pair: Intensities) -> None:
        """Return None; see `Similarity`."""
        return

    def of_one_point(self) -> SumOfSquaredDifferences:
        """Return Gaussian noise, the noise of one point."""
        return SumOfSquaredDifferences()


def _centres(bounds: Float[AnyArray, "2"]) -> Float[AnyArray, "bins"]:
    """Return the intensities at the centres of the bins, with one more bin beyond each end for its spline."""
    width = (bounds[1] - bounds[0]) / (BINS - 3)
    return bounds[0] + (jnp.arange(BINS) - 1) * width


def _bins(values: Float[AnyArray, "points"], bounds: Float[AnyArray, "2"]) -> Float[AnyArray, "points bins"]:
    """Compute the share of each value in every bin, by a cubic B-spline; values beyond the range count as its end."""
    inside = jnp.clip(values, bounds[0], bounds[1])
    centres = _centres(bounds)
    t = jnp.abs((inside[:, None] - centres) / (centres[1] - centres[0]))
    near, far = 2 / 3 - t**2 + t**3 / 2, (2 - t) ** 3 / 6
    return jnp.where(t < 1, near, jnp.where(t < 2, far, 0.0))


class MutualInformation(SimilaritySettings):
    """Mutual information, for unlike contrasts. It has no noise sd, and its temperature tempers the likelihood."""

    serves_any_contrast = True
    formula = (
        "−<var>T</var><sub>s</sub> <var>N I</var>, where <var>I</var> is the mutual information of <var>f</var> and "
        "<var>m</var>(<var>x</var> + <var>u</var>) at <var>N</var> quadrature points"
    )
    residual = "f less the mean of its intensities where m has the same one"

    kind: Literal["mi"] = "mi"
    temperature: Positive = 0.05
    """Temperature of the likelihood, a number: there is no noise of which it could be inferred."""

    def on(
        self, positions: Float[np.ndarray, "points 3"], rest: Intensities, fixed: Interpolator, blur: float = 0.0
    ) -> JointInformation:
        """Make the similarity at these points; see `AnySimilarity`.

        Raises
        ------
        InputError
            If an image is constant at the points.
        """
        ranges = []
        for name, values in (("fixed", rest.fixed), ("moving", rest.moving)):
            low, high = (float(x) for x in np.quantile(np.asarray(values), (0.001, 0.999)))
            if not high - low > 1e-9 * max(abs(low), abs(high)):
                raise InputError(f"the {name} image is constant in the mesh: similarity 'mi' has nothing to compare")
            ranges.append(jnp.array([low, high]))
        return JointInformation(jnp.asarray(self.temperature), *ranges)
