"""Linear combinations in patches, for MRI and ultrasound: m is linear in f and |∇f|, with other coefficients by patch.

Ultrasound shows the echoes of tissues and of the borders between them, with a gain that changes from place to place.
The quadrature points are divided into patches (`windows_of`). Patch k has n_k values m_q = m(x_q + u), with the model

m_q = a_k f(x_q) + b_k |∇f(x_q)| + c_k + noise,    noise ~ N(0, σ_k²),    1/σ_k² ~ Gamma(ν/2, ν s²/2),

where s² is the noise variance that is common among patches. a_k, b_k and c_k have wide Normal priors in units of σ_k.
All four are integrated out in closed form, which gives, up to a constant, the density of the values of the patch,

p(m | f) ∝ (ν s² + R_k)^−(ν + n_k − 1)/2,    R_k = Σ (m − the best linear combination)².

By Bayes' rule p(f | m) ∝ p(m | f) / p(m). p(m) is the same model without f, in which the patch has one value and noise.
With V_k = Σ (m − its mean)² the log likelihood is

Σ_k (ν + n_k − 1)/2 [log(ν s² + V_k) − log(ν s² + R_k)].

Without s², a term is −n_k/2 log(1 − LC²_k), where LC² is the measure of Wein et al. 2008, "Automatic CT-ultrasound
registration for diagnostic imaging and image-guided intervention". A patch in which m is nearly constant, such as a
shadow, has V_k < ν s² and says nothing, and so does a patch in which f explains nothing of m.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayesreg.interpolation import Interpolator
from bayesreg.model.observations.images.local_correlation import Windows, windows_of
from bayesreg.model.observations.images.pointwise import (
    Intensities,
    SimilaritySettings,
    SumOfSquaredDifferences,
    ValueCurvature,
    total,
)
from bayesreg.model.term import SharedCurvature
from bayesreg.settings import Positive
from bayesreg.types import AnyArray, InputError, Scalar

# ν: the common noise variance counts as much as so many points of a patch.
FREEDOM = 4.0
# The precision of the priors of a_k and b_k, in units of the variances of f and |∇f| over all points.
RIDGE = 0.01
# The smallest number of points of a patch, where it is not compared: its sums are zero.
NEARLY_NONE = 1e-3
# The side of a patch in sds of the smoothing of the images: in less, three coefficients explain any smooth image.
PATCH = 10.0
# The longest side of a block in sides of a patch: the scale on which images determine displacements. Forces on patches
# are correlated with those on their neighbours.
BLOCK = 2.5
# s² as a share of the variance of m: less than the noise of ultrasound.
FLOOR = 0.05


class PatchFit(NamedTuple):
    """The best linear combination in the patch of each point, and properties of the patch.

    Attributes
    ----------
    count : (q,) array
        n_k.
    moving : (q,) array
        m less its mean.
    functions : (q, 2) array
        f and |∇f| less their means, each in units of its standard deviation over all points.
    precision : (q, 2, 2) array
        The precision of a_k and b_k in units of 1/σ_k².
    coefficients : (q, 2) array
        a_k and b_k.
    residuals : (q,) array
    whole, left : (q,) array
        V_k and R_k.
    """

    count: Float[AnyArray, "points"]
    moving: Float[AnyArray, "points"]
    functions: Float[AnyArray, "points 2"]
    precision: Float[AnyArray, "points 2 2"]
    coefficients: Float[AnyArray, "points 2"]
    residuals: Float[AnyArray, "points"]
    whole: Float[AnyArray, "points"]
    left: Float[AnyArray, "points"]


class PatchRegression(NamedTuple):
    """The regression of m on f and |∇f| in every patch; see `Similarity`.

    Attributes
    ----------
    patches : Windows
    blocks : (q,) int array
        The block of each point; a block is several neighbouring patches.
    functions : (q, 2) array
        f and |∇f| at the points, each with mean zero and variance one.
    slopes : (q, 2, 3) array
        Their gradients, 1/mm.
    floor : scalar
        ν s², squared intensity of m.
    temperature : scalar
        T_s of the options.
    spread : (2,) array
        Mean and variance of f over all points: p(f), without m.
    """

    patches: Windows
    blocks: Int[AnyArray, "points"]
    functions: Float[AnyArray, "points 2"]
    slopes: Float[AnyArray, "points 2 3"]
    floor: Scalar
    temperature: Scalar
    spread: Float[AnyArray, "2"]

    def fit(self, pair: Intensities) -> PatchFit:
        """Fit the best linear combination in every patch."""
        return self.fit_counted(pair.moving, _counts(pair))

    def fit_counted(self, moving: Float[AnyArray, "points"], counts: Float[AnyArray, "points"]) -> PatchFit:
        """Fit the best linear combination to values of m, of which each counts for so many points."""
        values = jnp.concatenate([moving[:, None], self.functions.astype(moving.dtype)], axis=1)
        sums = self.patches.sums(counts[:, None] * jnp.concatenate([jnp.ones_like(values[:, :1]), values], axis=1))
        # A patch that is not compared at all has no points.
        count = jnp.maximum(sums[:, 0], NEARLY_NONE)
        m, f, g = (values - sums[:, 1:] / count[:, None]).T
        products = jnp.stack([m * m, m * f, m * g, f * f, f * g, g * g], axis=1)
        mm, mf, mg, ff, fg, gg = self.patches.sums(counts[:, None] * products).T
        ff, gg = ff + RIDGE * count, gg + RIDGE * count
        determinant = ff * gg - fg**2
        a, b = (gg * mf - fg * mg) / determinant, (ff * mg - fg * mf) / determinant
        precision = jnp.stack([jnp.stack([ff, fg], axis=1), jnp.stack([fg, gg], axis=1)], axis=1)
        functions, coefficients = jnp.stack([f, g], axis=1), jnp.stack([a, b], axis=1)
        return PatchFit(count, m, functions, precision, coefficients, m - a * f - b * g, mm, mm - a * mf - b * mg)

    def energy(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """Return −T_s times the log likelihood."""
        return -self.temperature * _log_likelihood(self, pair.moving, _counts(pair))

    def log_normaliser(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """Return Σ_q log p(f_q), with which the likelihood is a density of f."""
        mean, variance = self.spread
        # Where m is ignored, `ImageLikelihood` has the same density.
        scale = variance + temperature / (2 * pair.weights)
        return total(pair.shares, -0.5 * jnp.log(2 * jnp.pi * scale) - (pair.fixed - mean) ** 2 / (2 * scale))

    def residuals(self, pair: Intensities) -> Float[AnyArray, "points"]:
        """Return the residuals of m in units of σ_k, times √(T_s / 2w)."""
        fit = self.fit(pair)
        sd = jnp.sqrt((self.floor + fit.left) / (FREEDOM + fit.count - 1))
        return fit.residuals / sd * jnp.sqrt(self.temperature / (2 * pair.weights.mean()))

    def convexity(self, pair: Intensities, temperature: Scalar) -> ValueCurvature:
        """Return `curvature` with the variances σ_k² fixed: positive semidefinite, since V_k ≥ R_k."""
        fit, counts = self.fit(pair), _counts(pair)
        freedom = self.temperature * (FREEDOM + fit.count - 1)
        precision = freedom * (1 / (self.floor + fit.left) - 1 / (self.floor + fit.whole))
        vectors = jnp.sqrt(precision) * counts * self._projection(fit)
        return ValueCurvature(precision * counts, SharedCurvature(self.patches.label, vectors, -jnp.ones(3)))

    def curvature(self, pair: Intensities, temperature: Scalar) -> ValueCurvature:
        """Return the second derivatives of E_s in the values m_q."""
        fit, counts = self.fit(pair), _counts(pair)
        freedom = self.temperature * (FREEDOM + fit.count - 1)
        of_left, of_whole = freedom / (self.floor + fit.left), freedom / (self.floor + fit.whole)
        mean, *features = self._projection(fit)
        vectors = counts * jnp.stack(
            [
                jnp.sqrt(of_left - of_whole) * mean,
                *(jnp.sqrt(of_left) * feature for feature in features),
                jnp.sqrt(2 * of_left / (self.floor + fit.left)) * fit.residuals,
                jnp.sqrt(2 * of_whole / (self.floor + fit.whole)) * fit.moving,
            ]
        )
        signs = jnp.array([-1.0, -1.0, -1.0, -1.0, 1.0])
        return ValueCurvature((of_left - of_whole) * counts, SharedCurvature(self.patches.label, vectors, signs))

    def expected_slope(self, pair: Intensities) -> Float[AnyArray, "points 3"]:
        """Return a_k ∇f + b_k ∇|∇f|. Speckle has a much steeper gradient, which tells nothing about the motion."""
        return jnp.einsum("qj,qji->qi", self.fit(pair).coefficients, self.slopes.astype(pair.moving.dtype))

    def _projection(self, fit: PatchFit) -> Float[AnyArray, "3 points"]:
        """Return functions that are orthonormal in every patch, up to the priors: those of c_k, a_k and b_k."""
        (f, g), ((ff, fg), (_, gg)) = fit.functions.T, jnp.moveaxis(fit.precision, 0, -1)
        return jnp.stack([1 / jnp.sqrt(fit.count), f / jnp.sqrt(ff), (g - fg / ff * f) / jnp.sqrt(gg - fg**2 / ff)])

    def variance(self) -> Scalar:
        """Return the mean variance (N − 3K) / N."""
        return jnp.asarray(1 - 3 * self.patches.number / len(self.patches.label))

    def draw(self, key: AnyArray, pair: Intensities) -> Float[AnyArray, "points"]:
        """Draw standard Normal numbers minus the part that a linear combination explains in each patch."""
        noise = jax.random.normal(key, pair.weights.shape)
        return self.fit(pair._replace(moving=noise, share=None)).residuals

    def of_one_point(self) -> SumOfSquaredDifferences:
        """Return Gaussian noise, the noise of one point."""
        return SumOfSquaredDifferences()


def _counts(pair: Intensities) -> Float[AnyArray, "points"]:
    """Return for how many points each point counts: one in the mean, where all is compared."""
    return pair.weights / pair.weights.mean() * pair.shares


@jax.custom_jvp
def _log_likelihood(
    similarity: PatchRegression, moving: Float[AnyArray, "points"], counts: Float[AnyArray, "points"]
) -> Scalar:
    return _sum_over_patches(similarity, counts, similarity.fit_counted(moving, counts))


def _sum_over_patches(similarity: PatchRegression, counts: Float[AnyArray, "points"], fit: PatchFit) -> Scalar:
    # Each point has its share of the term of its patch.
    return total(counts / fit.count, (FREEDOM + fit.count - 1) / 2 * _gain(similarity, fit))


def _gain(similarity: PatchRegression, fit: PatchFit) -> Float[AnyArray, "points"]:
    """Return log((ν s² + V_k) / (ν s² + R_k))."""
    return jnp.log1p(fit.whole / similarity.floor) - jnp.log1p(fit.left / similarity.floor)


@_log_likelihood.defjvp
def _log_likelihood_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Scalar, Scalar]:
    """Compute the derivative with the coefficients fixed, since R_k and V_k are minimal in them."""
    (similarity, moving, counts), (_, of_moving, of_counts) = primals, tangents
    fit = similarity.fit_counted(moving, counts)
    freedom = FREEDOM + fit.count - 1
    of_left, of_whole = freedom / (similarity.floor + fit.left), freedom / (similarity.floor + fit.whole)
    slope = total(counts * (of_whole * fit.moving - of_left * fit.residuals), of_moving)
    left = fit.residuals**2 + RIDGE * (fit.coefficients**2).sum(axis=1)
    slope += total((_gain(similarity, fit) + of_whole * fit.moving**2 - of_left * left) / 2, of_counts)
    return _sum_over_patches(similarity, counts, fit), slope


class LinearCombination(SimilaritySettings):
    """The regression of m on f and |∇f| in patches, for ultrasound. Its temperature tempers the likelihood."""

    serves_any_contrast = has_noisy_slopes = True
    formula = (
        "−<var>T</var><sub>s</sub> Σ (ν + <var>n</var> − 1)/2 log((ν<var>s</var>² + <var>V</var>) / "
        "(ν<var>s</var>² + <var>R</var>)), where <var>V</var> is what the mean of <var>m</var>(<var>x</var> + "
        "<var>u</var>) leaves of its <var>n</var> values in a patch, and <var>R</var> what the best linear combination "
        "of <var>f</var> and |∇<var>f</var>| leaves"
    )
    residual = "what the best linear combination of f and |∇f| in each patch leaves of m, in units of its noise"

    kind: Literal["lc2"] = "lc2"
    temperature: Positive = 0.05
    """Temperature of the likelihood, a number: the noise of every patch is inferred without it."""
    window_mm: Positive = 10.0
    """Longest side of a patch, mm, within which the echoes should be one linear combination."""

    def on(
        self, positions: Float[np.ndarray, "points 3"], rest: Intensities, fixed: Interpolator, blur: float = 0.0
    ) -> PatchRegression:
        """Make the similarity at these points; see `AnySimilarity`.

        Raises
        ------
        InputError
            If an image is constant at the points.
        """
        for name, values in (("fixed", rest.fixed), ("moving", rest.moving)):
            if jnp.ptp(values) <= 1e-9 * abs(values).max():
                raise InputError(f"the {name} image is constant in the mesh: similarity 'lc2' has nothing to compare")
        window = max(self.window_mm, PATCH * blur)
        return regression_at(positions, fixed, window, rest.moving.var(), self.temperature)


def regression_at(
    positions: Float[np.ndarray, "points 3"],
    fixed: Interpolator,
    window: float,
    variance: float | Scalar,
    temperature: float = 1.0,
) -> PatchRegression:
    """Make the regression at some points.

    Parameters
    ----------
    positions : (q, 3) array
        mm.
    fixed : Interpolator
        f.
    window : float
        The longest side of a patch, mm.
    variance : float
        The variance of m.
    temperature : float
        With the default, E_s is minus the log likelihood.
    """
    places = jnp.asarray(positions)
    functions = jnp.stack([fixed(places), _steepness(fixed, places)], axis=1)
    slopes = jnp.stack(
        [jax.grad(lambda x: fixed(x).sum())(places), jax.grad(lambda x: _steepness(fixed, x).sum())(places)], axis=1
    )
    spread, floor = jnp.stack([functions[:, 0].mean(), functions[:, 0].var()]), FREEDOM * FLOOR * jnp.asarray(variance)
    sd = jnp.maximum(functions.std(axis=0), 1e-12)
    return PatchRegression(
        windows_of(positions, window),
        windows_of(positions, BLOCK * window).label,
        (functions - functions.mean(axis=0)) / sd,
        slopes / sd[:, None],
        floor,
        jnp.asarray(temperature),
        spread,
    )


def _steepness(fixed: Interpolator, places: Float[AnyArray, "points 3"]) -> Float[AnyArray, "points"]:
    """Return |∇f|; where f is flat its gradient is zero instead of undefined."""
    slope = jax.grad(lambda x: fixed(x).sum())(places)
    return jnp.sqrt((slope**2).sum(axis=1) + 1e-24)
